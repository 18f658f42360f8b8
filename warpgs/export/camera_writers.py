"""``warpgs export --cameras``: the formats of cameras."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgs.errors import counted

from .camera_set import CameraSet
from .colmap_model import write_colmap
from .transforms_files import write_blender, write_nerfstudio
from .usd_cameras import write_usd_cameras


class CameraFormat(NamedTuple):
    """A format of cameras.

    Attributes:
        write: Writes the files into a folder; raises OSError if it cannot, ValueError if it holds no such lens.
        axes: What the summary says about axes.
        has_lens: Whether files have the distortion of lenses.
    """

    write: Callable[[Path, CameraSet], None]
    axes: str
    has_lens: bool


def write_cameras(folder: Path, name: str, cameras: CameraSet) -> str:
    """Writes cameras into a folder in the format of a name in ``CAMERA_FORMATS``; returns a summary.

    Raises:
        ValueError: If the format cannot hold a lens.
        OSError: If a file cannot be written, or a package that writes it is not installed.
    """
    form = CAMERA_FORMATS[name]
    if cameras.has_panoramas and not form.has_lens:
        raise ValueError(f"--cameras {name} holds pinholes, not panoramas: use --cameras nerfstudio or colmap")
    form.write(folder, cameras)
    count = counted(len(cameras.cameras), "camera")
    lines = [f"{count} in {folder}, in the coordinates of the scene's file: {form.axes}"]
    if name == "colmap" and not np.array_equal(cameras.rotation, np.eye(3)):
        lines.append("render --cameras films them only if they are exported with --up scene")
    if cameras.is_distorted and not form.has_lens:
        lines.append(f"--cameras {name} holds pinholes: the distortion of the lens is not in it")
    if any(camera.motion is not None for camera in cameras.cameras.values()):
        lines.append("no format of cameras holds a rolling shutter: poses are those of the middle row")
    return "\n".join(lines)


CAMERA_FORMATS: dict[str, CameraFormat] = {
    "colmap": CameraFormat(
        write_colmap,
        "world to camera, x right, y down, z forward; COLMAP has no times: ids follow them",
        True,
    ),
    "nerfstudio": CameraFormat(write_nerfstudio, "camera to world, x right, y up, z backward; times from 0 to 1", True),
    "blender": CameraFormat(
        write_blender, "camera to world, x right, y up, z backward; times from 0 to 1; square pixels", False
    ),
    "usd": CameraFormat(write_usd_cameras, "they look along -z with y up, moving over the duration", False),
}
"""Formats of cameras by name."""
