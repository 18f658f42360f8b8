"""A dynamic scene at several key times, quantised to integers: what a page plays.

Static Gaussians have one geometry, and a colour and an opacity per key time; dynamic Gaussians have a geometry per key
time and one colour. Between key times, means, colours and logarithms of scales are interpolated linearly; rotations
too, and are then normalised. The geometry of a Gaussian takes four 32-bit words: its mean with 21 bits per axis over
the bounds of its branch (x and the upper bits of y, then the lower bits of y and z), its rotation as in compressed PLY,
and its log-scales with 10 bits each.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8, UInt32

from warpgs.model.gaussians import SH_C0

from .cloud import ARRAYS, Cloud, logit, sigmoid
from .packing import dequantise, pack_rotations, quantise, unpack, unpack_rotations

MEAN_BITS = 21
SCALE_BITS = 10
SCALE_SPAN = 16.0
"""Range of log-scales below the largest one; a Gaussian that is e¹⁶ times thinner is flat."""

COLORS = (-1.0, 2.0)
REST = (-2.0, 2.0)
"""Bounds of colours and of coefficients of degree 1 and higher, far beyond what a screen shows: otherwise a few
outliers would cost all others their precision."""

WORDS = 4
"""Words per geometry."""

UPPER_Y_BITS = 11
"""Bits of y that share the first word with x; the other ten share the second with z."""


@dataclass(frozen=True)
class Bounds:
    """The ranges over which a branch is quantised.

    Attributes:
        means: [2, 3] minimum and maximum mean [scene units].
        log_scales: [2] minimum and maximum over all axes.
        colors: [2] minimum and maximum over all channels.
        rest: [2] minimum and maximum of the coefficients of degree 1 and higher.
    """

    means: Float64[np.ndarray, "2 3"]
    log_scales: Float64[np.ndarray, "2"]
    colors: Float64[np.ndarray, "2"]
    rest: Float64[np.ndarray, "2"]


@dataclass(frozen=True)
class Branch:
    """The static or the dynamic Gaussians.

    Attributes:
        bounds: Ranges of the quantised arrays.
        geometry: [1 or K, N, 4] means, rotations and scales.
        colors: [K or 1, N, 4] red, green, blue (of the constant coefficient) and opacity.
        rest: [N, R, 3] coefficients of degree 1 and higher, the same at all times.
    """

    bounds: Bounds
    geometry: UInt32[np.ndarray, "G N 4"]
    colors: UInt8[np.ndarray, "C N 4"]
    rest: UInt8[np.ndarray, "N R 3"]

    def __len__(self) -> int:
        return self.geometry.shape[1]

    def at(self, position: float, is_dynamic: bool) -> Cloud:
        """The Gaussians at a position between key times, where key k is at position k."""
        geometry = [_unpack_geometry(self.bounds, words) for words in _neighbours(self.geometry, position)]
        color, next_color = (_unpack_colors(self.bounds, values) for values in _neighbours(self.colors, position))
        fraction = position - int(position)
        (means, quats, log_scales), (next_means, next_quats, next_scales) = geometry
        means, log_scales = _lerp(means, next_means, fraction), _lerp(log_scales, next_scales, fraction)
        # q and -q are the same rotation: interpolate towards the closer one
        closer = np.where((quats * next_quats).sum(1, keepdims=True) < 0, -next_quats, next_quats)
        quats = _lerp(quats, closer, fraction)
        color = _lerp(color, next_color, fraction)
        constant = (color[:, None, :3] - 0.5) / SH_C0
        rest = dequantise(self.rest.astype(np.uint32), self.bounds.rest, 8)
        return Cloud(
            means=means.astype(np.float32),
            quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
            log_scales=log_scales.astype(np.float32),
            logit_opacities=logit(color[:, 3]).astype(np.float32),
            sh=np.concatenate([constant, rest], 1).astype(np.float32),
            is_dynamic=np.full(len(self), is_dynamic),
        )


@dataclass(frozen=True)
class Baked:
    """A scene at ``keys`` times, evenly spaced over [0, 1]."""

    keys: int
    static: Branch
    dynamic: Branch

    def at(self, time: float) -> Cloud:
        """The Gaussians at a time in [0, 1], static ones first."""
        position = time * (self.keys - 1)
        parts = [self.static.at(position, False), self.dynamic.at(position, True)]
        return parts[0].replaced(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS})


def bake(cloud_at: Callable[[float], Cloud], times: Iterable[float]) -> Baked:
    """Quantises a scene at key times; Gaussians with values that are not finite at any of them are omitted.

    Args:
        cloud_at: The scene at a time, in the same rows at every time.
        times: At least one, evenly spaced over [0, 1].
    """
    static_colors, dynamic_geometry, finite = [], [], np.ones(1, bool)
    for time in times:
        cloud = cloud_at(time)
        finite = finite & cloud.finite
        is_dynamic = cloud.is_dynamic
        # half precision has 11 bits, more than are kept
        static_colors.append(_color(cloud.select(~is_dynamic)).astype(np.float16))
        dynamic_geometry.append([part[is_dynamic] for part in (cloud.means, cloud.quats, cloud.log_scales)])
    static, dynamic = cloud.select(~is_dynamic & finite), cloud.select(is_dynamic & finite)
    tracks = [np.stack(parts)[:, finite[is_dynamic]] for parts in zip(*dynamic_geometry, strict=True)]
    geometry = [part[None] for part in (static.means, static.quats, static.log_scales)]
    return Baked(
        len(dynamic_geometry),
        _branch(geometry, np.stack(static_colors)[:, finite[~is_dynamic]], static.sh[:, 1:]),
        _branch(tracks, _color(dynamic)[None], dynamic.sh[:, 1:]),
    )


def baked_bytes(num_static: int, num_dynamic: int, keys: int, rest: int) -> int:
    """Memory of the Gaussians of a page before compression [bytes], with ``rest`` coefficients beyond degree 0."""
    geometry, color = 4 * WORDS, 4
    return num_static * (geometry + keys * color + 3 * rest) + num_dynamic * (keys * geometry + color + 3 * rest)


def _color(cloud: Cloud) -> np.ndarray:
    """[N, 4] colour of the constant coefficient, and opacity."""
    return np.concatenate([np.clip(0.5 + SH_C0 * cloud.sh[:, 0], *COLORS), sigmoid(cloud.logit_opacities[:, None])], 1)


def _branch(geometry: list[np.ndarray], colors: np.ndarray, rest: np.ndarray) -> Branch:
    means, quats, log_scales = geometry
    rest = np.clip(rest, *REST)
    scale_range = _range(log_scales)
    bounds = Bounds(
        np.stack([_range(means[..., a]) for a in range(3)], 1),
        np.maximum(scale_range, scale_range[1] - SCALE_SPAN),
        _range(colors[..., :3]),
        _range(rest),
    )
    values = quantise(means, bounds.means, MEAN_BITS)
    x, y, z = (values[..., a] for a in range(3))
    scales = quantise(np.maximum(log_scales, bounds.log_scales[0]), bounds.log_scales, SCALE_BITS)
    words = [
        x << np.uint32(UPPER_Y_BITS) | y >> np.uint32(MEAN_BITS - UPPER_Y_BITS),
        (y & np.uint32((1 << (MEAN_BITS - UPPER_Y_BITS)) - 1)) << np.uint32(MEAN_BITS) | z,
        pack_rotations(quats.reshape(-1, 4)).reshape(x.shape),
        scales[..., 0] << np.uint32(20) | scales[..., 1] << np.uint32(10) | scales[..., 2],
    ]
    rgb = quantise(colors[..., :3].astype(np.float64), bounds.colors, 8)
    opacity = quantise(colors[..., 3:].astype(np.float64), (0.0, 1.0), 8)
    return Branch(
        bounds,
        np.stack(words, -1),
        np.concatenate([rgb, opacity], -1).astype(np.uint8),
        quantise(rest, bounds.rest, 8).astype(np.uint8),
    )


def _range(values: np.ndarray) -> np.ndarray:
    """Minimum and maximum; zeros for an empty array."""
    return np.array([values.min(), values.max()], np.float64) if values.size else np.zeros(2)


def _neighbours(keys: np.ndarray, position: float) -> tuple[np.ndarray, np.ndarray]:
    """The keys before and after a position; the same one twice if there is only one."""
    before = min(int(position), len(keys) - 1)
    return keys[before], keys[min(before + 1, len(keys) - 1)]


def _lerp(a: np.ndarray, b: np.ndarray, fraction: float) -> np.ndarray:
    return a * (1 - fraction) + b * fraction


def _unpack_geometry(bounds: Bounds, words: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means, quaternions and log-scales from their words."""
    high, low = (
        unpack(words[:, 0], (MEAN_BITS, UPPER_Y_BITS)),
        unpack(words[:, 1], (MEAN_BITS - UPPER_Y_BITS, MEAN_BITS)),
    )
    y = high[:, 1] << np.uint32(MEAN_BITS - UPPER_Y_BITS) | low[:, 0]
    means = dequantise(np.stack([high[:, 0], y, low[:, 1]], 1), bounds.means, MEAN_BITS)
    scales = dequantise(unpack(words[:, 3], (SCALE_BITS,) * 3), bounds.log_scales, SCALE_BITS)
    return means, unpack_rotations(words[:, 2]).astype(np.float64), scales


def _unpack_colors(bounds: Bounds, values: np.ndarray) -> np.ndarray:
    rgb = dequantise(values[:, :3].astype(np.uint32), bounds.colors, 8)
    return np.concatenate([rgb, values[:, 3:] / 255.0], 1)
