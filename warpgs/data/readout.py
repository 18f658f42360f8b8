"""Rolling shutters of captures: how a camera moves while a frame is read, from a smooth path through its frames."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from scipy.interpolate import CubicSpline

from warpgs.cameras import Camera

from .capture import SIDES, Capture, Side


def with_readout(capture: Capture, readout: float, begins: Side = "top") -> Capture:
    """The same capture with cameras in motion, at the speed of a spline through the poses of each camera's frames.

    Args:
        capture: With poses of the middle rows.
        readout, begins: See ``Capture.readout`` and ``readout_from``.

    Raises:
        ValueError: If it is not a number from -1 to 1, there is no such side, or a camera has fewer than two frames or
            two at one time; the message names them.
    """
    if not abs(readout) <= 1.0:
        raise ValueError(
            f"readout must be a number from -1 to 1, as a frame is read before the next one begins, got {readout}"
        )
    if begins not in SIDES:
        raise ValueError(f"readout_from must be one of {', '.join(SIDES)}, got {begins!r}")
    signed, by_columns = (readout if begins in ("top", "left") else -readout), begins in ("left", "right")
    moved = capture.with_cameras(_in_motion(capture, signed, by_columns) if readout else {})
    moved.readout, moved.readout_from = readout, begins
    return moved


def _in_motion(capture: Capture, readout: float, by_columns: bool) -> dict[str, Camera]:
    videos = [*capture.by_camera((*capture.train, *capture.val)).values()]
    _check(capture, videos)
    duration = readout * capture.interval
    moving = {name: camera for video in videos for name, camera in _moving(capture, video, duration).items()}
    return {name: replace(camera, by_columns=by_columns) for name, camera in moving.items()}


def _check(capture: Capture, videos: Sequence[Sequence[str]]) -> None:
    for names in videos:
        same = next((pair for pair in pairwise(names) if len({capture.cameras[n].time for n in pair}) == 1), None)
        if same is not None or len(names) < 2:
            what = f"{names[0]} is the only one" if same is None else f"{same[0]} and {same[1]} have one time"
            raise ValueError(f"a readout needs frames of one camera one after another: {what}")


def _moving(capture: Capture, names: Sequence[str], duration: float) -> dict[str, Camera]:
    """The cameras of frames in the order of time, with their motion in a duration.

    A cubic spline passes through their camera-to-world rotations C and positions; C' = C [Ω] is at the speed Ω of their
    rotation vector, with [Ω] the matrix of Ω ×.
    """
    cameras = [capture.cameras[name] for name in names]
    poses = np.stack([torch.cat([c.viewmat[:3, :3].T, c.position[:, None]], 1).double().numpy() for c in cameras])
    times = [camera.time for camera in cameras]
    speeds = poses[:, :, :3].swapaxes(1, 2) @ CubicSpline(times, poses)(times, 1)
    turns = 0.5 * np.stack([speeds[:, a, b] - speeds[:, b, a] for a, b in ((2, 1), (0, 2), (1, 0))], 1)
    motions = torch.tensor(duration * np.stack([turns, speeds[:, :, 3]], 1), dtype=torch.float32)
    moving = zip(names, cameras, motions, strict=True)
    return {name: replace(c, motion=motion, duration=duration) for name, c, motion in moving}
