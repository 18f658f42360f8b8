"""Tells from a capture's images whether its camera only turns, whatever its cameras say."""

import itertools
from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import torch

from warpgs.data.capture import Capture, Frame
from warpgs.data.optical_flow import grey_levels
from warpgs.data.resized import size_within
from warpgs.data.turning import MIN_MATCHES, Matches, Turning, find_turning

from .findings import Finding

COMPARED_SIDE = 512
"""Images are scaled down to this longer side [px]."""

MAX_STEP = 4
"""Frames are matched with this many of the next sampled ones: with those far away they share less."""

MAX_FEATURES = 1000

MAX_RATIO = 0.8
"""Distance of the best match over that of the second (Lowe 2004)."""

MAX_EPIPOLAR_ERROR = 2.0
"""Maximum distance of a match from its epipolar line, above which it does not count [px]."""


def check_turning(capture: Capture, names: Sequence[str]) -> Iterator[Finding]:
    """Whether the images show parallax at all."""
    found = turning_of([capture.frame(name) for name in names])
    if found is None or not any(turning.only_turns for turning in found):
        return
    searched, known = (f"{turning.explained:.0%}" for turning in found)
    if all(turning.only_turns for turning in found):
        text = (
            f"the camera only turns: a rotation explains {searched} of the matches between frames, so depth and "
            "positions are undetermined; move the camera sideways"
        )
        # Cameras that all stand at one place say so themselves, as those of warpgs prepare --camera turning do.
        yield Finding("warning" if capture.hardly_moves else "error", "cameras", text)
    else:
        text = (
            f"a rotation explains {searched} of the matches between frames with the best focal length, {known} with "
            "that of the cameras: the camera only turns and its focal length is wrong, or it moves before a plane"
        )
        yield Finding("warning", "cameras", text)


def turning_of(frames: Sequence[Frame]) -> tuple[Turning, Turning] | None:
    """How well turning alone explains the images in static regions; None if that cannot be told.

    Args:
        frames: Some frames in temporal order, evenly spread.

    Returns:
        With the focal length that explains most, whatever the cameras say, and with that of the cameras.
    """
    sizes = {frame.camera.size for frame in frames}
    if len(sizes) != 1:
        return None
    size = size_within(sizes.pop(), COMPARED_SIDE)
    features = [_features(frame, size) for frame in frames]
    pairs = [p for p in itertools.combinations(range(len(frames)), 2) if p[1] - p[0] <= MAX_STEP]
    matches = [found for a, b in pairs if (found := _match(features[a], features[b])) is not None]
    focal = float(np.median([float(frame.camera.pinhole.resized(*size).K[0, 0]) for frame in frames]))
    searched, known = find_turning(matches, size), find_turning(matches, size, focal)
    return None if searched is None or known is None else (searched, known)


def _features(frame: Frame, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions [K, 2] without distortion and SIFT descriptors [K, 128] of an image's static region."""
    grey = grey_levels(frame, size)
    mask = None
    if frame.static_mask is not None:
        mask = cv2.resize(frame.static_mask.numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)
    points, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(grey, mask)
    positions = torch.tensor([point.pt for point in points], dtype=torch.float64).reshape(-1, 2) + 0.5
    camera = frame.camera.resized(*size)
    ideal, _, is_seen = camera.pinhole.place(camera.rays(positions))
    return ideal[is_seen].numpy(), None if descriptors is None else descriptors[is_seen.numpy()]


def _match(a: tuple[np.ndarray, np.ndarray | None], b: tuple[np.ndarray, np.ndarray | None]) -> Matches | None:
    """Matches that fit an epipolar geometry; None if there are too few."""
    if a[1] is None or b[1] is None or min(len(a[0]), len(b[0])) < MIN_MATCHES:
        return None
    candidates = cv2.BFMatcher().knnMatch(a[1], b[1], k=2)
    good = [best for best, second in candidates if best.distance < MAX_RATIO * second.distance]
    if len(good) < MIN_MATCHES:
        return None
    first, second = a[0][[m.queryIdx for m in good]], b[0][[m.trainIdx for m in good]]
    kept = _fit_epipolar_geometry(first, second)
    return None if kept is None else (first[kept], second[kept])


def _fit_epipolar_geometry(first: np.ndarray, second: np.ndarray) -> np.ndarray | None:
    """[K] whether each match is an inlier. COLMAP's RANSAC, as OpenCV's fails where a plane explains all matches."""
    import pycolmap  # takes 0.2 s

    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = MAX_EPIPOLAR_ERROR, 0
    options.min_num_trials, options.max_num_trials = 100, 10_000
    found = pycolmap.estimate_fundamental_matrix(first, second, options)
    return None if found is None else np.asarray(found["inlier_mask"], bool)
