"""ViPE: the results of one video: pose, intrinsics, rgb, depth and mask.

pose/<video>.npz has camera-to-world matrices (OpenCV axes) and the indices of their frames, intrinsics/<video>.npz
fx, fy, cx, cy [px], rgb/<video>.mp4 the frames, depth/<video>.zip depth in the units of the cameras (<frame>.exr),
mask/<video>.zip instances of objects that can move (<frame>.png, 0 = none), mask/<video>.txt their names.
"""

import zipfile
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from warpgs.data.capture import Capture
from warpgs.data.exr import read_exr_channel
from warpgs.data.images import decode_bytes
from warpgs.data.lens import Lens
from warpgs.data.npz import read_npz
from warpgs.data.resized import check_shape, inverse_of, resize, resize_mask
from warpgs.data.video_frames import VideoFrames
from warpgs.files import read_bounded, require_file

from .options import LoadOptions
from .posed import PosedFrame, Size, World, every_eighth, posed_capture, world_to_camera

PINHOLE = "PINHOLE"

NOT_OBJECTS = ("sky",)
"""Instances that do not move."""

MAX_ARCHIVE = 64 << 30
"""Maximum size of a .zip file [bytes]."""

MAX_MEMBER = 1 << 30
"""Maximum size of a file in it [bytes]."""

MAX_TEXT = 64 << 20


class VipeLoader:
    """Loads ViPE's results of one video with a pinhole camera; every eighth frame for evaluation.

    Points are unprojected from depth. The masks mark what could move, whether it does or not.
    """

    def recognizes(self, root: Path) -> bool:
        """Whether there are poses, intrinsics and a video of one name."""
        return any((root / f"rgb/{path.stem}.mp4").is_file() for path in (root / "pose").glob("*.npz"))

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_capture``."""
        name = _video_name(root)
        poses = _poses(root / f"pose/{name}.npz")
        video = VideoFrames(root / f"rgb/{name}.mp4")
        _check_cameras(root / f"intrinsics/{name}_camera.txt")
        lenses = _lenses(root / f"intrinsics/{name}.npz", video.size)
        depths = _Archive.open(root / f"depth/{name}.zip") if options.depth else None
        masks = _Archive.open(root / f"mask/{name}.zip")
        still = _still_instances(root / f"mask/{name}.txt")
        frames = []
        for index, pose in sorted(poses.items()):
            if index not in lenses:
                raise ValueError(f"{root}/intrinsics/{name}.npz has no intrinsics of frame {index}")
            read_mask = masks and masks.reader(f"{index:05d}.png")
            read_depth = depths and depths.reader(f"{index:05d}.exr")
            frames.append(
                PosedFrame(
                    f"{index:05d}",
                    lenses[index],
                    pose,
                    float(index),
                    partial(_image, video, index),
                    partial(_static_mask, read_mask, still) if read_mask else None,
                    partial(_inverse_depth, read_depth) if read_depth else None,
                )
            )
        val = every_eighth([frame.name for frame in frames])
        notes = []
        if without := max(0, video.count - len(frames)):
            where = f"pose/{name}.npz has no pose for them"
            notes.append(f"{without} of {video.count} frames of rgb/{name}.mp4 are left out: {where}")
        return posed_capture(root, frames, val, World(points=None, notes=notes), options)


def _video_name(root: Path) -> str:
    names = sorted(path.stem for path in (root / "pose").glob("*.npz"))
    if len(names) != 1:
        found = f"those of {len(names)}" if names else "none"
        raise ValueError(f"{root}/pose must hold the poses of one video, <video>.npz, got {found}")
    return names[0]


def _indexed(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Indices and values of a file."""
    arrays = read_npz(path, ("inds", "data"), MAX_TEXT)
    indices, values = arrays["inds"], arrays["data"].astype(np.float64)
    if indices.ndim != 1 or indices.dtype.kind not in "iu" or values.shape[:1] != indices.shape or not len(indices):
        raise ValueError(f"{path}: inds and data must belong together, got {indices.shape} and {values.shape}")
    if not np.isfinite(values).all() or not ((indices >= 0) & (indices < 10**5)).all():
        raise ValueError(f"{path}: numbers are not finite, or indices not those of frames")
    return indices, values


