"""A dynamic scene at several key times, quantised to integers: what a page plays.

Static Gaussians have one geometry, and a colour and an opacity per key time; dynamic Gaussians have a geometry per key
time and one colour, but an opacity per key time where they have segments of time. Both are stored as coefficients over
the key times (``transform``), along a Morton curve, colours as luma and two chroma (YCoCg), in coarser steps for
Gaussians that are hardly visible. Between key times, means, colours and logarithms of scales are interpolated linearly;
rotations too, and are then normalised.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int32
from scipy.spatial.transform import Rotation

from warpgs.formats.cloud import ARRAYS, Cloud, logit, sigmoid
from warpgs.formats.compressed import morton_order
from warpgs.model.gaussians import SH_C0

from .transform import Levels

STEPS = {
    "means": (1 / 6, 1 / 7),
    "rotations": (1 / 70, 1 / 50),
    "log_scales": (1 / 6, 1 / 16),
    "colors": (1 / 100, 1 / 160),
    "opacities": (1 / 100, 1 / 100),
    "rest": (1 / 27, 1 / 38),
}
"""Steps of static and dynamic Gaussians, for values that are the same at all times (docs/design/page-size.md). Those of
means are fractions of the size of small Gaussians (10th percentile of the longest standard deviation); those of chroma
are twice as coarse. A coefficient of K times spreads its error over all of them, so its step is √K times as coarse."""

SCALES = (-7.0, 9.0)
"""Bounds of log-scales, from that of the median Gaussian's longest axis: an axis that is e⁷ times shorter is flat, and
one Gaussian of absurd size must not take the precision of all others."""

COLORS = (-1.0, 2.0)
REST = (-2.0, 2.0)
"""Bounds of colours and of coefficients of degree 1 and higher, far beyond what a screen shows."""

YCOCG = np.array([[0.25, 0.5, 0.25], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]])
"""Converts red, green and blue to luma and two chroma, which neighbours share more of."""

CHROMA = (1.0, 2.0, 2.0)
"""Factors of the steps of luma and chroma."""

MAX_OCTAVES = 5
"""Steps of colours are at most 2⁵ times finer or coarser than those of a Gaussian of average visibility."""

MIN_WEIGHT = 0.01
"""Blend weight added to all, as a fraction of the median of visible Gaussians: the others may be seen later."""

TEXEL = {"geometry": 16, "colors": 4, "rest": 4}
"""Bytes that the player's textures take per Gaussian: of one time, of one time, and of one coefficient."""

PARTS = ("means", "rotations", "log_scales", "colors", "opacities", "rest")


