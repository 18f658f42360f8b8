"""How bright each of several cameras records the same surfaces over time, from the colours of sparse points."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import chain, islice

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .capture import Capture, Frame
from .read_ahead import ReadAhead
from .sampling import evenly_spaced

DARKEST, BRIGHTEST = 0.04, 0.96
"""Intensities outside are not compared: noise, and saturated pixels."""

MIN_GAIN = 0.03
"""Minimum logarithm of a camera's gain, and of its change over time, that is not taken as 0: surfaces look different
from different directions."""

MIN_JUMP = 0.1
"""Minimum change of the logarithm of intensities between two frames that counts as a jump, about a third of a stop.
Jumps are divided out frame by frame, before cameras are compared."""

MIN_SHARED = 50
"""Minimum number of points that a camera must share with others, and one of its frames with them all."""

NUM_FRAMES, MAX_POINTS = 8, 5_000
"""Number of frames of each camera, and of points, that are looked at."""

NUM_ROUNDS = 50
"""Rounds in which colours of points and gains of cameras are found in turn."""


@dataclass(frozen=True)
class Response:
    """How much brighter a camera is than most, linear in time between some of its frames.

    Attributes:
        times: [K] of the frames, ascending.
        logs: [K, 3] logarithms of the gain in red, green and blue.
    """

    times: Float[np.ndarray, " K"]
    logs: Float[np.ndarray, "K 3"]

    @staticmethod
    def constant(gain: Float[Tensor, "3"]) -> "Response":
        """The response of a camera with one gain."""
        return Response(np.zeros(1), gain.double().log().numpy()[None])

    def __str__(self) -> str:
        """The gain of each channel, at the beginning and at the end if it drifts."""
        ends = [", ".join(f"{gain:.2f}" for gain in np.exp(log)) for log in self.logs[[0, -1]]]
        return ends[0] if (self.logs == self.logs[0]).all() else f"{ends[0]} at first to {ends[1]} at last"

    def at(self, time: float) -> Float[Tensor, "3"]:
        """[3] factors of red, green and blue at a time."""
        return torch.from_numpy(np.exp(self._logs_at(time))).float()

    def _logs_at(self, time: float) -> Float[np.ndarray, "3"]:
        return np.array([np.interp(time, self.times, channel) for channel in self.logs.T])


def camera_responses(capture: Capture) -> dict[int, Response]:
    """How much brighter each camera is than most training cameras; empty if all are alike.

    A camera multiplies the colour of a surface by a gain. Both are found in turn as medians of logarithms, over
    training cameras and over points (median polish, Tukey 1977), so that occluded points and highlights do not count.
    Then each of some frames of a camera is compared with these colours, which tells how its gain drifts; neighbours in
    time are frames of the same camera. Jumps between them are not part of the drift. Cameras that share fewer than
    ``MIN_SHARED`` points with others keep a gain of 1.

    Of a camera that only evaluates, nothing but its own frames tells the gain: it is found from these in the same way.

    Returns:
        By ``Camera.id``, those of cameras that differ; at any time, their median over training cameras is 1.
    """
    train = capture.by_camera(capture.train)
    others = {i: names for i, names in capture.by_camera(capture.val).items() if i not in train}
    if len(train) < 2 or not len(capture.points):
        return {}
    masked, points = capture.assuming("masks"), capture.points[:: -(-len(capture.points) // MAX_POINTS)]
    some = {i: evenly_spaced(names, NUM_FRAMES) for i, names in (train | others).items()}
    times = {i: np.array([capture.cameras[name].time for name in names]) for i, names in some.items()}
    found_in = ReadAhead[str, np.ndarray](lambda name: _logs_in(masked.frame(name), points)).each(
        [*chain(*some.values())]
    )
    logs = {i: np.stack([*islice(found_in, len(names))]) for i, names in some.items()}
    colors = _polished(np.stack([_median(logs[i]) for i in train]))
    found = {i: curve for i in times if (curve := _drift(times[i], logs[i], colors)) is not None}
    of_train = [curve for i, curve in found.items() if i in train]
    relative = {i: _relative(curve, of_train) for i, curve in found.items()} if of_train else {}
    return {i: curve for i, curve in relative.items() if np.abs(curve.logs).max() >= MIN_GAIN}


def in_response(image: Float[Tensor, "H W 3"], frame: Frame, responses: Mapping[int, Response]) -> Tensor:
    """[H, W, 3] a rendered image as the camera of a frame records it."""
    response = responses.get(frame.camera.id)
    return image if response is None else image * response.at(frame.camera.time).to(image.device)


def _logs_in(frame: Frame, points: Float[Tensor, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Logarithms of what a frame records at points; NaN where not compared."""
    row, column, _, is_visible = frame.camera.project(points)
    values = cv2.blur(frame.image.numpy(), (3, 3))[row.numpy(), column.numpy()].astype(np.float64) / 255.0
    known = is_visible.numpy() & ((values > DARKEST) & (values < BRIGHTEST)).all(1)
    if frame.static_mask is not None:
        known &= frame.static_mask[row, column].numpy()
    return np.where(known[:, None], np.log(np.maximum(values, DARKEST)), np.nan)


