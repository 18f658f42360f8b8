"""DyNeRF (Neural 3D Video): still, synchronised cameras, a video or folder of frames each, and poses_bounds.npy.

Row k of poses_bounds.npy, as in ``llff``, is the camera of the k-th of cam00.mp4, cam01.mp4, … or of the folders
cam00/ or cam00/images/, …, in the order of their names. Numbers may be missing among them.
"""

import re
import threading
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgs.data.capture import Capture
from warpgs.data.images import image_size
from warpgs.data.resized import read_resized_image, resize
from warpgs.data.time_source import TimeSource, with_steps
from warpgs.data.video_frames import VideoFrames
from warpgs.files import natural_order

from .llff import INDEX, lens_of_row, read_poses, world_of
from .options import LoadOptions
from .posed import PosedFrame, Size, posed_capture
from .skipped import IMAGE_SUFFIXES

CAMERA = re.compile(r"(?i)cam(?:era)?[_-]?([0-9]{1,6})")
"""Name of the folder or, before .mp4, the video of a camera."""

MIN_CAMERAS = 2
"""With one, the folder holds a single video, which ``warpgs prepare`` reads."""

OPEN_VIDEOS = 3
"""Number of videos that are kept open, with the frames that they decoded last."""

OPENING = threading.Lock()


class _Camera(NamedTuple):
    """A camera: its number, its file or folder, and what reads each of its frames in a size."""

    id: int
    path: Path
    size: Size
    frames: list[Callable[[Size], np.ndarray]]


class DynerfLoader:
    """Loads the frames of all cameras; those of the first camera are for evaluation, as in the paper of DyNeRF."""

    def recognizes(self, root: Path) -> bool:
        """Whether there are a poses_bounds.npy and videos or folders of several cameras."""
        return (root / INDEX).is_file() and len(_files(root)) >= MIN_CAMERAS

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        poses, bounds, sizes, notes = read_poses(root / INDEX)
        files = _files(root)
        if len(files) != len(poses):
            raise ValueError(
                f"{root / INDEX} has {len(poses)} cameras, but {root} has {len(files)} videos or folders cam<number>"
            )
        cameras = [_camera(number, path) for number, path in files.items()]
        lenses = [lens_of_row(root, c.path, c.size, size) for c, size in zip(cameras, sizes, strict=True)]
        frames = [
            PosedFrame(f"cam{camera.id:02d}_{k:05d}", lens, pose, float(k), read, camera=camera.id)
            for camera, lens, pose in zip(cameras, lenses, poses, strict=True)
            for k, read in enumerate(camera.frames)
        ]
        text = with_steps("times from the order of each camera's frames", [frame.time for frame in frames], " frames")
        world = world_of(root, poses, bounds)
        world = replace(world, time_source=TimeSource(text), notes=(*world.notes, *notes, *_uneven(cameras)))
        val = {frame.name for frame in frames if frame.camera == cameras[0].id}
        return posed_capture(root, frames, val, world, options)


def _files(root: Path) -> dict[int, Path]:
    """The folder or the video of each camera by its number, in ascending order; folders, if there are as many.

    Raises:
        ValueError: If two videos, or two folders, have one number.
    """
    folders: dict[int, Path] = {}
    videos: dict[int, Path] = {}
    for path in sorted(root.iterdir()):
        found = folders if path.is_dir() else videos if path.suffix.lower() == ".mp4" else {}
        if match := CAMERA.fullmatch(path.name if path.is_dir() else path.stem):
            first = found.setdefault(int(match[1]), path)
            if first != path:
                raise ValueError(f"{first} and {path} are both of camera {int(match[1])}: number cameras differently")
    return dict(sorted(max(folders, videos, key=len).items()))


def _camera(number: int, path: Path) -> _Camera:
    if not path.is_dir():
        modified = path.stat().st_mtime_ns
        video = _opened(path, modified)
        if video.count < 1:
            raise ValueError(f"{path} does not say how many frames it has: write it again, as with ffmpeg -c copy")
        return _Camera(number, path, video.size, [partial(_decoded, path, modified, k) for k in range(video.count)])
    folder = path / "images" if (path / "images").is_dir() else path
    images = [image for image in folder.iterdir() if image.suffix.lower() in IMAGE_SUFFIXES]
    if not images:
        raise ValueError(f"{folder} has no images")
    images.sort(key=lambda image: natural_order(image.name))
    return _Camera(number, path, image_size(images[0]), [partial(read_resized_image, image) for image in images])


@lru_cache(OPEN_VIDEOS)
def _open(path: Path, modified: int) -> VideoFrames:
    return VideoFrames(path)


def _opened(path: Path, modified: int) -> VideoFrames:
    """The frames of a video, which was changed at a time [ns]."""
    with OPENING:  # threads that read ahead would open it several times
        return _open(path, modified)


def _decoded(path: Path, modified: int, index: int, size: Size) -> np.ndarray:
    return resize(_opened(path, modified).read(index), size)


def _uneven(cameras: list[_Camera]) -> list[str]:
    """A note on cameras with fewer frames than others."""
    most = max(cameras, key=lambda camera: len(camera.frames))
    fewest = min(cameras, key=lambda camera: len(camera.frames))
    if len(most.frames) == len(fewest.frames):
        return []
    counts = f"{len(fewest.frames)} frames and {most.path.name} {len(most.frames)}"
    return [f"{fewest.path.name} has {counts}: they are taken to begin at one time"]
