"""Tells from a capture's images whether its camera only turns, whatever its cameras say."""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from warpgs.data.capture import Capture, Frame
from warpgs.data.resized import size_within
from warpgs.data.turning import MIN_MATCHES, Turning, find_turning

from .features import find_features, match
from .findings import Finding

COMPARED_SIDE = 512
"""Images are scaled down to this longer side [px]."""

MAX_STEP = 4
"""Frames are matched with this many of the next sampled ones: with those far away they share less."""


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
    features = [find_features(frame, size) for frame in frames]
    pairs = [p for p in itertools.combinations(range(len(frames)), 2) if p[1] - p[0] <= MAX_STEP]
    matches = [found for a, b in pairs if (found := match(features[a], features[b], MIN_MATCHES)) is not None]
    focal = float(np.median([float(frame.camera.pinhole.resized(*size).K[0, 0]) for frame in frames]))
    searched, known = find_turning(matches, size), find_turning(matches, size, focal)
    return None if searched is None or known is None else (searched, known)
