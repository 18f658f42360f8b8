"""Features that two frames of a capture both show."""

import cv2
import numpy as np
import torch

from warpgs.data.capture import Frame
from warpgs.data.optical_flow import grey_levels
from warpgs.data.turning import Matches

MAX_FEATURES = 1000

MAX_RATIO = 0.8
"""Distance of the best match over that of the second (Lowe 2004)."""

MAX_EPIPOLAR_ERROR = 2.0
"""Maximum distance of a match from its epipolar line, above which it does not count [px]."""

Features = tuple[np.ndarray, np.ndarray | None]
"""Positions [K, 2] without distortion [px], and SIFT descriptors [K, 128]; None without features."""


def find_features(frame: Frame, size: tuple[int, int]) -> Features:
    """The features of a frame's static region, with its image resized to (width, height)."""
    grey = grey_levels(frame, size)
    mask = None
    if frame.static_mask is not None:
        mask = cv2.resize(frame.static_mask.numpy().astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT)
    points, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(grey, mask)
    positions = torch.tensor([point.pt for point in points], dtype=torch.float64).reshape(-1, 2) + 0.5
    camera = frame.camera.resized(*size)
    ideal, _, is_seen = camera.pinhole.place(camera.rays(positions))
    return ideal[is_seen].numpy(), None if descriptors is None else descriptors[is_seen.numpy()]


def match(a: Features, b: Features, min_matches: int) -> Matches | None:
    """Matches of two frames that fit an epipolar geometry; None if there are too few before."""
    if a[1] is None or b[1] is None or min(len(a[0]), len(b[0])) < min_matches:
        return None
    candidates = cv2.BFMatcher().knnMatch(a[1], b[1], k=2)
    good = [best for best, second in candidates if best.distance < MAX_RATIO * second.distance]
    if len(good) < min_matches:
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
