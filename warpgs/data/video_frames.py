"""The frames of a video by their index."""

from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np
from jaxtyping import UInt8

from warpgs.files import require_file

from .images import MAX_PIXELS

MAX_BYTES = 64 << 30
"""Maximum size of a video [bytes]."""

READ_LOCAL_FILES = {"protocol_whitelist": "file"}
"""Options of FFmpeg, with which playlists cannot make it open addresses."""


class VideoFrames:
    """Decodes a video's frames on request; in the order of the frames that takes one pass.

    Attributes:
        path: The video.
        size: (width, height) of the frames [px].

    Raises:
        ValueError: If the file is missing or not a video.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        require_file(path, MAX_BYTES)
        self._next, self._frames = 0, self._decoded()
        first = self.read(0)
        self.size = first.shape[1], first.shape[0]

    def read(self, index: int) -> UInt8[np.ndarray, "H W 3"]:
        """The RGB frame of an index.

        Raises:
            ValueError: If the video is damaged, ends earlier, or changes its size.
        """
        if index < self._next:
            self._next, self._frames = 0, self._decoded()
        for image in self._frames:
            self._next += 1
            if self._next > index:
                return image
        raise ValueError(f"{self.path} has {self._next} frames, no frame {index}")

    def _decoded(self) -> Iterator[np.ndarray]:
        try:
            with av.open(str(self.path), options=READ_LOCAL_FILES) as container:
                if not container.streams.video:
                    raise ValueError(f"{self.path} has no video")
                stream = container.streams.video[0]
                width, height = stream.codec_context.width, stream.codec_context.height
                if not 0 < width * height <= MAX_PIXELS:
                    raise ValueError(f"{self.path} claims {width}×{height} pixels, expected 1 to {MAX_PIXELS:,}")
                for frame in container.decode(stream):
                    if (frame.width, frame.height) != (width, height):
                        raise ValueError(f"{self.path} changes its size from {width}×{height}")
                    yield frame.to_ndarray(format="rgb24")
        except av.FFmpegError as error:
            raise ValueError(f"{self.path} is damaged or not a video: {error.strerror}") from error
