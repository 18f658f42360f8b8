"""Videos in MP4, GIF and WebP, written frame by frame."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import UInt8

from warpgs.files import atomic_path, partial_path

from .encodings import ENCODINGS

FRAME_RATE = 24.0
"""Frames per second."""

FRAME_RATES = (0.01, 1000.0)
"""Lowest and highest frame rate [1/s]."""


class Video:
    """A video, written frame by frame; a context manager that leaves no file behind after an error.

    Args:
        path: The file; its suffix is a key of ``ENCODINGS``. It appears when it is complete.
        rate: Frames per second, within ``FRAME_RATES`` and the encoding's maximum.
    """

    def __init__(self, path: Path, rate: float = FRAME_RATE) -> None:
        self.path, self.rate = path, Fraction(rate).limit_denominator(1000)
        self.encoding = ENCODINGS[path.suffix]
        self._file: Any = None
        self._stream: Any = None
        self._convert: Any = None
        self._num_frames = 0

    def __enter__(self) -> "Video":
        return self

    def add(self, image: UInt8[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W 4"]) -> None:
        """Adds an RGB or RGBA frame; all frames have the size of the first.

        An odd last row or column is dropped if the encoding needs even sizes.

        Raises:
            ValueError: If the width or height of the frame is less than two pixels, or it is transparent and the
                encoding is not.
            OSError: If the file cannot be written, or FFmpeg has no such encoder.
        """
        if image.shape[2] == 4 and not self.encoding.has_alpha:
            raise ValueError(f"{self.path}: {self.encoding.muxer.upper()} has no transparency")
        odd = 1 if self.encoding.is_even else 0
        height, width = image.shape[0] & ~odd, image.shape[1] & ~odd
        if min(image.shape[:2]) < 2:
            raise ValueError(
                f"{self.path}: a video needs at least 2 × 2 pixels, got {image.shape[1]} × {image.shape[0]}"
            )
        with self._named_errors():
            if self._file is None:
                self._open(width, height)
            pixels = "rgb24" if image.shape[2] == 3 else "rgba"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), pixels)
            if pixels == "rgb24":
                frame = frame.reformat(format="rgba")
            frame.pts, frame.time_base = self._num_frames, 1 / self.rate
            self._num_frames += 1
            self._encode(frame)

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if self._file is None:
            return
        if error is None:
            with self._named_errors(), atomic_path(self.path):
                self._encode(None)
                self._file.mux(self._stream.encode(None))
                self._file.close()
        else:
            with suppress(av.FFmpegError):
                self._file.close()
            partial_path(self.path).unlink(missing_ok=True)

    def _encode(self, frame: Any) -> None:
        for converted in self._convert(frame):
            self._file.mux(self._stream.encode(converted))

    def _open(self, width: int, height: int) -> None:
        encoding = self.encoding
        if encoding.codec not in av.codecs_available:
            raise OSError(f"{self.path} cannot be written: the FFmpeg that PyAV was built with has no {encoding.codec}")
        if self.path.is_dir():
            raise OSError(f"{self.path} could not be written: Is a directory")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._convert = encoding.converter((width, height), self.rate)
        partial = str(partial_path(self.path))
        # FFmpeg takes the options that it uses out of the dicts.
        self._file = av.open(partial, "w", format=encoding.muxer, options=dict(encoding.muxer_options))
        self._stream = self._file.add_stream(encoding.codec, self.rate)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, encoding.pixels
        self._stream.options = dict(encoding.codec_options)
        for name, value in encoding.color.items():
            setattr(self._stream.codec_context, name, value)

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        """Converts errors of FFmpeg to OSErrors that name the file."""
        try:
            yield
        except av.FFmpegError as error:
            raise OSError(f"{self.path} could not be written: {error.strerror}") from error
