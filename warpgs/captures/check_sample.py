"""The frames that a check reads: some are compared with each other, of the others the files are looked at."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from warpgs.data.capture import Capture, Frame
from warpgs.data.dynamic_regions import DynamicCounts, dynamic_counts, dynamic_regions
from warpgs.data.read_ahead import ReadAhead
from warpgs.data.resized import reduced_capture, reduced_frame
from warpgs.data.sampling import evenly_spaced

from .agreement_check import cameras_to_compare
from .motion_check import pairs_to_compare

COMPARED_SIDE = 1024
"""Frames that are compared are scaled down to this larger side [px]."""

MAX_SAMPLES, MIN_SAMPLES, MAX_PIXELS = 12, 4, 100_000_000
"""Number of frames that are compared, evenly spread over the capture, and pixels of the larger ones of them."""


class Content(NamedTuple):
    """What the files of a frame hold.

    Attributes:
        error: Why it cannot be read; None if it can.
        has_depth: Whether it has depth.
        dynamic: Counts of its dynamic pixels; None if it has no mask.
    """

    error: str | None
    has_depth: bool = False
    dynamic: DynamicCounts | None = None


class Sample:
    """The frames of a capture that are compared.

    Args:
        capture: The capture; its files say what is static, whatever is assumed.

    Attributes:
        names: Some training frames, evenly spread over time.
        pairs: Pairs of training frames whose motion is compared.
        compared: Pairs of cameras that are compared.
        capture: The capture with these frames only, scaled down, once ``look`` has read them.
    """

    def __init__(self, capture: Capture) -> None:
        self._whole = capture.assuming("masks")
        names = capture.in_time(capture.train)
        largest = max(camera.width * camera.height for camera in capture.cameras.values())
        count = max(MIN_SAMPLES, min(MAX_SAMPLES, MAX_PIXELS // largest))
        self.names, self.pairs = evenly_spaced(names, count), pairs_to_compare(capture, count)
        self.compared = cameras_to_compare(capture, count)
        self._frames: dict[str, Frame] = {}
        across = [pair for cameras in self.compared for pair in cameras.frames]
        self._wanted = {*self.names, *(name for pair in (*self.pairs, *across) for name in pair)}
        self.capture = replace(reduced_capture(self._whole, COMPARED_SIDE), read=self._read)

    @property
    def needed(self) -> list[str]:
        """All frames that are compared, in the order of the capture."""
        return [name for name in (*self._whole.train, *self._whole.val) if name in self._wanted]

    def look(self, name: str) -> Content:
        """Reads a frame of the capture, and keeps it if it is compared.

        Raises:
            ValueError: If it cannot be read.
        """
        frame = self._whole.frame(name)
        if name in self._wanted:
            self._frames[name] = reduced_frame(frame, self.capture.cameras[name])
        counts = None
        if frame.static_mask is not None and self._whole.assumption == "masks":
            counts = dynamic_counts(
                frame.static_mask, dynamic_regions(frame.static_mask, frame.camera), frame.inverse_depth
            )
        return Content(None, frame.inverse_depth is not None, counts)

    def _read(self, name: str) -> Frame:
        if name not in self._frames:
            self._wanted.add(name)
            self.look(name)
        return self._frames[name]


def read_contents(capture: Capture, sample: Sample, deadline: float) -> dict[str, Content]:
    """Looks at the frames that are compared, and at as many of the others as there is time for, evenly spread.

    Args:
        capture: The capture.
        sample: Its frames that are compared.
        deadline: Time at which to stop (``time.monotonic``) [s].

    Returns:
        Of each frame that was read, in the order of the capture, those for training first.
    """
    start, needed = time.monotonic(), sample.needed
    contents = _look_at(sample, needed, float("inf"))
    now = time.monotonic()
    others = [name for name in (*capture.train, *capture.val) if name not in contents]
    affordable = int((deadline - now) * len(needed) / max(now - start, 1e-3))
    contents |= _look_at(sample, evenly_spaced(others, max(0, affordable)), deadline)
    return {name: contents[name] for name in (*capture.train, *capture.val) if name in contents}


def _look_at(sample: Sample, names: Sequence[str], deadline: float) -> dict[str, Content]:
    """Reads frames in threads until a time."""

    def look(name: str) -> Content:
        try:
            return sample.look(name)
        except ValueError as error:
            return Content(str(error))

    found: dict[str, Content] = {}
    reader = ReadAhead(look)
    for name, content in zip(names, reader.each(names), strict=True):
        found[name] = content
        if time.monotonic() > deadline:
            break
    reader.announce(())  # discards what is read ahead
    return found
