"""Ray tracing of simple bodies (kernels/raytrace.py)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from warpgs.kernels import raytrace as kernels
from warpgs.runtime.checks import check_image_size, check_same_device, check_tensor
from warpgs.runtime.launch import launch

SPHERE, CUBE, TORUS, BLOB = kernels.SPHERE, kernels.CUBE, kernels.TORUS, kernels.BLOB
"""Unit shapes; the torus is around z and has radii 1 and 0.3, the blob has three lobes around z."""


class Bodies(NamedTuple):
    """Bodies, each a unit shape in its own space.

    Attributes:
        shapes: [B] SPHERE, CUBE, TORUS or BLOB.
        body_from_world: [B, 3, 4] affine transforms; that of a torus must be a rotation, a uniform scale and a shift.
        colors: [B, 2, 3] the two colours of the checkerboard.
        frequencies: [B] angular frequency of the checkerboard [rad per unit of body space].
        materials: [B, 3] strength of the highlight, mirrored fraction in [0, 1], height of a blob's lobes in [−¼, ¼].
    """

    shapes: Int32[Tensor, " B"]
    body_from_world: Float[Tensor, "B 3 4"]
    colors: Float[Tensor, "B 2 3"]
    frequencies: Float[Tensor, " B"]
    materials: Float[Tensor, "B 3"]


class TracedImage(NamedTuple):
    """A ray-traced image.

    Attributes:
        image: [H, W, 3] colours, not clamped.
        depth: [H, W] z in camera space at the centres of the pixels; 1e6 where no body is hit.
        bodies: [H, W] index of the body at the centre of each pixel, −1 for none.
    """

    image: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W"]
    bodies: Int32[Tensor, "H W"]


def raytrace(
    bodies: Bodies,
    lamp: Float[Tensor, "3 3"],
    samples: Float[Tensor, "S 4"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
) -> TracedImage:
    """Renders bodies that are lit by a lamp; not differentiable.

    Args:
        bodies: The scene.
        lamp: [3, 3] centre and two half axes of the light, a parallelogram.
        samples: [S, 4] position in the pixel and on the lamp, in [0, 1]⁴, of each sample of a pixel; the position on
            the lamp is shifted from pixel to pixel.
        viewmat: [4, 4] rigid world-to-camera transform, x right, y down, z forward.
        K: [3, 3] intrinsics [px] with pixel centres at +0.5.
        size: (width, height) [px].

    Raises:
        ValueError: On a wrong shape, dtype, device or size.
    """
    _check_inputs({**bodies._asdict(), "lamp": lamp, "samples": samples, "viewmat": viewmat, "K": K})
    check_image_size(*size)
    width, height = size

    image, depth = lamp.new_empty(height, width, 3), lamp.new_empty(height, width)
    hits = lamp.new_empty(height, width, dtype=torch.int32)
    outputs = (image.view(-1, 3), depth.view(-1), hits.view(-1))
    inputs = (*bodies, lamp, samples, viewmat, K, width)
    launch(kernels.raytrace_fwd, width * height, *inputs, *outputs, work=len(samples))
    return TracedImage(image, depth, hits)


def _check_inputs(tensors: dict[str, Tensor]) -> None:
    shapes: list[tuple[int | str, ...]]
    shapes = [("B",), ("B", 3, 4), ("B", 2, 3), ("B",), ("B", 3), (3, 3), ("S", 4), (4, 4), (3, 3)]
    sizes: dict[str, int] = {}
    for (name, tensor), shape in zip(tensors.items(), shapes, strict=True):
        check_tensor(name, tensor, shape, sizes, (torch.int32 if name == "shapes" else torch.float32,))
    check_same_device(tensors)
