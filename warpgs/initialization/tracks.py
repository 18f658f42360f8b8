"""Tracks of small objects that move far between frames, as the start of what deforms.

Where an object moves farther than its size from frame to frame, comparing colours where it is not says nothing about
where it is: Gaussians become transparent instead of following. But the rays through the centres of its silhouettes fix
its path (trajectory triangulation, Park et al. 2010): the one that most rays meet and that is smooth, a spline with a
penalty on differences of its coefficients (P-splines, Eilers and Marx 1996).
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded

from warpgs.data.capture import Capture
from warpgs.views.part import SomeViews

from .silhouettes import MIN_PIXELS, Region, find_regions

MIN_REGIONS = 12
"""Minimum number of regions that a track is found from."""

MIN_PART = 0.15
"""Fraction of a region's pixels from which on their colours make a part of it."""

SHOWING_ALL = 0.75
"""Quantile of the frames' numbers of regions that is the number of objects: in many frames, one hides another."""

DEGREE, ORDER = 3, 5
"""Degree of the splines; order of the differences that are penalized (3 made paths up to ten times less precise)."""

SMOOTHNESS = 10.0 ** np.arange(-7, 2)
"""Weights of the penalty among which cross-validation chooses."""

NUM_ROUNDS, NUM_FOLDS = 8, 5
"""Rounds in which rays that miss are weighted down (Cauchy), and parts of the cross-validation."""

MIN_SCALE = 0.1
"""Minimum scale of that loss, in radii: centres of silhouettes are not more precise. Without it, right rays are lost
where a path bends."""

MAX_MISS, MAX_ERROR = 0.5, 1.0
"""Distance, in radii, up to which a ray meets a path; mean distance of rays that a path was found without, above which
it is none: 0.1 to 0.7 of one ball, hidden now and then, 1.9 of two of similar colours."""

MIN_BEND = 1.0
"""Minimum median of the second differences of the camera centres, relative to the first ones: the path of a camera that
moves evenly would meet all of its rays. 0.03 to 0.31 in orbits, 1.7 of a camera at random points."""

MAX_OBJECTS = 32
"""Maximum number of objects that are tracked."""

MIN_STEP = 0.5
"""Median movement from frame to frame, in diameters, from which on tracks are used."""


@dataclass(frozen=True)
class Track:
    """The path of an object.

    Attributes:
        path: Its position [3] over time [scene units].
        radius: Of a ball that looks as large [scene units].
        regions: The regions that show it.
    """

    path: BSpline
    radius: float
    regions: list[Region]


def find_tracks(capture: Capture, views: SomeViews) -> list[Track]:
    """Tracks of the objects that a capture shows before transparent surroundings, one per colour.

    Returns:
        None at all if the camera moves evenly, if there are too few regions or too many objects, if one of them has no
        path, or if they move little from frame to frame.
    """
    if capture.assumption != "dynamic" or not capture.has_empty or not _jumps(capture):
        return []
    by_frame = find_regions(views)
    regions = [region for of_frame in by_frame for region in of_frame]
    count = int(np.quantile([len(of_frame) for of_frame in by_frame], SHOWING_ALL))
    if not 0 < count <= MAX_OBJECTS or len(regions) < MIN_REGIONS * count:
        return []
    labels = _by_color(np.array([region.lab for region in regions]), count)
    regions, labels = _divided(regions, labels, count)
    tracks = []
    for label in range(count):
        track = _track([regions[k] for k in np.flatnonzero(labels == label)], len(capture.moments))
        if track is None:
            return []
        tracks.append(track)
    steps = [np.linalg.norm(np.diff(t.path(capture.moments), axis=0), axis=1) / (2.0 * t.radius) for t in tracks]
    return tracks if np.median(steps) >= MIN_STEP else []


def _jumps(capture: Capture) -> bool:
    """Whether there are several cameras, or one that is elsewhere in every frame instead of moving evenly or not.

    The rays of two cameras at one time meet at the object, however either moves.
    """
    if len(capture.moments) < MIN_REGIONS:
        return False
    if len(capture.by_camera(capture.train)) > 1:
        return True
    cameras = sorted((capture.cameras[name] for name in capture.train), key=lambda camera: camera.time)
    centers = np.stack([camera.position.numpy() for camera in cameras])
    step, bend = (np.median(np.linalg.norm(np.diff(centers, order, axis=0), axis=1)) for order in (1, 2))
    return bool(bend > MIN_BEND * step)


def _by_color(colors: Float[np.ndarray, "R 3"], count: int) -> np.ndarray:
    cv2.setRNGSeed(0)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 0.1)
    return cv2.kmeans(colors.astype(np.float32), count, None, stop, 10, cv2.KMEANS_PP_CENTERS)[1].ravel()


def _divided(regions: list[Region], labels: np.ndarray, count: int) -> tuple[list[Region], np.ndarray]:
    """The regions and their labels, with those of several objects divided by the colours of their pixels.

    Pixels go to the most likely of normal distributions, one per label, of the regions whose colours are most typical.
    """
    lab = np.array([region.lab for region in regions])
    models = []
    for label in range(count):
        chosen = np.flatnonzero(labels == label)
        distance = np.linalg.norm(lab[chosen] - np.median(lab[chosen], 0), axis=1)
        colors = np.concatenate([regions[k].colors for k in chosen[distance <= np.median(distance)]])
        models.append((colors.mean(0), np.linalg.inv(np.cov(colors.T) + 1e-4 * np.eye(3))))
    parts: list[Region] = []
    found: list[int] = []
    for region in regions:
        costs = [
            np.einsum("pi,ij,pj->p", region.colors - mean, precision, region.colors - mean)
            - np.log(np.linalg.det(precision))
            for mean, precision in models
        ]
        likeliest = np.argmin(costs, axis=0)
        counts = np.bincount(likeliest, minlength=count)
        shown = np.flatnonzero(counts >= max(MIN_PIXELS, MIN_PART * counts.sum()))
        found += shown.tolist()
        parts += [region.part(likeliest == label) for label in shown] if len(shown) > 1 else [region] * len(shown)
    return parts, np.array(found)


