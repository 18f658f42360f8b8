"""Dense triangulation: the depth of every pixel if the scene were static, and how badly that fits.

Optical flow gives the position of every pixel of a frame in other frames. With the pixel's ray X = (x, y, 1) and the
pose (R, T) of another frame relative to it, a static point of inverse depth ρ projects to the other frame's plane z = 1
at

    u = (Y₁ + ρ T₁) / (Y₃ + ρ T₃),  v = (Y₂ + ρ T₂) / (Y₃ + ρ T₃),   Y = R X,

two equations linear in ρ: ρ (u T₃ − T₁) = Y₁ − u Y₃, and the same for v. The equations of all frames are solved
together by iteratively reweighted least squares. Each is divided by its depth, so that errors are in pixels, and
weighted by 1 / |error|, so that the majority of the frames decides. The residual is motion, occlusion or wrong flow.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from warpgs.data.masks import nearest_pixels

NUM_REWEIGHTINGS = 5
"""Rounds of reweighting; more do not change the masks."""

FLOW_NOISE = 0.4
"""Standard deviation of good flow [px]."""

MAX_ERROR = 100.0
"""Errors are clamped to this [px]: those of points behind a camera have no meaning."""

MIN_OBSERVATIONS = 2

MIN_RELATIVE_DEPTH = 1e-2
"""Depth in another frame, relative to that in the pixel's own, below which a point counts as behind the camera."""


@dataclass(frozen=True)
class Observation:
    """Where another frame observes the pixels of a frame.

    Attributes:
        position: [2, H, W] u, v on the other frame's plane z = 1.
        rotated: [3, H, W] Y, the pixels' rays in the other frame's axes.
        translation: [3] T, from the frame to the other.
        visible: [H, W] whether the position is reliable.
    """

    position: Float[np.ndarray, "2 H W"]
    rotated: Float[np.ndarray, "3 H W"]
    translation: Float[np.ndarray, "3"]
    visible: Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class LocalGeometry:
    """Depth of a frame's pixels, triangulated from other frames.

    Attributes:
        inverse_depth: [H, W] ρ in the units of the poses; NaN where fewer than two frames see the pixel.
        sigma: [H, W] standard deviation of ρ.
        residual: [H, W] mean distance of the observed positions from those of the static point [px]; NaN as above.
    """

    inverse_depth: Float[np.ndarray, "H W"]
    sigma: Float[np.ndarray, "H W"]
    residual: Float[np.ndarray, "H W"]


def errors(observation: Observation, rho: Float[np.ndarray, "H W"], focal: float) -> Float[np.ndarray, "H W"]:
    """[H, W] distance of the observed positions from those of static points of inverse depth ρ [px]."""
    o = observation
    depth = np.maximum(o.rotated[2] + rho * o.translation[2], MIN_RELATIVE_DEPTH)
    dx = (o.rotated[0] + rho * o.translation[0]) / depth - o.position[0]
    dy = (o.rotated[1] + rho * o.translation[1]) / depth - o.position[1]
    return np.minimum(np.float32(focal) * np.sqrt(dx * dx + dy * dy), MAX_ERROR)


def triangulate(observations: Sequence[Observation], focal: float) -> LocalGeometry:
    """Inverse depth of every pixel of a frame from its positions in other frames.

    Args:
        observations: At least one.
        focal: Focal length, which converts errors to pixels.
    """
    shape = observations[0].visible.shape
    rho = np.full(shape, 1e-3, np.float32)
    weights = [o.visible.astype(np.float32) for o in observations]
    # The squares and products of an observation's two equations, without the weights and depths that change.
    squares, products = [], []
    for o in observations:
        slopes = [o.position[axis] * o.translation[2] - o.translation[axis] for axis in (0, 1)]
        sides = [o.rotated[axis] - o.position[axis] * o.rotated[2] for axis in (0, 1)]
        squares.append(slopes[0] * slopes[0] + slopes[1] * slopes[1])
        products.append(slopes[0] * sides[0] + slopes[1] * sides[1])
    for _ in range(NUM_REWEIGHTINGS):
        top, bottom = np.zeros(shape, np.float32), np.full(shape, 1e-12, np.float32)
        for o, weight, square, product in zip(observations, weights, squares, products, strict=True):
            depth = np.maximum(o.rotated[2] + rho * o.translation[2], MIN_RELATIVE_DEPTH)
            weight = weight / (depth * depth)
            top += weight * product
            bottom += weight * square
        rho = np.maximum(top / bottom, 1e-6)
        distances = [errors(o, rho, focal) for o in observations]
        weights = [o.visible / np.maximum(e, FLOW_NOISE) for o, e in zip(observations, distances, strict=True)]
    count = np.sum([o.visible for o in observations], axis=0)
    total = np.sum([e * o.visible for o, e in zip(observations, distances, strict=True)], axis=0)
    residual = total / np.maximum(count, 1)
    noise = np.maximum(residual, FLOW_NOISE)
    # bottom holds slope² / noise, so bottom · noise is the information of unit weights.
    sigma = noise / (focal * np.sqrt(bottom * noise))
    unknown = count < MIN_OBSERVATIONS
    rho[unknown], residual[unknown] = np.nan, np.nan
    return LocalGeometry(rho, sigma.astype(np.float32), residual.astype(np.float32))


def fill_unknown(values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """[H, W] the plane with every NaN replaced by the nearest number; zeros if there is none."""
    unknown = np.isnan(values)
    if unknown.all():
        return np.zeros_like(values)
    if not unknown.any():
        return values
    nearest, _ = nearest_pixels(~unknown)
    return values.ravel()[nearest]
