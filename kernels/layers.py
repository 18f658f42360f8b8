"""What arrives at the layers of a composite (image, alpha and depth of each), as the reverse walk wants it.

The walk knows depth as one more channel, D = Σ_i alpha_i T_i depth_i. What the layer has is, with
A = max(alpha, SMALLEST_ALPHA),

    depth = D / A,      v_D = v_depth / A,      v_alpha += -v_depth D / A²  where alpha is not below SMALLEST_ALPHA.

The composites of all layers lie in one tensor, but their cotangents arrive one by one or not at all: an array of
length 0 is zero everywhere.
"""

import functools

import warp as wp

from .constants import SMALLEST_ALPHA


@wp.func
def read(values: wp.array[float], i: int) -> float:
    result = float(0.0)
    if values.shape[0] > 0:
        result = values[i]
    return result


@wp.func
def read_of(m: int, joint: wp.array[float], static: wp.array[float], dynamic: wp.array[float], i: int) -> float:
    """Element i of layer m."""
    if m == 0:
        return read(joint, i)
    if m == 1:
        return read(static, i)
    return read(dynamic, i)


@functools.cache
def make_layers_bwd(num_features: int, with_depth: bool) -> wp.Kernel:
    """Kernel with one thread for each pixel of each layer."""
    C = num_features
    num_channels = C + int(with_depth)

    @wp.kernel(enable_backward=False, module="unique")
    def layers_bwd(
        first: int,
        num_pixels: int,
        alpha: wp.array[float],
        depth: wp.array[float],
        v_image_joint: wp.array[float],
        v_image_static: wp.array[float],
        v_image_dynamic: wp.array[float],
        v_alpha_joint: wp.array[float],
        v_alpha_static: wp.array[float],
        v_alpha_dynamic: wp.array[float],
        v_depth_joint: wp.array[float],
        v_depth_static: wp.array[float],
        v_depth_dynamic: wp.array[float],
        v_composite: wp.array[float],
        v_alpha: wp.array[float],
    ):
        i = first + wp.tid()
        m = i / num_pixels
        p = i - m * num_pixels
        for c in range(wp.static(C)):
            v_composite[i * wp.static(num_channels) + c] = read_of(
                m, v_image_joint, v_image_static, v_image_dynamic, p * wp.static(C) + c
            )
        v = read_of(m, v_alpha_joint, v_alpha_static, v_alpha_dynamic, p)
        if wp.static(with_depth):
            a = alpha[i]
            v_drawn = read_of(m, v_depth_joint, v_depth_static, v_depth_dynamic, p) / wp.max(a, SMALLEST_ALPHA)
            v_composite[i * wp.static(num_channels) + wp.static(C)] = v_drawn
            if a >= SMALLEST_ALPHA:
                v -= v_drawn * depth[i]
        v_alpha[i] = v

    return layers_bwd
