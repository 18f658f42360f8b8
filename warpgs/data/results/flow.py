"""Tracks from the optical flow of a network, as NSFF and RoDynRF keep it: a file forward and one backward per frame."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int64, Shaped
from scipy.ndimage import map_coordinates

from warpgs.data.images import MAX_PIXELS, MAX_SIDE
from warpgs.data.npz import names_of, read_npz
from warpgs.files import natural_order, read_array, read_bounded

LAYOUT = "<frame>_fwd and <frame>_bwd of .npz (an array flow), .npy or .flo files"
"""The files of a folder."""

FLO_MAGIC = b"PIEH"
"""First bytes of Middlebury's .flo files; width and height follow."""

CELLS = 96
"""Number of cells along the longer side of a frame, in each of which some point is followed."""

MIN_FRAMES = 8
"""Minimum number of frames, of a longer video, through which a point must be followed."""

MAX_TRACKS = 20_000
"""Maximum number of points."""

RELATIVE, ABSOLUTE = 0.01, 0.5
"""A point is lost where |f + b|² exceeds ``RELATIVE`` (|f|² + |b|²) + ``ABSOLUTE`` [px²], of its flow f to the next
frame and the flow b from there back (Sundaram et al. 2010)."""

Positions = Float[np.ndarray, "P 2"]


class _Step(NamedTuple):
    """Flow between two neighbouring frames of w×h pixels [px]; NaN where it is not valid."""

    forward: Float[np.ndarray, "h w 2"]
    backward: Float[np.ndarray, "h w 2"]


class _Followed(NamedTuple):
    """The points that are followed into one frame: their numbers, and their columns and rows, 0 at pixel centres."""

    points: Int64[np.ndarray, " P"]
    positions: Positions


def follow_flow(folder: Path, size: tuple[int, int]) -> tuple[Float[np.ndarray, "N F 2"], Bool[np.ndarray, "N F"]]:
    """Points that are followed by the optical flow from each frame to the next as long as the flow back confirms it.

    Args:
        folder: It has a file forward for each of F frames but the last one, and one backward for each but the first.
            Arrays are [h, w, 2], columns first [px]; an array ``mask`` of an .npz file is above a half where they hold.
        size: Width and height of the frames in which positions are wanted; the flow may be of smaller ones.

    Returns:
        [N, F, 2] columns and rows [px], with pixel centres at +0.5, and [N, F] where the points are seen.

    Raises:
        ValueError: If a file is missing or damaged, they are of several sizes, or no point can be followed; the message
            names the file or folder.
    """
    frames: list[_Followed] = []
    shape = (0, 0)
    num_points, followed = 0, _Followed(np.zeros(0, np.int64), np.zeros((0, 2)))
    for step in _steps(folder):
        if not frames:
            shape = step.forward.shape[:2]
            followed = _with_new(followed, 0, shape)
            num_points = len(followed.points)
            frames.append(followed)
        followed = _with_new(_advanced(followed, step), num_points, shape)
        num_points = max(num_points, int(followed.points.max(initial=-1)) + 1)
        frames.append(followed)
    positions = _as_array(frames, num_points)
    if len(positions) == 0:
        raise ValueError(f"{folder}: flow back confirms no point: <frame>_bwd must lead to the frame before, in pixels")
    scale = np.array(size) / np.array(shape[::-1])
    return ((positions + 0.5) * scale).astype(np.float32), np.isfinite(positions[..., 0])


def _steps(folder: Path) -> Iterator[_Step]:
    """The steps from frame to frame, read one by one."""
    files = {path.stem: path for path in folder.iterdir() if path.suffix.lower() in (".npz", ".npy", ".flo")}
    ends = ("_fwd", "_bwd")
    frames = sorted({stem[:-4] for stem in files if stem.endswith(ends)}, key=natural_order)
    if len(frames) < 2:
        raise ValueError(f"{folder} has no optical flow of two frames: expected {LAYOUT}")
    shape: tuple[int, ...] | None = None
    for frame, following in pairwise(frames):
        flows = []
        for stem in (f"{frame}_fwd", f"{following}_bwd"):
            if stem not in files:
                raise ValueError(f"{folder} has no file {stem}: expected {LAYOUT}, forward and backward")
            flow = _read(files[stem])
            shape = shape or flow.shape
            if flow.shape != shape:
                raise ValueError(
                    f"{files[stem]}: expected flow {list(shape)} as of the first frame, got {list(flow.shape)}"
                )
            flows.append(flow)
        yield _Step(*flows)


