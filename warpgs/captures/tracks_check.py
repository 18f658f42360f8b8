"""Compares the tracks of a capture with its masks and cameras."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.tracks import ADD

from .findings import Finding, Level

MIN_SEEN = 3
"""Minimum number of compared frames that see a point."""

MIN_TRACKS = 10
"""Minimum number of static tracks that say anything of cameras."""

MAX_ERROR = 0.01
"""Reprojection error up to which a static track fits the cameras, as a fraction of the image's longer side."""

MIN_FITTING = 0.5
"""Fraction of the static tracks that must fit the cameras."""


def check_tracks(capture: Capture, names: Sequence[str]) -> Iterator[Finding]:
    """Compares tracks in some frames: static points must fit the cameras, dynamic ones stay in the masks."""
    tracks = capture.tracks
    if tracks is None:
        return
    seen = tracks.positions[:, [tracks.frames.index(name) for name in names]].astype(np.float64)
    dynamic = _are_dynamic(seen, capture, names)
    visible = np.isfinite(seen[..., 0])
    often = visible.sum(1) >= MIN_SEEN
    in_mask = (dynamic & visible).sum(1)
    static, moving = often & (in_mask == 0), often & (in_mask == visible.sum(1))
    stay = f"{_percent(static, often)} stay static and {_percent(moving, often)} dynamic by the masks"
    text = f"{len(seen):,} tracks: {stay}"
    level: Level = "note"
    if static.sum() >= MIN_TRACKS and not capture.hardly_moves:
        errors = _reprojection_errors(seen[static], [capture.cameras[name] for name in names])
        fits = errors <= MAX_ERROR
        text += f"; {fits.mean():.0%} of the static ones fit the cameras"
        if fits.mean() < MIN_FITTING:
            level = "warning"
            text += (
                ": they may be of other frames than the capture has, or of frames of another size: track the frames in "
                f"rgb/1x, then delete tracks.npz and run {ADD}"
            )
    yield Finding(level, "tracks", text)


def _percent(part: Bool[np.ndarray, " N"], of: Bool[np.ndarray, " N"]) -> str:
    return f"{part.sum() / max(1, of.sum()):.0%}"


def _are_dynamic(seen: Float[np.ndarray, "N F 2"], capture: Capture, names: Sequence[str]) -> Bool[np.ndarray, "N F"]:
    """Whether masks mark the pixels of positions as dynamic."""
    found = np.zeros(seen.shape[:2], bool)
    for k, name in enumerate(names):
        mask = capture.frame(name).static_mask
        if mask is not None:
            found[:, k] = ~at_positions(mask.numpy(), seen[:, k])
    return found & np.isfinite(seen[..., 0])


def at_positions(values: Bool[np.ndarray, "H W"], positions: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, " N"]:
    """The pixels at positions in widths and heights of an image; of those that are NaN, its first one."""
    height, width = values.shape
    column, row = (np.nan_to_num(positions) * (width, height)).astype(int).T
    return values[row.clip(0, height - 1), column.clip(0, width - 1)]


def _reprojection_errors(seen: Float[np.ndarray, "N F 2"], cameras: Sequence[Camera]) -> Float[np.ndarray, " N"]:
    """Median distance of tracks from where the cameras see the point that their rays meet best.

    Relative to the longer side of the image. The point is that of the smallest sum of squared distances from the rays.
    """
    visible = np.isfinite(seen[..., 0])
    matrix, right = np.zeros((len(seen), 3, 3)), np.zeros((len(seen), 3))
    for k, camera in enumerate(cameras):
        rays = camera.rays(torch.from_numpy(np.nan_to_num(seen[:, k]) * camera.size)).double()
        world = torch.nn.functional.normalize(rays @ camera.viewmat[:3, :3].double(), dim=1).nan_to_num(0.0).numpy()
        across = np.eye(3) - world[:, :, None] * world[:, None, :]
        used = across * visible[:, k, None, None]
        matrix += used
        right += used @ camera.position.double().numpy()
    points = torch.from_numpy(np.linalg.solve(matrix + 1e-9 * np.eye(3), right[..., None])[..., 0])
    errors = np.full(visible.shape, np.nan)
    for k, camera in enumerate(cameras):
        viewmat = camera.viewmat.double()
        placed, _, is_seen = camera.place(points @ viewmat[:3, :3].T + viewmat[:3, 3])
        off = np.linalg.norm(placed.numpy() - seen[:, k] * camera.size, axis=1) / max(camera.size)
        errors[:, k] = np.where(is_seen.numpy(), off, 1.0)
    return np.nanmedian(np.where(visible, errors, np.nan), axis=1)