def _poses(path: Path) -> dict[int, Float[np.ndarray, "3 4"]]:
    indices, matrices = _indexed(path)
    if matrices.shape[1:] != (4, 4):
        raise ValueError(f"{path}: data must have shape [N, 4, 4], got {list(matrices.shape)}")
    try:
        return {int(k): world_to_camera(matrix[:3]) for k, matrix in zip(indices, matrices, strict=True)}
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _lenses(path: Path, size: Size) -> dict[int, Lens]:
    indices, values = _indexed(path)
    if values.shape[1:] != (4,):
        raise ValueError(f"{path}: data must have shape [N, 4], those of pinhole cameras, got {list(values.shape)}")
    try:
        return {
            int(k): Lens(*size, (fx, fy), (cx, cy)).checked()
            for k, (fx, fy, cx, cy) in zip(indices, values.tolist(), strict=True)
        }
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _check_cameras(path: Path) -> None:
    if path.is_file():
        lines = read_bounded(path, MAX_TEXT).decode(errors="replace").splitlines()
        models = {line.partition(":")[2].strip() for line in lines if line.strip()}
        if other := models - {PINHOLE}:
            raise ValueError(f"{path}: the camera model {min(other)} is not supported, only {PINHOLE}")


def _still_instances(path: Path) -> list[int]:
    """Ids of the instances that are the sky."""
    if not path.is_file():
        return []
    lines = read_bounded(path, MAX_TEXT).decode(errors="replace").splitlines()
    pairs = (line.partition(":") for line in lines)
    return [int(k) for k, _, phrase in pairs if k.strip().isdecimal() and phrase.strip() in NOT_OBJECTS]


class _Archive:
    """A .zip file whose members are read one at a time."""

    def __init__(self, path: Path) -> None:
        self.path = path
        require_file(path, MAX_ARCHIVE)
        try:
            with zipfile.ZipFile(path) as archive:
                self._sizes = {info.filename: info.file_size for info in archive.infolist()}
        except (zipfile.BadZipFile, OSError, NotImplementedError) as error:
            raise ValueError(f"{path} is damaged or not a .zip file: {error}") from error

    @staticmethod
    def open(path: Path) -> "_Archive | None":
        """The archive; None if there is no such file."""
        return _Archive(path) if path.exists() else None

    def reader(self, name: str) -> "_Member | None":
        """The member of a name; None if there is none."""
        return _Member(self, name) if name in self._sizes else None

    def read(self, name: str) -> bytes:
        """The content of a member."""
        if self._sizes[name] > MAX_MEMBER:
            raise ValueError(f"{self.path}: {name} has {self._sizes[name]:,} bytes, more than {MAX_MEMBER:,}")
        try:
            with zipfile.ZipFile(self.path) as archive, archive.open(name) as file:
                return file.read(MAX_MEMBER)
        except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError) as error:
            raise ValueError(f"{self.path}: {name} is damaged: {error}") from error


@dataclass(frozen=True)
class _Member:
    """A file in an archive; ``path`` is for messages."""

    archive: _Archive
    name: str

    @property
    def path(self) -> Path:
        return self.archive.path / self.name

    def read(self) -> bytes:
        return self.archive.read(self.name)


def _image(video: VideoFrames, index: int, size: Size) -> np.ndarray:
    return resize(video.read(index), size)


def _static_mask(member: _Member, still: list[int], size: Size) -> Bool[np.ndarray, "H W"]:
    instances = decode_bytes(member.path, member.read())
    if instances.ndim != 2:
        raise ValueError(f"{member.path} must have one channel")
    check_shape(member.path, "the mask", (instances.shape[1], instances.shape[0]), size)
    return resize_mask((instances == 0) | np.isin(instances, still), size)


def _inverse_depth(member: _Member, size: Size) -> Float[np.ndarray, "H W"]:
    try:
        depth = read_exr_channel(member.read(), "Z")
    except ValueError as error:
        raise ValueError(f"{member.path}: {error}") from error
    check_shape(member.path, "the depth", (depth.shape[1], depth.shape[0]), size)
    return inverse_of(depth, size)
