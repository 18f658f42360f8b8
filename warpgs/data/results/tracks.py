"""Tracks as CoTracker, TAPIR and SpatialTracker give them, and from optical flow."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Shaped

from warpgs.data.npz import names_of, read_npz
from warpgs.data.tracks import MAX_BYTES, VISIBLE

from .flow import follow_flow

LAYOUTS = (
    "pred_tracks and pred_visibility (CoTracker), tracks and visibles or occluded (TAPIR), or coords, visibs, "
    "extrinsics, intrinsics and depths (SpatialTrackerV2)"
)
"""Arrays of the layouts that are read."""

PIXEL_CENTER = 0.5
"""Position of the first pixel's centre, which is 0 for CoTracker."""


class TrackedPoints(NamedTuple):
    """Points of a file.

    Attributes:
        positions: [N, F, 2] columns and rows [px], with pixel centres at +0.5.
        visible: [N, F] where they are seen.
    """

    positions: Float[np.ndarray, "N F 2"]
    visible: Bool[np.ndarray, "N F"]


def read_tracked_points(path: Path, size: tuple[int, int]) -> TrackedPoints:
    """The points of an .npz file of a network, or those that the optical flow in a folder leads from frame to frame.

    Args:
        path: The file, or the folder of ``follow_flow``.
        size: Width and height of the frames in which positions are wanted; those of SpatialTracker are of frames that
            it has resized.

    Raises:
        ValueError: If the file is damaged or of another layout, or its arrays do not fit each other.
    """
    if path.is_dir():
        return TrackedPoints(*follow_flow(path, size))
    with np.errstate(all="ignore"):  # positions of hidden points may be any numbers, those of visible ones are checked
        return _read(path, size)


def _read(path: Path, size: tuple[int, int]) -> TrackedPoints:
    names = names_of(path)
    if {"pred_tracks", "pred_visibility"} <= names:
        return _cotracker(path)
    shown = next((name for name in ("visibles", "visible", "occluded") if name in names), None)
    if "tracks" in names and shown is not None:
        return _tapir(path, shown)
    if {"coords", "visibs", "extrinsics", "intrinsics", "depths"} <= names:
        return _spatial_tracker(path, size)
    raise ValueError(f"{path} has no tracks: expected the arrays {LAYOUTS}")


def _cotracker(path: Path) -> TrackedPoints:
    """pred_tracks [T, N, 2] and pred_visibility [T, N], each maybe with a batch of one and a last axis of one."""
    arrays = read_npz(path, ("pred_tracks", "pred_visibility"), MAX_BYTES)
    tracks, visible = _without_batch(arrays["pred_tracks"], 3), arrays["pred_visibility"]
    visible = visible[..., 0] if visible.ndim > 2 and visible.shape[-1] == 1 else visible
    visible = _without_batch(visible, 2)
    _require_shapes(path, tracks, visible)
    positions = tracks.transpose(1, 0, 2).astype(np.float32) + PIXEL_CENTER
    return TrackedPoints(positions, visible.T > VISIBLE)


def _tapir(path: Path, shown: str) -> TrackedPoints:
    """tracks [N, T, 2] and visibles or occluded [N, T], each maybe with a batch of one."""
    arrays = read_npz(path, ("tracks", shown), MAX_BYTES)
    tracks, visible = _without_batch(arrays["tracks"], 3), _without_batch(arrays[shown], 2)
    _require_shapes(path, tracks, visible)
    is_high = visible > VISIBLE
    return TrackedPoints(tracks.astype(np.float32), ~is_high if shown == "occluded" else is_high)


def _spatial_tracker(path: Path, size: tuple[int, int]) -> TrackedPoints:
    """coords [T, N, 3] in its own world, seen by its own cameras in frames of the size of its depths [T, h, w]."""
    names = ("coords", "visibs", "extrinsics", "intrinsics", "depths")
    coords, visible, extrinsics, K, depths = read_npz(path, names, MAX_BYTES).values()
    visible = visible[..., 0] if visible.ndim == 3 and visible.shape[-1] == 1 else visible
    count = len(coords)
    if coords.ndim != 3 or coords.shape[2] != 3 or visible.shape != coords.shape[:2] or depths.ndim != 3:
        shapes = f"{list(coords.shape)}, {list(visible.shape)} and {list(depths.shape)}"
        raise ValueError(f"{path}: expected coords [T, N, 3], visibs [T, N] and depths [T, h, w], got {shapes}")
    if extrinsics.shape not in ((count, 4, 4), (count, 3, 4)) or K.shape != (count, 3, 3):
        shapes = f"{list(extrinsics.shape)} and {list(K.shape)}"
        raise ValueError(
            f"{path}: expected extrinsics [T, 4, 4] and intrinsics [T, 3, 3] of {count} frames, got {shapes}"
        )
    viewed = np.einsum("tij,tnj->nti", extrinsics[:, :3, :3], coords) + extrinsics[:, :3, 3]
    projected = np.einsum("tij,ntj->nti", K, viewed)
    positions = projected[..., :2] / projected[..., 2:]
    height, width = depths.shape[1:]
    scale = np.array([size[0] / width, size[1] / height])
    return TrackedPoints((positions * scale).astype(np.float32), (visible.T > VISIBLE) & (viewed[..., 2] > 0.0))


def _without_batch(array: Shaped[np.ndarray, "..."], ndim: int) -> Shaped[np.ndarray, "..."]:
    return array[0] if array.ndim == ndim + 1 and len(array) == 1 else array


def _require_shapes(path: Path, tracks: np.ndarray, visible: np.ndarray) -> None:
    if tracks.ndim != 3 or tracks.shape[2] != 2 or visible.shape != tracks.shape[:2]:
        shapes = f"{list(tracks.shape)} and {list(visible.shape)}"
        raise ValueError(
            f"{path}: tracks and visibility do not fit each other, got shapes {shapes}: save both arrays of one call"
        )
