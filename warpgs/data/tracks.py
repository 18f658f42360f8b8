"""Long 2D tracks of points, as networks follow them through the frames of one camera: tracks.npz of a capture."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Shaped

from warpgs.files import write_bytes

from .images import MAX_SIDE
from .npz import read_npz

FILE = "tracks.npz"
"""Name of the file in a capture."""

ADD = "warpgs prepare CAPTURE --add tracks --tracks FILE"
"""The command that writes it."""

MAX_BYTES = 2 << 30
"""Maximum size of the arrays [bytes]."""

VISIBLE = 0.5
"""Probability above which a point is visible."""

MAX_POSITION = 1e6
"""Positions beyond this are written as if they were there; they are outside of any image [px]."""

MAX_OUTSIDE = 0.5
"""Fraction of the visible positions that may be outside of the image; more are of frames of another size."""


@dataclass(frozen=True)
class Tracks:
    """Points that were followed through the frames of one camera.

    Attributes:
        frames: Ids of the F frames, in the order of time.
        positions: [N, F, 2] columns and rows, in widths and heights of the image; NaN where the point is hidden.
    """

    frames: tuple[str, ...]
    positions: Float[np.ndarray, "N F 2"]

    @property
    def visible(self) -> Bool[np.ndarray, "N F"]:
        """Where points are seen."""
        return np.isfinite(self.positions[..., 0])


def read_tracks(root: Path, frames: Sequence[str] | None) -> Tracks | None:
    """The tracks in the folder of a capture; None if it has none.

    Args:
        root: The folder.
        frames: As for ``make_tracks``.

    Raises:
        ValueError: If the file is damaged, or its arrays do not fit the frames; the message says how.
    """
    path = root / FILE
    if not path.exists():
        return None
    try:
        arrays = read_npz(path, ("tracks", "visibles", "size"), MAX_BYTES)
        size = arrays["size"]
        if size.shape != (2,) or not ((size >= 1) & (size <= MAX_SIDE)).all():
            raise ValueError(f"{path}: size must be the width and height of the frames that tracks count pixels of")
        return make_tracks(path, frames, arrays["tracks"], arrays["visibles"], (int(size[0]), int(size[1])))
    except ValueError as error:
        raise ValueError(f"{error}. Delete {FILE} to train without tracks, or add others with {ADD}") from error


def make_tracks(
    path: Path,
    frames: Sequence[str] | None,
    positions: Shaped[np.ndarray, "..."],
    visible: Shaped[np.ndarray, "..."],
    size: tuple[int, int],
) -> Tracks:
    """Tracks of the arrays of a file.

    Args:
        path: The file, for messages.
        frames: Ids of the frames of the camera that trains, by time; None if several train.
        positions: [N, F, 2] columns and rows [px], with pixel centres at +0.5.
        visible: [N, F] true, or above a half, where visible.
        size: Width and height of the frames that these pixels are of.

    Raises:
        ValueError: If shapes do not fit, or visible positions are not finite or mostly outside of the frames.
    """
    if frames is None:
        raise ValueError(f"{path}: tracks are of one camera, but of this capture several train: it can have none")
    if positions.ndim != 3 or positions.shape[2] != 2 or visible.shape != positions.shape[:2]:
        shapes = f"{list(positions.shape)} and {list(visible.shape)}"
        raise ValueError(f"{path}: expected positions [N, F, 2] and visibility [N, F] of N points, got {shapes}")
    if positions.shape[1] != len(frames):
        counts = f"of {positions.shape[1]} frames, but the camera has {len(frames)}"
        raise ValueError(f"{path}: tracks are {counts}: track exactly its frames")
    seen = visible > VISIBLE
    if not np.isfinite(positions[seen]).all():
        raise ValueError(f"{path}: positions of visible points must be finite numbers, or the points hidden there")
    relative = np.where(seen[..., None], positions, 0.0) / np.array(size, np.float64)
    inside = seen & ((relative >= 0.0) & (relative < 1.0)).all(2)
    if inside.sum() < (1.0 - MAX_OUTSIDE) * seen.sum():
        raise ValueError(
            f"{path}: most positions are outside of frames of {size[0]}×{size[1]} pixels: tracks must be of the "
            "capture's frames in full size"
        )
    return Tracks(tuple(frames), np.where(inside[..., None], relative, np.nan).astype(np.float32))


def write_tracks(
    root: Path, positions: Float[np.ndarray, "N F 2"], visible: Bool[np.ndarray, "N F"], size: Sequence[int]
) -> None:
    """Writes tracks.npz to the folder of a capture.

    Args:
        root: The folder.
        positions: [N, F, 2] columns and rows in the frames of one camera by time [px], pixel centres at +0.5.
        visible: [N, F] where points are seen.
        size: Width and height of the frames that these pixels are of.

    Raises:
        OSError: If the file cannot be written; the message names it.
    """
    file = io.BytesIO()
    known = np.where(visible[..., None], positions, 0.0).clip(-MAX_POSITION, MAX_POSITION).astype(np.float32)
    np.savez_compressed(file, tracks=known, visibles=visible, size=np.array(size, np.int64))
    write_bytes(root / FILE, [file.getvalue()])
