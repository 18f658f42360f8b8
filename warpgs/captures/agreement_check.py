"""Whether the cameras of a capture agree: what two of them see at a time lies on the epipolar lines of their poses."""

from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse.csgraph import minimum_spanning_tree

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.resized import size_within
from warpgs.data.sampling import evenly_spaced
from warpgs.data.turning import Matches

from .features import find_features, match
from .findings import Finding, few_of
from .motion_check import MAX_EPIPOLAR_DISTANCE

COMPARED_SIDE = 768
"""Images are scaled down to this longer side [px]."""

NUM_MOMENTS = 3
"""Number of times at which two cameras are compared."""

MIN_MATCHES, MIN_KEPT = 15, 20
"""Minimum number of matches of two frames, and of those of two cameras that fit some epipolar geometry: by chance, it
fits about ten of them."""

MIN_BASELINE = 1e-3
"""Distance of two cameras over that of the two farthest ones, below which they have no epipolar lines."""


EPSILON = 1e-6
"""What rounding may add to a time in [0, 1]."""


class Compared(NamedTuple):
    """Two cameras to compare, and pairs of their frames, each of nearly one time."""

    first: int
    second: int
    frames: list[tuple[str, str]]

    def of(self, names: Collection[str]) -> "Compared":
        """The same with pairs of these frames only."""
        return self._replace(frames=[(a, b) for a, b in self.frames if a in names and b in names])


def cameras_to_compare(capture: Capture, max_count: int) -> list[Compared]:
    """Pairs of cameras with similar views, which connect all of them, at most ``max_count``; none if there is one."""
    cameras = capture.by_camera([*capture.train, *capture.val])
    ids, first = [*cameras], [capture.cameras[frames[0]] for frames in cameras.values()]
    centers = torch.stack([camera.position for camera in first])
    distances = torch.cdist(centers, centers).double().numpy()
    extent = float(distances.max())
    if extent == 0.0:
        return []
    forward = torch.stack([camera.viewmat[2, :3] for camera in first]).double().numpy()
    apart = np.arccos(np.clip(forward @ forward.T, -1.0, 1.0)) + distances / extent + 1e-9
    np.fill_diagonal(apart, 0.0)
    found = []
    for i, j in sorted(zip(*minimum_spanning_tree(apart).nonzero(), strict=True)):
        a, b = ids[min(i, j)], ids[max(i, j)]
        pairs = _at_one_time(capture, cameras[a], cameras[b], MIN_BASELINE * extent)
        found.append(Compared(a, b, evenly_spaced(pairs, NUM_MOMENTS)))
    return evenly_spaced(found, max_count)


def _at_one_time(
    capture: Capture, first: Sequence[str], second: Sequence[str], min_baseline: float
) -> list[tuple[str, str]]:
    """Each frame of a camera with the one of another that is nearest in time, at most an interval of the latter away.

    While a camera films, it is at most half an interval away; where a frame is missing, a whole one. Pairs whose
    cameras are at one place are omitted.
    """
    times = np.array([capture.cameras[name].time for name in second])
    interval = float(np.median(np.diff(times))) if len(times) > 1 else capture.interval
    nearest = [(a, np.abs(times - capture.cameras[a].time)) for a in first]
    pairs = [(a, second[int(away.argmin())]) for a, away in nearest if away.min() <= interval + EPSILON]
    centers = {name: capture.cameras[name].position for pair in pairs for name in pair}
    return [(a, b) for a, b in pairs if float((centers[a] - centers[b]).norm()) > min_baseline]


def check_agreement(capture: Capture, compared: Sequence[Compared]) -> Iterator[Finding]:
    """Compares cameras by what both see in static regions.

    Args:
        capture: The capture.
        compared: ``cameras_to_compare`` of it.
    """
    agreeing, unknown, distances = [], [], list[float]()
    for first, second, frames in compared:
        found = _distance(capture, frames)
        if found is None:
            unknown.append(f"{first} and {second}")
        elif found > MAX_EPIPOLAR_DISTANCE:
            text = f"what cameras {first} and {second} both see is {found:.1f} px off their epipolar lines (median)"
            yield Finding("warning", "cameras", f"{text}: the pose or the lens of one of them is wrong")
        else:
            agreeing.append(f"{first} and {second}")
            distances.append(found)
    if agreeing:
        text = f"what they both see is {np.median(distances):.2f} px off their epipolar lines (median)"
        yield Finding("note", "cameras", f"cameras {few_of(agreeing)} agree: {text}")
    if unknown:
        yield Finding("note", "cameras", f"cameras {few_of(unknown)} see too little alike at one time to be compared")


def _distance(capture: Capture, pairs: Sequence[tuple[str, str]]) -> float | None:
    """Median distance of what frames of two cameras see from their epipolar lines [px]; None if that is too little."""
    found = []
    for pair in pairs:
        frames = [capture.frame(name) for name in pair]
        sizes = [size_within(frame.camera.size, COMPARED_SIDE) for frame in frames]
        a, b = (find_features(frame, size) for frame, size in zip(frames, sizes, strict=True))
        if (matches := match(a, b, MIN_MATCHES)) is not None:
            first, second = (f.camera.resized(*size).pinhole for f, size in zip(frames, sizes, strict=True))
            found.append(_epipolar_distances(first, second, matches))
    distances = np.concatenate([np.zeros(0), *found])
    return float(np.median(distances)) if len(distances) >= MIN_KEPT else None


def _epipolar_distances(a: Camera, b: Camera, matches: Matches) -> Float[np.ndarray, " M"]:
    """[M] Sampson's distances of matches in two pinhole cameras (Hartley and Zisserman, 11.4.3) [px]."""
    relative = b.viewmat.double().numpy() @ np.linalg.inv(a.viewmat.double().numpy())
    (x, y, z), rotation = relative[:3, 3], relative[:3, :3]
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ rotation
    k_a, k_b = (np.linalg.inv(camera.K.double().numpy()) for camera in (a, b))
    fundamental = k_b.T @ essential @ k_a
    p, q = (np.column_stack([positions, np.ones(len(positions))]) for positions in matches)
    lines, back = p @ fundamental.T, q @ fundamental
    slopes = np.linalg.norm(np.column_stack([lines[:, :2], back[:, :2]]), axis=1)
    return np.abs((q * lines).sum(1)) / np.maximum(slopes, 1e-12)
