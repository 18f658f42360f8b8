"""MP4 videos in H.264, written frame by frame."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

import numpy as np
from jaxtyping import UInt8

from warpgs.files import atomic_path, partial_path

FRAME_RATE = 24.0
"""Frames per second."""

FRAME_RATES = (0.01, 1000.0)
"""Lowest and highest frame rate [1/s]."""

CODEC = "libx264"
"""FFmpeg's H.264 encoder."""

BT709, LIMITED_RANGE = 1, 1
"""FFmpeg's numbers (libavutil/pixfmt.h) of BT.709, the same for colour space, primaries and transfer, and of a range of
16 to 235. Pixels are converted to them, and the file says so: without these tags players assume BT.601 below 720 lines
and show wrong colours."""

QUALITY = 18
"""Constant rate factor of H.264: 0 is lossless; at 18 the loss is hardly visible."""


class Video:
    """An MP4 file in H.264, written frame by frame; a context manager that leaves no file behind after an error.

    Args:
        path: The file; it appears when it is complete.
        rate: Frames per second, within ``FRAME_RATES``.
    """

    def __init__(self, path: Path, rate: float = FRAME_RATE) -> None:
        self.path, self.rate = path, rate
        self._file: Any = None
        self._stream: Any = None

    def __enter__(self) -> "Video":
        return self

    def add(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Adds an RGB frame; all frames have the size of the first, and an odd last row or column is dropped.

        Raises:
            ValueError: If the width or height of the frame is less than two pixels.
            OSError: If the file cannot be written, or FFmpeg has no H.264 encoder.
        """
        height, width = image.shape[0] & ~1, image.shape[1] & ~1  # yuv420p has one colour per 2 × 2 pixels
        if not width or not height:
            raise ValueError(
                f"{self.path}: a video needs at least 2 × 2 pixels, got {image.shape[1]} × {image.shape[0]}"
            )
        with self._named_errors():
            if self._file is None:
                self._open(width, height)
            frame = _ffmpeg().VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), "rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED_RANGE)
            self._file.mux(self._stream.encode(frame))

    def __exit__(
        self, error_type: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is None:
            return
        if error is None:
            with self._named_errors(), atomic_path(self.path):
                self._file.mux(self._stream.encode(None))
                self._file.close()
        else:
            with suppress(_ffmpeg().FFmpegError):
                self._file.close()
            partial_path(self.path).unlink(missing_ok=True)

    def _open(self, width: int, height: int) -> None:
        av = _ffmpeg()
        if CODEC not in av.codecs_available:
            raise OSError(f"{self.path} cannot be written: the FFmpeg that PyAV was built with has no {CODEC}")
        if self.path.is_dir():
            raise OSError(f"{self.path} could not be written: Is a directory")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # With the index in front, a browser can play the file while it is still loading.
        self._file = av.open(str(partial_path(self.path)), "w", format="mp4", options={"movflags": "faststart"})
        self._stream = self._file.add_stream(CODEC, Fraction(self.rate).limit_denominator(1000))
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        self._stream.options = {"crf": str(QUALITY)}
        context = self._stream.codec_context
        context.color_range, context.colorspace = LIMITED_RANGE, BT709
        context.color_primaries = context.color_trc = BT709

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Converts errors of FFmpeg to OSErrors that name the file."""
        try:
            yield
        except _ffmpeg().FFmpegError as error:
            raise OSError(f"{self.path} could not be written: {error.strerror}") from error


def _ffmpeg() -> ModuleType:
    """PyAV, which includes FFmpeg; imported on first use because the import takes a third of a second.

    Raises:
        OSError: If PyAV is not installed or cannot be loaded.
    """
    try:
        return importlib.import_module("av")
    except ModuleNotFoundError as error:
        raise OSError("a video needs FFmpeg, which comes with PyAV: pip install av") from error
    except ImportError as error:  # of its libraries, such as for lack of memory
        raise OSError(f"FFmpeg could not be loaded: {error}") from error
