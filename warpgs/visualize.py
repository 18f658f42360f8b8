"""Pictures and videos for people to look at."""

import importlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from types import ModuleType, TracebackType
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from .files import atomic_path, partial_path
from .render import Rendering

ERROR_RANGE = 0.25
"""Mean absolute error that has the brightest colour."""

CAPTION_HEIGHT = 18
VIDEO_RATE = 24.0
VIDEO_RATES = (0.01, 1000.0)
"""Lowest and highest rate of a video [1/s]."""

CODEC = "libx264"
VIDEO_LOSS = 18
"""Constant rate factor of H.264: 0 loses nothing, at 18 one hardly sees that anything is lost."""


def to_bytes(image: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit RGB of an image in [0, 1]."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def error_image(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Mean absolute error in colours, dark where there is none."""
    error = (image - truth).abs().mean(-1).div(ERROR_RANGE)
    level = (error.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
    return cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def comparison(truth: Float[Tensor, "H W 3"], rendering: Rendering) -> UInt8[np.ndarray, "H2 W5 3"]:
    """truth | joint | static | dynamic | error, side by side under their names."""
    assert rendering.static is not None
    assert rendering.dynamic is not None
    pictures = {
        "truth": to_bytes(truth),
        "joint": to_bytes(rendering.joint.image),
        "static": to_bytes(rendering.static.image),
        "dynamic": to_bytes(rendering.dynamic.image),
        f"error (0 to {ERROR_RANGE})": error_image(rendering.joint.image.clamp(0, 1), truth),
    }
    return np.concatenate([_captioned(name, picture) for name, picture in pictures.items()], axis=1)


def _captioned(name: str, picture: np.ndarray) -> np.ndarray:
    bar = np.zeros((CAPTION_HEIGHT, picture.shape[1], 3), np.uint8)
    cv2.putText(bar, name, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
    return np.concatenate([bar, picture])


class Video:
    """An MP4 file in H.264, written frame by frame; used as a context, and not there if that ends with an error.

    Args:
        path: Where it is once it is whole.
        rate: Frames a second, within ``VIDEO_RATES``.
    """

    def __init__(self, path: Path, rate: float = VIDEO_RATE) -> None:
        self.path, self.rate = path, rate
        self._file: Any = None
        self._stream: Any = None

    def __enter__(self) -> "Video":
        return self

    def add(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Adds an RGB frame of the size of the first.

        Raises:
            ValueError: If a side of the frame has less than two pixels.
            OSError: If no video can be written there, or nothing here writes H.264.
        """
        height, width = image.shape[0] & ~1, image.shape[1] & ~1  # H.264 with a colour for 2 × 2 pixels: even sizes
        if not width or not height:
            raise ValueError(f"{self.path}: a video needs two pixels a side, got {image.shape[1]} × {image.shape[0]}")
        with self._named():
            if self._file is None:
                self._open(width, height)
            frame = _ffmpeg().VideoFrame.from_ndarray(np.ascontiguousarray(image[:height, :width]), "rgb24")
            self._file.mux(self._stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is None:
            return
        if error is None:
            with self._named(), atomic_path(self.path):
                self._file.mux(self._stream.encode(None))
                self._file.close()
        else:
            with suppress(_ffmpeg().FFmpegError):
                self._file.close()
            partial_path(self.path).unlink(missing_ok=True)

    def _open(self, width: int, height: int) -> None:
        av = _ffmpeg()
        if CODEC not in av.codecs_available:
            raise OSError(f"{self.path} can't be written: the FFmpeg that PyAV was built with has no {CODEC}")
        if self.path.is_dir():
            raise OSError(f"{self.path} could not be written: Is a directory")
        self.path.parent.mkdir(parents=True, exist_ok=True)
        # The index goes first, so that a browser plays a file while it is loading.
        self._file = av.open(str(partial_path(self.path)), "w", format="mp4", options={"movflags": "faststart"})
        self._stream = self._file.add_stream(CODEC, Fraction(self.rate).limit_denominator(1000))
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
        self._stream.options = {"crf": str(VIDEO_LOSS)}

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Errors of FFmpeg as errors that name the file."""
        try:
            yield
        except _ffmpeg().FFmpegError as error:
            raise OSError(f"{self.path} could not be written: {error.strerror}") from error


def _ffmpeg() -> ModuleType:
    """PyAV, which brings FFmpeg along; it takes a third of a second to import, so only who writes a video does.

    Raises:
        OSError: Without it.
    """
    try:
        return importlib.import_module("av")
    except ImportError as error:
        raise OSError("a video needs FFmpeg, which comes with PyAV: pip install av") from error