@dataclass(frozen=True)
class Branch:
    """The static or the dynamic Gaussians.

    Attributes:
        means: [1 or K, N, 3] centres [scene units].
        rotations: [K, N, 4] quaternions, of any length, whose signs agree over time; or [1, N, 3] x, y, z of unit
            quaternions with w ≥ 0.
        log_scales: [1 or K, N, 3].
        colors: [K or 1, N, 3] luma and chroma of the constant coefficient.
        opacities: [K or 1, N, 1], as many times as ``colors`` has.
        rest: [R, N, 3] luma and chroma of the coefficients of degree 1 and higher, the same at all times.
    """

    means: Levels
    rotations: Levels
    log_scales: Levels
    colors: Levels
    opacities: Levels
    rest: Levels

    def __len__(self) -> int:
        return self.means.levels.shape[1]

    @property
    def octaves(self) -> Int32[np.ndarray, " N"]:
        """The exponents of each Gaussian's steps of ``colors`` and ``rest``."""
        return self.rest.octaves

    @cached_property
    def _values(self) -> dict[str, np.ndarray]:
        """The values of all parts, rotations with four components."""
        values = {name: getattr(self, name).values for name in PARTS}
        rotations = values["rotations"]
        if rotations.shape[2] == 3:
            w = np.sqrt(np.maximum(0.0, 1.0 - (rotations**2).sum(2, keepdims=True)))
            values["rotations"] = np.concatenate([w, rotations], 2)
        return values

    def at(self, position: float, is_dynamic: bool) -> Cloud:
        """The Gaussians at a position between key times, where key k is at position k."""
        now = {name: _interpolated(values, position) for name, values in self._values.items() if name != "rest"}
        constant = (now["colors"] @ np.linalg.inv(YCOCG).T - 0.5) / SH_C0
        rest = self._values["rest"].transpose(1, 0, 2) @ np.linalg.inv(YCOCG).T
        return Cloud(
            means=now["means"].astype(np.float32),
            quats=_normalized(now["rotations"]).astype(np.float32),
            log_scales=now["log_scales"].astype(np.float32),
            logit_opacities=logit(now["opacities"][:, 0]).astype(np.float32),
            sh=np.concatenate([constant[:, None], rest], 1).astype(np.float32),
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


def bake(
    cloud_at: Callable[[float], Cloud],
    times: Iterable[float],
    precision: float = 1.0,
    weights: Float32[np.ndarray, " N"] | None = None,
) -> Baked:
    """Quantises a scene at key times; Gaussians with values that are not finite at any of them are omitted.

    Args:
        cloud_at: The scene at a time, in the same rows at every time.
        times: At least one, evenly spaced over [0, 1].
        precision: All steps of quantisation are divided by it.
        weights: How visible each Gaussian is, in any unit (``contribution``); the same for all if None.
    """
    static_colors, dynamic_colors, dynamic_geometry, finite = [], [], [], np.ones(1, bool)
    for time in times:
        cloud = cloud_at(time)
        finite = finite & cloud.finite
        is_dynamic = cloud.is_dynamic
        static_colors.append(_color(cloud.select(~is_dynamic)))
        dynamic_colors.append(_color(cloud.select(is_dynamic)))
        dynamic_geometry.append([part[is_dynamic] for part in (cloud.means, cloud.quats, cloud.log_scales)])
    static, dynamic = cloud.select(~is_dynamic & finite), cloud.select(is_dynamic & finite)
    weights = np.ones(len(cloud), np.float32) if weights is None else weights
    octaves = [octaves_of(weights[rows & finite]) for rows in (~is_dynamic, is_dynamic)]
    tracks = [np.stack(parts)[:, finite[is_dynamic]] for parts in zip(*dynamic_geometry, strict=True)]
    geometry = [part[None] for part in (static.means, static.quats, static.log_scales)]
    steps = [{name: pair[branch] / precision for name, pair in STEPS.items()} for branch in (0, 1)]
    if all(np.array_equal(colors, dynamic_colors[0], equal_nan=True) for colors in dynamic_colors):
        dynamic_colors = dynamic_colors[:1]
    return Baked(
        len(dynamic_geometry),
        _branch(geometry, np.stack(static_colors)[:, finite[~is_dynamic]], static.sh[:, 1:], octaves[0], steps[0]),
        _branch(tracks, np.stack(dynamic_colors)[:, finite[is_dynamic]], dynamic.sh[:, 1:], octaves[1], steps[1]),
    )


def octaves_of(weights: Float32[np.ndarray, " N"]) -> Int32[np.ndarray, " N"]:
    """The exponents of steps for which the errors of all Gaussians change images equally.

    The squared error of images is about the error of a colour squared times the blend weight, so steps are inverse to
    its square root.
    """
    if not weights.any():  # nothing is known of the steps
        return np.zeros(len(weights), np.int32)
    weights = weights.astype(np.float64) + MIN_WEIGHT * np.median(weights[weights > 0])
    octaves = -0.5 * np.log2(weights)
    return np.clip(np.rint(octaves - octaves.mean()), -MAX_OCTAVES, MAX_OCTAVES).astype(np.int32)


def texture_bytes(num_static: int, num_dynamic: int, keys: int, rest: int, fades: bool = False) -> int:
    """Memory of the player's textures for a page [bytes], with ``rest`` coefficients beyond degree 0.

    ``fades`` says whether dynamic opacities change over time.
    """
    geometry, color, rest = TEXEL["geometry"], TEXEL["colors"], TEXEL["rest"] * rest
    return num_static * (geometry + keys * color + rest) + num_dynamic * (
        keys * geometry + (keys if fades else 1) * color + rest
    )


def _color(cloud: Cloud) -> np.ndarray:
    """[N, 4] colour of the constant coefficient, and opacity."""
    return np.concatenate([np.clip(0.5 + SH_C0 * cloud.sh[:, 0], *COLORS), sigmoid(cloud.logit_opacities[:, None])], 1)


def _branch(
    geometry: list[np.ndarray],
    colors: np.ndarray,
    rest: np.ndarray,
    octaves: np.ndarray,
    steps: Mapping[str, float],
) -> Branch:
    order = morton_order(geometry[0][0])
    means, quats, log_scales = (part[:, order].astype(np.float64) for part in geometry)
    colors, rest = colors[:, order].astype(np.float64), np.clip(rest[order], *REST).astype(np.float64)
    size = np.quantile(np.exp(log_scales[0].max(1)), 0.1) if len(order) else 1.0
    if len(log_scales) == 1:
        turned, axes = nearest_to_identity(quats[0])
        rotations, log_scales = turned[None, :, 1:], np.take_along_axis(log_scales, axes[None], 2)
    else:
        rotations = _signs_aligned(quats)
    middle = np.median(log_scales[0].max(1)) if len(order) else 0.0
    log_scales = np.clip(log_scales, middle + SCALES[0], middle + SCALES[1])

    def over_time(values: np.ndarray, step: float | np.ndarray, octaves: np.ndarray | None = None) -> Levels:
        return Levels.of(values, np.full(values.shape[2], step * np.sqrt(len(values))), octaves)

    chroma, octaves = np.array(CHROMA), octaves[order]
    return Branch(
        means=over_time(means, steps["means"] * size),
        rotations=over_time(rotations, steps["rotations"]),
        log_scales=over_time(log_scales, steps["log_scales"]),
        colors=over_time(colors[..., :3] @ YCOCG.T, chroma * steps["colors"], octaves),
        opacities=over_time(colors[..., 3:], steps["opacities"]),
        rest=Levels.of((rest @ YCOCG.T).transpose(1, 0, 2), chroma * steps["rest"], octaves, over_time=False),
    )


def nearest_to_identity(quats: Float64[np.ndarray, "N 4"]) -> tuple[np.ndarray, np.ndarray]:
    """Names the axes of ellipsoids so that their rotations are as small as possible.

    Args:
        quats: Unit quaternions (w, x, y, z).

    Returns:
        [N, 4] unit quaternions with w ≥ 0.85, and the [N, 3] axis of the given one that each new axis is.
    """
    cube = Rotation.create_group("O")  # what maps axes to axes
    group = np.roll(cube.as_quat(), 1, axis=1)
    best = np.abs(quats @ (group * (1.0, -1.0, -1.0, -1.0)).T).argmax(1) if len(quats) else np.zeros(0, np.int64)
    axes = np.abs(cube.as_matrix()).argmax(1)[best]
    (a, *u), (b, *v) = quats.T, group[best].T
    u, v = np.stack(u, 1), np.stack(v, 1)
    w = a * b - (u * v).sum(1)
    turned = np.concatenate([w[:, None], a[:, None] * v + b[:, None] * u + np.cross(u, v)], 1)
    return turned * np.where(w < 0, -1.0, 1.0)[:, None], axes


def _signs_aligned(quats: Float64[np.ndarray, "K N 4"]) -> Float64[np.ndarray, "K N 4"]:
    """The same rotations, each quaternion on the side of the one before: q and −q are the same rotation."""
    turns = np.where((quats[1:] * quats[:-1]).sum(2, keepdims=True) < 0, -1.0, 1.0)
    return quats * np.concatenate([np.ones_like(quats[:1, :, :1]), np.cumprod(turns, 0)])


def _interpolated(keys: np.ndarray, position: float) -> np.ndarray:
    """Values at a position between keys, or the only ones."""
    before = min(int(position), len(keys) - 1)
    fraction = position - before if len(keys) > 1 else 0.0
    return keys[before] * (1 - fraction) + keys[min(before + 1, len(keys) - 1)] * fraction


def _normalized(quats: np.ndarray) -> np.ndarray:
    return quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)  # 1e-12: of opposite rotations