def _track(regions: list[Region], num_times: int) -> Track | None:
    """The smooth path that most rays of some regions meet; None if they are too few or meet none."""
    if len(regions) < MIN_REGIONS:
        return None
    fit = _Fit(regions, num_times)
    error, smoothness = min((fit.error(smoothness), smoothness) for smoothness in SMOOTHNESS)
    path, misses = fit.path(smoothness)
    radius = fit.radius(path)
    if error > MAX_ERROR * radius:
        return None
    shown = [region for region, miss in zip(regions, misses, strict=True) if miss <= MAX_MISS * radius]
    return Track(path, radius, shown) if len(shown) >= MIN_REGIONS else None


class _Fit:
    """Weighted least squares for the coefficients of a path: a banded system, as each ray concerns four of them."""

    def __init__(self, regions: list[Region], num_times: int) -> None:
        self.knots = np.arange(-DEGREE, num_times + DEGREE) / (num_times - 1)
        self.times = np.array([region.time for region in regions]).clip(0.0, 1.0)
        self.origins, self.rays = (np.array([getattr(r, name) for r in regions]) for name in ("origin", "center"))
        self.angles = np.array([region.radius for region in regions])
        self.everything = np.ones(len(regions), bool)
        basis = BSpline.design_matrix(self.times, self.knots, DEGREE)
        values, self.size = basis.data.reshape(len(regions), -1), 3 * basis.shape[1]
        # The squared distance of x from a ray is (x − o)ᵀ (I − d dᵀ) (x − o).
        across = np.eye(3) - self.rays[:, :, None] * self.rays[:, None, :]
        blocks = np.einsum("ri,rj,rab->riajb", values, values, across)
        targets = np.einsum("ri,rab,rb->ria", values, across, self.origins)
        unknowns = (3 * basis.indices.reshape(values.shape)[:, :, None] + np.arange(3)).reshape(len(regions), -1)
        row, column = unknowns[:, :, None], unknowns[:, None, :]
        of_lower = (row >= column).reshape(len(regions), -1)[0]  # all regions have the same pattern
        self.blocks = blocks.reshape(len(regions), -1)[:, of_lower]
        self.band_indices = ((row - column) * self.size + column).reshape(len(regions), -1)[:, of_lower]
        self.targets, self.unknowns = targets.reshape(len(regions), -1), unknowns
        self.penalty = _difference_penalty(basis.shape[1])

    def path(self, smoothness: float, used: Bool[np.ndarray, " R"] | None = None) -> tuple[BSpline, np.ndarray]:
        """The path by the rays of some regions (of all if None), and the distances [R] of all rays from it."""
        used = self.everything if used is None else used
        weights = used.astype(float)
        for _ in range(NUM_ROUNDS):
            path = BSpline(self.knots, self._solve(smoothness, weights), DEGREE)
            misses = np.linalg.norm(np.cross(path(self.times) - self.origins, self.rays), axis=1)
            scale = max(1.5 * float(np.median(misses[used])), MIN_SCALE * self.radius(path))
            weights = used / (1.0 + (misses / scale) ** 2)
        return path, misses

    def _solve(self, smoothness: float, weights: Float[np.ndarray, " R"]) -> Float[np.ndarray, "C 3"]:
        band = smoothness * self.penalty
        band[0] += 1e-9  # where no ray is
        blocks, targets = weights[:, None] * self.blocks, weights[:, None] * self.targets
        band += np.bincount(self.band_indices.ravel(), blocks.ravel(), band.size).reshape(band.shape)
        right = np.bincount(self.unknowns.ravel(), targets.ravel(), self.size)
        return solveh_banded(band, right, lower=True).reshape(-1, 3)

    def error(self, smoothness: float) -> float:
        """Mean distance, at most a diameter, of rays from the path by the others."""
        part = np.arange(len(self.times)) % NUM_FOLDS
        misses = np.concatenate([self.path(smoothness, part != k)[1][part == k] for k in range(NUM_FOLDS)])
        return float(np.minimum(misses, 2.0 * self.radius(self.path(smoothness)[0])).mean())

    def radius(self, path: BSpline) -> float:
        """Radius of a ball that looks as large as the regions [scene units]."""
        return float(np.median(self.angles * np.linalg.norm(path(self.times) - self.origins, axis=1)))


def _difference_penalty(count: int) -> Float[np.ndarray, "B D"]:
    """Lower bands of DᵀD for the differences D of ``count`` points with three coordinates each."""
    weights = [(-1.0) ** k * math.comb(ORDER, k) for k in range(ORDER + 1)]
    differences = sparse.diags_array(weights, offsets=range(ORDER + 1), shape=(count - ORDER, count))
    product = (differences.T @ differences).tocsr()
    bands = np.zeros((3 * ORDER + 1, 3 * count))
    for k in range(ORDER + 1):
        bands[3 * k, : 3 * (count - k)] = np.repeat(product.diagonal(-k), 3)
    return bands
