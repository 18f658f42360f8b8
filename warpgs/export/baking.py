"""A moving scene over some key times, in whole numbers: what a page plays.

Static Gaussians keep one geometry and have a colour and an opacity at every key time, dynamic ones the other way
round. Between key times, means, colours and logarithms of scales are mixed linearly, rotations too and then made
unit again. A Gaussian's geometry is four words: its mean in 21 bits an axis over the bounds of its branch (42 bits
of x and y, then of y and z), its rotation as compressed PLY keeps it, its log-scales in 10 bits each.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt8, UInt32

from warpgs.model.gaussians import SH_C0

from .cloud import OPACITY_MARGIN, Cloud
from .packing import pack_rotations, quantise, restore, unpack, unpack_rotations

MEAN_BITS = 21
SCALE_BITS = 10
SCALE_SPAN = 16.0
"""Logarithms of scales are kept within this of the largest one: a Gaussian that is e¹⁶ times thinner is a flat one."""

COLORS = (-1.0, 2.0)
REST = (-2.0, 2.0)
"""Colours and coefficients of higher degrees are kept within these, far beyond what a screen shows: else a few that
training left outside would take the others' bits."""

WORDS = 4
LOW_X = 11
"""Bits of y that share the first word with x; the other ten share the second with z."""


@dataclass(frozen=True)
class Bounds:
    """What the whole numbers of a branch span.

    Attributes:
        means: [2, 3] lowest and highest mean [scene units].
        log_scales: [2] over all axes.
        colors: [2] over all channels.
        rest: [2] of the coefficients of higher degrees.
    """

    means: Float64[np.ndarray, "2 3"]
    log_scales: Float64[np.ndarray, "2"]
    colors: Float64[np.ndarray, "2"]
    rest: Float64[np.ndarray, "2"]


@dataclass(frozen=True)
class Branch:
    """The static or the dynamic Gaussians.

    Attributes:
        bounds: What the numbers below span.
        geometry: [1 or K, N, 4] means, rotations and scales.
        colors: [K or 1, N, 4] red, green, blue (of the constant coefficient), opacity.
        rest: [N, R, 3] coefficients of higher degrees, of all times.
    """

    bounds: Bounds
    geometry: UInt32[np.ndarray, "G N 4"]
    colors: UInt8[np.ndarray, "C N 4"]
    rest: UInt8[np.ndarray, "N R 3"]

    def __len__(self) -> int:
        return self.geometry.shape[1]

    def at(self, position: float, is_dynamic: bool) -> Cloud:
        """The Gaussians at a place between two keys, counted in keys."""
        geometry = [_geometry(self.bounds, words) for words in _around(self.geometry, position)]
        color, next_color = (_colors(self.bounds, numbers) for numbers in _around(self.colors, position))
        share = position - int(position)
        (means, quats, log_scales), (next_means, next_quats, next_scales) = geometry
        means, log_scales = _mixed(means, next_means, share), _mixed(log_scales, next_scales, share)
        turned = np.where((quats * next_quats).sum(1, keepdims=True) < 0, -next_quats, next_quats)  # q and -q are one
        quats = _mixed(quats, turned, share)
        color = _mixed(color, next_color, share)
        opacities = np.clip(color[:, 3], OPACITY_MARGIN, 1 - OPACITY_MARGIN)
        constant = (color[:, None, :3] - 0.5) / SH_C0
        rest = restore(self.rest.astype(np.uint32), self.bounds.rest, 8)
        return Cloud(
            means=means.astype(np.float32),
            quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
            log_scales=log_scales.astype(np.float32),
            logit_opacities=np.log(opacities / (1 - opacities)).astype(np.float32),
            sh=np.concatenate([constant, rest], 1).astype(np.float32),
            is_dynamic=np.full(len(self), is_dynamic),
        )


