"""The built-in capture ``builtin:rig``: still cameras with clocks of their own around what moves in the studio.

480×270; five training cameras on an arc, and a sixth one between them for evaluation, 60 frames of each, ten a second.
Masks, poses and times are exact, points are noisy, depth is exact but for a scale and an offset of each frame. With an
offset, every camera begins at another moment; time_id is in milliseconds of the common clock.

    builtin:rig    builtin:rig?offset=1    builtin:rig?cameras=1    builtin:rig?frames=12

The content is the same bits on every machine, as of ``builtin:studio``.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from warpgs.command_line.progress import progress
from warpgs.data import writer
from warpgs.data.units import SceneUnits
from warpgs.visualize.images import to_bytes

from .cache import cached, content_folder
from .studio import CENTER, SCALE, StudioSize, lens_of, looking_at_table, sixteen_bits, surface_points, trace_from

ANGLES = (-90.0, -78.0, -126.0, -54.0, -150.0, -30.0)
"""Where the cameras stand around the table, that for evaluation first; with fewer, those next to it [degrees]."""

DELAYS = (0.37, 0.0, 1.0, 0.62, 0.21, 0.83)
"""When each camera begins, as a part of the offset."""

RATE = 10.0
"""Frames of a camera per second."""

VERSION = 2
"""Increase it when the content changes, so that cached captures are not used any more."""


@dataclass(frozen=True)
class RigSize(StudioSize):
    """Size of the capture; numbers are compared at the default only.

    Attributes:
        num_frames: Number of frames of each camera.
        num_cameras: Number of training cameras, 1 to 5.
        offset: Time by which the clocks of the cameras differ at most [s].
    """

    num_frames: int = 60
    num_cameras: int = 5
    offset: float = 0.0


def pose_of(camera: int) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """World-to-camera rotation and position of a camera in the world."""
    angle = math.radians(ANGLES[camera])
    # The held-out camera stands closer and lower, so that its image shows nothing that no other camera sees.
    distance, height = (2.3, 1.5) if camera == 0 else (3.1, 1.78 + 0.25 * math.sin(3.0 * angle))
    position = np.array([distance * math.cos(angle), distance * math.sin(angle), height])
    return looking_at_table(position), position


def milliseconds(camera: int, frame: int, offset: float) -> int:
    """When a camera takes a frame [ms], on the clock of all of them."""
    return round(1000.0 * (frame / RATE + offset * DELAYS[camera]))


def write_rig(folder: Path, size: RigSize, quiet: bool = False) -> None:
    """Writes the capture to an empty folder.

    Raises:
        ValueError: If there are fewer than two frames.
        OSError: If a file cannot be written; the message names it.
    """
    if size.num_frames < 2:
        raise ValueError(f"a built-in capture needs at least 2 frames, got {size.num_frames}")
    lens, points, duration = lens_of(size), [], 1000.0 * (size.num_frames - 1) / RATE
    frames = {
        f"cam{camera}_{frame:06d}": (camera, frame)
        for camera in range(size.num_cameras + 1)
        for frame in range(size.num_frames)
    }
    times = {name: milliseconds(*found, size.offset) for name, found in frames.items()}
    for seed, name in enumerate(progress(frames, "creating builtin:rig, once for all runs", quiet)):
        (camera, frame), pose = frames[name], pose_of(frames[name][0])
        image, depth, static = trace_from(lens.camera(*pose, times[name] / duration), size)
        writer.write_image(folder, name, to_bytes(image))
        writer.write_mask(folder, name, static.numpy())
        writer.write_camera(folder, name, lens, *(part.round(9) for part in pose))
        if camera > 0:
            inverse = 1.0 / depth.numpy().astype(np.float64)
            writer.write_depth(folder, name, sixteen_bits(inverse, frame / size.num_frames))
            count = -(-size.num_points // (size.num_frames * size.num_cameras))
            points.append(surface_points(inverse, static.numpy(), lens, pose, count, seed))
    units = SceneUnits(np.array(CENTER), SCALE)
    writer.write_scene(folder, units, np.concatenate(points)[: size.num_points], near=0.05, far=3.0)
    ids = {name: camera for name, (camera, _) in frames.items()}
    writer.write_index(folder, times, {name for name, camera in ids.items() if camera == 0}, ids)


def rig_capture(cache_dir: Path | None = None, size: RigSize | None = None, quiet: bool = False) -> Path:
    """The folder of the capture, which is created on the first call; see ``builtin_capture`` of room.py."""
    size = size or RigSize()
    folder = content_folder(cache_dir, ["rig", VERSION, asdict(size)]) / "rig"
    return cached(folder, lambda partial: write_rig(partial, size, quiet), quiet)
