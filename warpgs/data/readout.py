"""Rolling shutters of captures: how a camera moves while a frame is read, from a smooth path through its frames."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from warpgs.cameras import Camera

from .capture import Capture


def with_readout(capture: Capture, readout: float) -> Capture:
    """The same capture with cameras in motion, at the speed of a spline through the poses of their frames.

    If two frames have the same time, those of ``train`` are of one camera and those of ``val`` of another.

    Args:
        capture: With poses of the middle rows.
        readout: See ``Capture.readout``.

    Raises:
        ValueError: If it is not a number from -1 to 1, or a camera has fewer than two frames or two at one time; the
            message names them.
    """
    if not abs(readout) <= 1.0:
        raise ValueError(
            f"readout must be a number from -1 to 1, as a frame is read before the next one begins, got {readout}"
        )
    moved = capture.with_cameras(_in_motion(capture, readout) if readout else {})
    moved.readout = readout
    return moved


def _in_motion(capture: Capture, readout: float) -> dict[str, Camera]:
    tracks = [capture.in_time((*capture.train, *capture.val))]
    if not _gaps(capture, tracks[0]).all():
        tracks = [capture.in_time(part) for part in (capture.train, capture.val) if part]
    _check(capture, tracks)
    duration = readout * float(np.median(_gaps(capture, capture.in_time(capture.train))))
    return {name: camera for track in tracks for name, camera in _moving(capture, track, duration).items()}


def _gaps(capture: Capture, names: Sequence[str]) -> Float[np.ndarray, " G"]:
    """[G] time from each frame to the next."""
    return np.diff([capture.cameras[name].time for name in names])


def _check(capture: Capture, tracks: Sequence[Sequence[str]]) -> None:
    for track in tracks:
        same = (_gaps(capture, track) == 0.0).nonzero()[0]
        if len(same) or len(track) < 2:
            first, second = (track[same[0]], track[same[0] + 1]) if len(same) else (track[0], None)
            what = f"{first} and {second} have one time" if second else f"{first} is the only one"
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
    return {name: replace(c, motion=motion) for name, c, motion in zip(names, cameras, motions, strict=True)}