@dataclass(frozen=True)
class Baked:
    """A scene over K key times, evenly spread over [0, 1]."""

    keys: int
    static: Branch
    dynamic: Branch

    def at(self, time: float) -> Cloud:
        """The Gaussians at a moment, static ones first."""
        position = time * (self.keys - 1)
        parts = [self.static.at(position, False), self.dynamic.at(position, True)]
        names = ("means", "quats", "log_scales", "logit_opacities", "sh", "is_dynamic")
        return Cloud(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


def bake(at: Callable[[float], Cloud], times: Iterable[float]) -> Baked:
    """A scene over key times; Gaussians that are not finite at one of them are left out.

    Args:
        at: The scene at a moment, in the same rows at every moment.
        times: At least one, evenly spread over [0, 1].
    """
    static_colors, dynamic, finite = [], [], np.ones(1, bool)
    for time in times:
        cloud = at(time)
        finite = finite & cloud.finite
        moves = cloud.is_dynamic
        static_colors.append(_color(cloud.select(~moves)).astype(np.float16))  # 11 bits: more than are kept
        dynamic.append([part[moves] for part in (cloud.means, cloud.quats, cloud.log_scales)])
    still, moving = cloud.select(~moves & finite), cloud.select(moves & finite)
    tracks = [np.stack(parts)[:, finite[moves]] for parts in zip(*dynamic, strict=True)]
    geometry = [part[None] for part in (still.means, still.quats, still.log_scales)]
    return Baked(
        len(dynamic),
        _branch(geometry, np.stack(static_colors)[:, finite[~moves]], still.sh[:, 1:]),
        _branch(tracks, _color(moving)[None], moving.sh[:, 1:]),
    )


def baked_bytes(num_static: int, num_dynamic: int, keys: int, rest: int) -> int:
    """Memory that a page takes for its Gaussians, before compression."""
    geometry, color = 4 * WORDS, 4
    return num_static * (geometry + keys * color + 3 * rest) + num_dynamic * (keys * geometry + color + 3 * rest)


def _color(cloud: Cloud) -> np.ndarray:
    """[N, 4] constant colour and opacity."""
    opacities = 1.0 / (1.0 + np.exp(-cloud.logit_opacities[:, None]))
    return np.concatenate([np.clip(0.5 + SH_C0 * cloud.sh[:, 0], *COLORS), opacities], 1)


def _branch(geometry: list[np.ndarray], colors: np.ndarray, rest: np.ndarray) -> Branch:
    means, quats, log_scales = geometry
    rest = np.clip(rest, *REST)
    sizes = _ends(log_scales)
    bounds = Bounds(
        np.stack([_ends(means[..., a]) for a in range(3)], 1),
        np.maximum(sizes, sizes[1] - SCALE_SPAN),
        _ends(colors[..., :3]),
        _ends(rest),
    )
    numbers = quantise(means, bounds.means, MEAN_BITS)
    x, y, z = (numbers[..., a] for a in range(3))
    scales = quantise(np.maximum(log_scales, bounds.log_scales[0]), bounds.log_scales, SCALE_BITS)
    words = [
        x << np.uint32(LOW_X) | y >> np.uint32(MEAN_BITS - LOW_X),
        (y & np.uint32((1 << (MEAN_BITS - LOW_X)) - 1)) << np.uint32(MEAN_BITS) | z,
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


def _ends(values: np.ndarray) -> np.ndarray:
    """Lowest and highest value, zeros of none."""
    return np.array([values.min(), values.max()], np.float64) if values.size else np.zeros(2)


def _around(frames: np.ndarray, position: float) -> tuple[np.ndarray, np.ndarray]:
    """The frames before and after; the same one where there is but one."""
    before = min(int(position), len(frames) - 1)
    return frames[before], frames[min(before + 1, len(frames) - 1)]


def _mixed(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    return a * (1 - share) + b * share


def _geometry(bounds: Bounds, words: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    high, low = unpack(words[:, 0], (MEAN_BITS, LOW_X)), unpack(words[:, 1], (MEAN_BITS - LOW_X, MEAN_BITS))
    y = high[:, 1] << np.uint32(MEAN_BITS - LOW_X) | low[:, 0]
    means = restore(np.stack([high[:, 0], y, low[:, 1]], 1), bounds.means, MEAN_BITS)
    scales = restore(unpack(words[:, 3], (SCALE_BITS,) * 3), bounds.log_scales, SCALE_BITS)
    return means, unpack_rotations(words[:, 2]).astype(np.float64), scales


def _colors(bounds: Bounds, numbers: np.ndarray) -> np.ndarray:
    rgb = restore(numbers[:, :3].astype(np.uint32), bounds.colors, 8)
    return np.concatenate([rgb, numbers[:, 3:] / 255.0], 1)