def _read(path: Path) -> Float[np.ndarray, "h w 2"]:
    """The flow of a file; NaN where it does not hold."""
    mask = None
    if path.suffix.lower() == ".npz":
        names = ["flow", "mask"] if "mask" in names_of(path) else ["flow"]
        arrays = read_npz(path, names, 8 * 3 * MAX_PIXELS)
        flow, mask = arrays["flow"], arrays.get("mask")
    elif path.suffix.lower() == ".npy":
        flow = read_array(path, 2 * MAX_PIXELS)
    else:
        flow = _read_flo(path)
    if flow.ndim != 3 or flow.shape[2] != 2 or not 1 < min(flow.shape[:2]) <= max(flow.shape[:2]) <= MAX_SIDE:
        raise ValueError(f"{path}: expected flow [H, W, 2], got {list(flow.shape)}")
    flow = flow.astype(np.float32)
    if mask is not None:
        if mask.shape != flow.shape[:2]:
            raise ValueError(f"{path}: expected mask {list(flow.shape[:2])}, as flow, got {list(mask.shape)}")
        flow[~(mask > 0.5)] = np.nan
    return flow


def _read_flo(path: Path) -> Shaped[np.ndarray, "h w 2"]:
    data = read_bounded(path, 12 + 8 * MAX_PIXELS)
    width, height = np.frombuffer(data, "<i4", 2, 4).tolist() if len(data) >= 12 else (0, 0)
    if data[:4] != FLO_MAGIC or width < 1 or len(data) != 12 + 8 * width * height:
        raise ValueError(f"{path} is damaged or not a .flo file of optical flow")
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width, 2)


def _advanced(followed: _Followed, step: _Step) -> _Followed:
    """The points in the next frame, without those that are lost."""
    forward = _at(step.forward, followed.positions)
    positions = followed.positions + forward
    backward = _at(step.backward, positions)
    with np.errstate(invalid="ignore"):
        allowed = RELATIVE * ((forward**2).sum(1) + (backward**2).sum(1)) + ABSOLUTE
        kept = ((forward + backward) ** 2).sum(1) <= allowed  # not where flow is NaN, as outside of the frame
    return _Followed(followed.points[kept], positions[kept])


def _at(flow: Float[np.ndarray, "h w 2"], positions: Positions) -> Positions:
    """Flow at positions, bilinear; NaN outside of the frame."""
    rows = positions[:, ::-1].T
    return np.stack([map_coordinates(flow[..., k], rows, order=1, cval=np.nan) for k in range(2)], 1).astype(np.float64)


def _with_new(followed: _Followed, first: int, shape: tuple[int, ...]) -> _Followed:
    """The points of a frame, and new ones, numbered from ``first`` on, in the middle of the cells that have none."""
    cell = max(1.0, max(shape) / CELLS)
    counts = [int(side // cell) for side in shape]
    rows, columns = (((np.arange(count) + 0.5) * cell - 0.5) for count in counts)
    centers = np.stack(np.meshgrid(columns, rows), -1)
    taken = np.zeros(counts, bool)
    column, row = ((followed.positions + 0.5) / cell).astype(int).T
    taken[row.clip(0, counts[0] - 1), column.clip(0, counts[1] - 1)] = True
    new = centers[~taken]
    points = np.concatenate([followed.points, first + np.arange(len(new))])
    return _Followed(points, np.concatenate([followed.positions, new]))


def _as_array(frames: list[_Followed], num_points: int) -> Float[np.ndarray, "N F 2"]:
    """Positions of those points that are followed long enough, at most ``MAX_TRACKS``; NaN where they are lost."""
    lengths = np.bincount(np.concatenate([frame.points for frame in frames]), minlength=num_points)
    chosen = (lengths >= min(MIN_FRAMES, len(frames))).nonzero()[0]
    if len(chosen) > MAX_TRACKS:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MAX_TRACKS).round().astype(int)]
    place = np.full(num_points, -1)
    place[chosen] = np.arange(len(chosen))
    positions = np.full((len(chosen), len(frames), 2), np.nan, np.float32)
    for k, frame in enumerate(frames):
        at = place[frame.points]
        positions[at[at >= 0], k] = frame.positions[at >= 0]
    return positions