def _polished(logs: Float[np.ndarray, "C P 3"]) -> Float[np.ndarray, "P 3"]:
    """Logarithms of the colours of points from what cameras record of them; NaN where fewer than two do."""
    shared = np.isfinite(logs[:, :, 0]).sum(0) > 1
    logs, colors = logs[:, shared], np.full(logs.shape[1:], np.nan)
    is_known = np.isfinite(logs[:, :, 0]).sum(1) >= MIN_SHARED
    gains = np.zeros((len(logs), 3))
    for _ in range(NUM_ROUNDS if is_known.any() else 0):
        colors[shared] = _median(logs - gains[:, None])
        gains[is_known] += _median((logs - colors[shared] - gains[:, None])[is_known].swapaxes(0, 1))
    return colors


def _drift(
    times: Float[np.ndarray, " K"], logs: Float[np.ndarray, "K P 3"], colors: Float[np.ndarray, "P 3"]
) -> Response | None:
    """The gain of a camera over time, without jumps; None if its frames share too little with others.

    Args:
        times: [K] of some of its frames.
        logs: [K, P, 3] logarithms of what they record at points.
        colors: [P, 3] those of the points' colours.
    """
    ratios = logs - colors
    known = np.isfinite(ratios[:, :, 0]).sum(1) >= MIN_SHARED
    if not known.any():
        return None
    gains = np.stack([np.nanmedian(ratio, axis=0) for ratio in ratios[known]])
    jumps = _jumps(gains)
    return Response(times[known], gains - jumps + np.median(jumps, axis=0))


def _jumps(gains: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "K 3"]:
    """By how much each frame is brighter than the first because of jumps; as much as usual of each is drift."""
    steps = np.diff(gains, axis=0)
    is_jump = np.abs(steps).max(1, initial=0.0) >= MIN_JUMP
    usual = np.median(steps[~is_jump], axis=0) if not is_jump.all() else np.zeros(3)
    jumps = np.where(is_jump[:, None], steps - usual, 0.0)
    return np.concatenate([np.zeros((1, 3)), jumps.cumsum(0)])


def _relative(curve: Response, others: list[Response]) -> Response:
    """A gain relative to the median of those of training cameras, at each time; constant if it hardly drifts.

    So that light that changes for all of them stays.
    """
    logs = np.stack([curve.logs[k] - np.median([o._logs_at(t) for o in others], 0) for k, t in enumerate(curve.times)])
    middle = np.median(logs, axis=0)
    drifts = np.abs(logs - middle).max() >= MIN_GAIN
    return Response(curve.times, logs if drifts else np.broadcast_to(middle, logs.shape))


def _median(values: Float[np.ndarray, "N M 3"]) -> Float[np.ndarray, "M 3"]:
    """Median over the first axis, of what is known; NaN where nothing is."""
    known = np.isfinite(values[:, :, 0]).any(0)
    found = np.full(values.shape[1:], np.nan)
    found[known] = np.nanmedian(values[:, known], axis=0)
    return found
