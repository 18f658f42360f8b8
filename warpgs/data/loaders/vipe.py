"""ViPE: the results of one video: pose, intrinsics, rgb, depth and mask.

pose/<video>.npz has camera-to-world matrices (OpenCV axes) and the indices of their frames, intrinsics/<video>.npz
fx, fy, cx, cy [px], rgb/<video>.mp4 the frames, depth/<video>.zip depth in the units of the cameras (<frame>.exr),
mask/<video>.zip instances of objects that can move (<frame>.png, 0 = none), mask/<video>.txt their names.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from warpgs.data.archive import Archive
from warpgs.data.capture import Capture, Conventions
from warpgs.data.exr import exr_size, read_exr_channel
from warpgs.data.images import decode_bytes, max_depth_pixels
from warpgs.data.lens import Lens, unsupported_model
from warpgs.data.npz import read_npz
from warpgs.data.resized import check_shape, inverse_of, resize, resize_mask
from warpgs.data.time_source import TimeSource, with_steps
from warpgs.data.video_frames import VideoFrames
from warpgs.files import read_bounded

from .options import LoadOptions
from .posed import PosedFrame, Size, World, every_eighth, posed_capture, world_to_cameras

PINHOLE = "PINHOLE"

NOT_OBJECTS = ("sky",)
"""Instances that do not move."""

MAX_MEMBER = 1 << 30
"""Maximum size of an image or depth in a .zip file [bytes]."""

MAX_TEXT = 64 << 20
"""Maximum size of other files [bytes]."""

MAX_DIGITS = 9
"""Maximum number of digits of the number of an instance."""

CONVENTIONS = Conventions(depth="depth", depth_unit="the scale of the poses")


class VipeLoader:
    """Loads ViPE's results of one video with a pinhole camera; every eighth frame for evaluation.

    Points are unprojected from depth. The masks mark what could move, whether it does or not.
    """

    def recognizes(self, root: Path) -> bool:
        """Whether there are poses, intrinsics and a video of one name."""
        return any((root / f"rgb/{path.stem}.mp4").is_file() for path in (root / "pose").glob("*.npz"))

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        name = _video_name(root)
        poses, scaled = _poses(root / f"pose/{name}.npz")
        video = VideoFrames(root / f"rgb/{name}.mp4")
        _check_cameras(root / f"intrinsics/{name}_camera.txt")
        lenses = _lenses(root / f"intrinsics/{name}.npz", video.size)
        depths = _archive(root / f"depth/{name}.zip") if options.depth else None
        masks = _archive(root / f"mask/{name}.zip")
        still = _still_instances(root / f"mask/{name}.txt")
        frames = []
        for index, pose in sorted(poses.items()):
            if index not in lenses:
                raise ValueError(f"{root}/intrinsics/{name}.npz has no intrinsics of frame {index}")
            read_mask = _member(masks, f"{index:05d}.png")
            read_depth = _member(depths, f"{index:05d}.exr")
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
        text = f"times from the numbers of the frames in rgb/{name}.mp4"
        source = TimeSource(with_steps(text, [frame.time for frame in frames], " frames"))
        notes = [*scaled]
        if without := max(0, video.count - len(frames)):
            where = f"pose/{name}.npz has no pose for them"
            notes.append(f"{without} of {video.count} frames of rgb/{name}.mp4 are skipped: {where}")
        world = World(points=None, time_source=source, notes=notes, conventions=CONVENTIONS)
        return posed_capture(root, frames, val, world, options)


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


def _poses(path: Path) -> tuple[dict[int, Float[np.ndarray, "3 4"]], tuple[str, ...]]:
    """World-to-camera poses by frame, and notes."""
    indices, matrices = _indexed(path)
    if matrices.shape[1:] != (4, 4):
        raise ValueError(f"{path}: data must have shape [N, 4, 4], got {list(matrices.shape)}")
    poses, notes = world_to_cameras(path, matrices[:, :3])
    return {int(k): pose for k, pose in zip(indices, poses, strict=True)}, notes


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
            raise ValueError(f"{path}: {unsupported_model(min(other)[:60], f'run ViPE with a {PINHOLE} camera')}")


def _still_instances(path: Path) -> list[int]:
    """Ids of the instances that are the sky."""
    if not path.is_file():
        return []
    lines = read_bounded(path, MAX_TEXT).decode(errors="replace").splitlines()
    pairs = [(k.strip(), phrase.strip()) for k, _, phrase in (line.partition(":") for line in lines)]
    still = [k for k, phrase in pairs if k.isdecimal() and phrase in NOT_OBJECTS]
    if invalid := [k for k in still if len(k) > MAX_DIGITS]:
        raise ValueError(f"{path}: an instance has a number of {len(invalid[0])} digits, expected at most {MAX_DIGITS}")
    return [int(k) for k in still]


@dataclass(frozen=True)
class _Member:
    """A file in an archive; ``path`` is for messages."""

    archive: Archive
    name: str

    @property
    def path(self) -> Path:
        return self.archive.path / self.name

    def read(self) -> bytes:
        return self.archive.read(self.name, MAX_MEMBER)


def _archive(path: Path) -> Archive | None:
    """An archive; None if there is no such file."""
    return Archive(path) if path.exists() else None


def _member(archive: Archive | None, name: str) -> _Member | None:
    """The member of a name; None if there is none."""
    return None if archive is None or name not in archive.sizes else _Member(archive, name)


def _image(video: VideoFrames, index: int, size: Size) -> np.ndarray:
    return resize(video.read(index), size)


def _static_mask(member: _Member, still: list[int], size: Size) -> Bool[np.ndarray, "H W"]:
    instances = decode_bytes(member.path, member.read())
    if instances.ndim != 2:
        raise ValueError(f"{member.path} must have one channel")
    check_shape(member.path, "the mask", (instances.shape[1], instances.shape[0]), size)
    return resize_mask((instances == 0) | np.isin(instances, still), size)


def _inverse_depth(member: _Member, size: Size) -> Float[np.ndarray, "H W"]:
    data = member.read()
    check_shape(member.path, "the depth", exr_size(member.path, data), size)
    return inverse_of(read_exr_channel(member.path, data, "Z", max_depth_pixels(size)), size)
