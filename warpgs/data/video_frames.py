"""The frames of a video by their index."""

import threading
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

from warpgs.files import require_file

from .images import MAX_PIXELS
from .read_ahead import MAX_THREADS, SPARE

MAX_BYTES = 64 << 30
"""Maximum size of a video [bytes]."""

READ_LOCAL_FILES = {"protocol_whitelist": "file"}
"""Options of FFmpeg, with which playlists cannot make it open addresses."""


NUM_KEPT = MAX_THREADS + SPARE
"""Number of decoded frames to keep: threads that read frames in their order ask for some a little late."""


class VideoFrames:
    """Decodes a video's frames on request; roughly in the order of the frames that takes one pass.

    Several threads may read.

    Attributes:
        path: The video.
        size: (width, height) of the frames [px].
        count: Number of frames that the file claims; 0 if it does not say.

    Raises:
        ValueError: If the file is missing or not a video.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        require_file(path, MAX_BYTES)
        self._kept: dict[int, np.ndarray] = {}
        self.count = 0
        self._restart()
        self._lock = threading.Lock()
        first = self.read(0)
        self.size = first.shape[1], first.shape[0]

    def __reduce__(self) -> tuple[type["VideoFrames"], tuple[Path]]:
        return VideoFrames, (self.path,)  # each process decodes on its own

    def read(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        """The RGB frame of an index.

        Raises:
            ValueError: If the video is damaged, ends earlier, or changes its size.
        """
        with self._lock:
            if index not in self._kept:
                try:
                    self._decode_to(index)
                except ValueError:
                    self._restart()  # so that the threads that ask for frames before it get the same error
                    raise
            return self._kept[index]

    def _restart(self) -> None:
        self._next, self._frames = 0, self._decoded()
        self._kept.clear()

    def _decode_to(self, index: int) -> None:
        if index < self._next:
            self._restart()
        while self._next <= index:
            image = next(self._frames, None)
            if image is None:
                raise ValueError(f"{self.path} has {self._next} frames, no frame {index}")
            self._kept[self._next] = image
            self._kept.pop(self._next - NUM_KEPT, None)
            self._next += 1

    def _decoded(self) -> Iterator[np.ndarray]:
        try:
            with av.open(str(self.path), options=READ_LOCAL_FILES) as container:
                if not container.streams.video:
                    raise ValueError(f"{self.path} has no video")
                stream = container.streams.video[0]
                self.count = stream.frames
                width, height = stream.codec_context.width, stream.codec_context.height
                if not 0 < width * height <= MAX_PIXELS:
                    raise ValueError(f"{self.path} claims {width}×{height} pixels, expected 1 to {MAX_PIXELS:,}")
                for frame in container.decode(stream):
                    if (frame.width, frame.height) != (width, height):
                        raise ValueError(f"{self.path} changes its size from {width}×{height}")
                    yield frame.to_ndarray(format="rgb24")
        except av.FFmpegError as error:
            raise ValueError(f"{self.path} is damaged or not a video: {error.strerror}") from error
