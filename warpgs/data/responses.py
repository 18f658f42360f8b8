"""How bright each of several cameras records the same surfaces, from the colours of sparse points."""

from collections.abc import Mapping

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .capture import Capture, Frame
from .sampling import evenly_spaced

DARKEST, BRIGHTEST = 0.04, 0.96
"""Intensities outside are not compared: noise, and saturated pixels."""

MIN_GAIN = 0.03
"""Minimum logarithm of a camera's gain that is not taken as 0: surfaces look different from different directions."""

MIN_SHARED = 50
"""Minimum number of points that a camera must share with others."""

NUM_FRAMES, MAX_POINTS = 8, 5_000
"""Number of frames of each camera, and of points, that are looked at."""

NUM_ROUNDS = 50
"""Rounds in which colours of points and gains of cameras are found in turn."""


def camera_responses(capture: Capture) -> dict[int, Float[Tensor, "3"]]:
    """How much brighter each training camera is than most, in red, green and blue; empty if all are alike.

    A camera multiplies the colour of a surface by a gain. Both are found in turn as medians of logarithms, over cameras
    and over points (median polish, Tukey 1977), so that occluded points and highlights do not count. Cameras that share
    fewer than ``MIN_SHARED`` points with others keep a gain of 1.

    Returns:
        [3] factors by ``Camera.id``, whose median over the cameras is 1; only of training cameras that differ.
    """
    videos = capture.by_camera(capture.train)
    if len(videos) < 2 or not len(capture.points):
        return {}
    masked, points = capture.assuming("masks"), capture.points[:: -(-len(capture.points) // MAX_POINTS)]
    logs = np.stack([_logs_of(masked, names, points) for names in videos.values()])
    gains = _polished(logs)
    gains -= np.median(gains, axis=0)
    found = {i: torch.from_numpy(np.exp(gain)).float() for i, gain in zip(videos, gains, strict=True)}
    differ = np.abs(gains).max(1) >= MIN_GAIN
    return {i: gain for (i, gain), differs in zip(found.items(), differ, strict=True) if differs}


def in_response(image: Float[Tensor, "H W 3"], frame: Frame, gains: Mapping[int, Float[Tensor, "3"]]) -> Tensor:
    """[H, W, 3] a rendered image as the camera of a frame records it."""
    gain = gains.get(frame.camera.id)
    return image if gain is None else image * gain.to(image.device)


def _logs_of(capture: Capture, names: list[str], points: Float[Tensor, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Logarithms of what a camera records at points, the median of some of its frames; NaN where not compared."""
    frames = [_logs_in(capture.frame(name), points) for name in evenly_spaced(names, NUM_FRAMES)]
    return _median(np.stack(frames))


def _logs_in(frame: Frame, points: Float[Tensor, "P 3"]) -> Float[np.ndarray, "P 3"]:
    row, column, _, is_visible = frame.camera.project(points)
    image = cv2.blur(frame.image.numpy(), (3, 3)).astype(np.float64) / 255.0
    values = image[row.numpy(), column.numpy()]
    known = is_visible.numpy() & ((values > DARKEST) & (values < BRIGHTEST)).all(1)
    if frame.static_mask is not None:
        known &= frame.static_mask[row, column].numpy()
    return np.where(known[:, None], np.log(np.maximum(values, DARKEST)), np.nan)


def _polished(logs: Float[np.ndarray, "C P 3"]) -> Float[np.ndarray, "C 3"]:
    """Logarithms of the gains of cameras from what they record of points."""
    logs = logs[:, np.isfinite(logs[:, :, 0]).sum(0) > 1]
    is_known = np.isfinite(logs[:, :, 0]).sum(1) >= MIN_SHARED
    gains = np.zeros((len(logs), 3))
    for _ in range(NUM_ROUNDS if is_known.any() else 0):
        colors = _median(logs - gains[:, None])
        gains[is_known] += _median((logs - colors - gains[:, None])[is_known].swapaxes(0, 1))
    return gains


def _median(values: Float[np.ndarray, "N M 3"]) -> Float[np.ndarray, "M 3"]:
    """Median over the first axis, of what is known; NaN where nothing is."""
    known = np.isfinite(values[:, :, 0]).any(0)
    found = np.full(values.shape[1:], np.nan)
    found[known] = np.nanmedian(values[:, known], axis=0)
    return found
