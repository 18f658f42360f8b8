"""Cameras and sparse points as structure from motion recovers them."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from warpgs.data.archive import Archive
from warpgs.data.lens import Lens
from warpgs.files import DAMAGED_ARRAY

MAX_BYTES = 1 << 30
"""Maximum size of a file of cameras and points [bytes]."""

PLAUSIBLE_FOCAL = (0.4, 3.0)
"""Range of the focal length over the longer side outside of which one that was found is doubtful: from 103° to 19°
across, lenses of 14 to 108 mm on 35 mm film. COLMAP itself accepts 0.1 to 10."""

MISLED = 0.7
"""Reprojection error without dynamic regions over that with them, below which dynamic objects misled the cameras."""


MIN_REGISTERED = 0.5
"""Minimum fraction of the frames that get a camera."""


class NoCamerasError(ValueError):
    """The cameras cannot be recovered from the frames."""


def require_frames(count: int, of: int) -> None:
    """Raises NoCamerasError if fewer than ``MIN_REGISTERED`` of the frames have a camera, or fewer than three."""
    if count < max(MIN_REGISTERED * of, 3):
        raise NoCamerasError(
            f"cameras were found for only {count} of {of} frames: too much moves, the camera moves too fast, or the "
            "frames have too little texture; try more frames (--fps, --count), a slower part of the video, or masks of "
            "what moves (--masks FOLDER)"
        )


def require_cameras(counts: Sequence[int], of: Sequence[int], sources: Sequence[str]) -> None:
    """Raises NoCamerasError unless each of several cameras has poses of ``MIN_REGISTERED`` of its frames.

    Args:
        counts: Number of posed frames of each camera.
        of: Number of its frames.
        sources: Its video, for the message.
    """
    found = [source for count, source in zip(counts, sources, strict=True) if count]
    if lost := [source for count, source in zip(counts, sources, strict=True) if not count]:
        shares = "shares" if len(lost) == 1 else "share"
        raise NoCamerasError(
            f"{' and '.join(lost)} {shares} no view with {' and '.join(found) or 'each other'}: too little of what "
            "stands still is seen by both; film the same surfaces from directions less than about 20° apart, or leave "
            "out what shows another place"
        )
    for count, total, source in zip(counts, of, sources, strict=True):
        if count < MIN_REGISTERED * total:
            raise NoCamerasError(
                f"cameras were found for only {count} of {total} frames of {source}: it moves too fast, or shares too "
                "little of its view with the other videos; take more frames (--fps, --count), or leave it away"
            )


def are_apart(centers: Float[np.ndarray, "F 3"]) -> bool:
    """Whether cameras are at different places, by more than the rounding of their files."""
    return bool(np.ptp(centers, axis=0).max() > 1e-6 * (1.0 + np.abs(centers).max()))


@dataclass(frozen=True)
class Cameras:
    """Posed frames of one camera, with one lens, and sparse points.

    Attributes:
        names: Frames that were registered, in temporal order.
        lens: The lens of all frames.
        poses: [F, 3, 4] world to camera, OpenCV axes.
        points: [P, 3] in the world; of one of several cameras, those that it sees.
        error: Mean reprojection error [px].
        angle: Median triangulation angle of the points [degrees].
        weak_features: Whether features of low contrast were used.
        has_held_focal: Whether the focal length is a guess that was held, because the one found was implausible.
    """

    names: list[str]
    lens: Lens
    poses: Float[np.ndarray, "F 3 4"]
    points: Float[np.ndarray, "P 3"]
    error: float
    angle: float
    weak_features: bool = False
    has_held_focal: bool = False

    @property
    def centers(self) -> Float[np.ndarray, "F 3"]:
        """[F, 3] centres of the cameras in the world."""
        return camera_centers(self.poses)

    @property
    def have_parallax(self) -> bool:
        """Whether they are at different places."""
        return are_apart(self.centers)

    def save(self, path: Path) -> None:
        """Writes <path>.npz."""
        lens = self.lens
        np.savez(
            f"{path}.npz",
            names=np.array(self.names),
            lens=np.array([lens.width, lens.height, *lens.focal, *lens.center]),
            coefficients=np.array(lens.coefficients),
            model=np.array(lens.model),
            poses=self.poses,
            points=self.points,
            quality=np.array([self.error, self.angle]),
            flags=np.array([self.weak_features, self.has_held_focal]),
        )

    @staticmethod
    def load(path: Path) -> "Cameras":
        """The cameras that ``save`` wrote.

        Raises:
            ValueError: If the file is missing or damaged.
        """
        file = path.with_name(path.name + ".npz")
        archive = Archive(file, MAX_BYTES)
        contents = {name.removesuffix(".npy"): archive.read(name, MAX_BYTES) for name in archive.sizes}
        try:
            found = Cameras._parse({name: np.load(io.BytesIO(data)) for name, data in contents.items()})
        except (*DAMAGED_ARRAY, KeyError, IndexError) as error:
            raise ValueError(f"{file} is damaged: {error}") from error
        numbers = (found.poses, found.points, found.lens.focal, found.lens.center)
        if found.poses.shape != (len(found.names), 3, 4) or not all(np.isfinite(n).all() for n in numbers):
            raise ValueError(f"{file} is damaged: expected a finite pose of every frame")
        return found

    @staticmethod
    def _parse(z: Mapping[str, np.ndarray]) -> "Cameras":
        width, height, fx, fy, cx, cy = z["lens"].tolist()
        lens = Lens(
            int(width),
            int(height),
            (fx, fy),
            (cx, cy),
            tuple(z["coefficients"].tolist()),
            str(z["model"]),  # type: ignore[arg-type]
        )
        error, angle = z["quality"].tolist()
        flags = map(bool, z["flags"])
        return Cameras(z["names"].tolist(), lens, z["poses"], z["points"], error, angle, *flags)


def save_all(cameras: Sequence[Cameras], path: Path) -> None:
    """Writes <path>-<k>.npz for each of several cameras, or <path>.npz for one."""
    for own, place in zip(cameras, _paths(path, len(cameras)), strict=True):
        own.save(place)


def load_all(path: Path, count: int) -> list[Cameras]:
    """The ``count`` cameras that ``save_all`` wrote.

    Raises:
        ValueError: If a file is missing or damaged.
    """
    return [Cameras.load(place) for place in _paths(path, count)]


def files_of_all(path: Path, count: int) -> list[Path]:
    """The files of ``count`` cameras that ``save_all`` writes."""
    return [place.with_name(place.name + ".npz") for place in _paths(path, count)]


def _paths(path: Path, count: int) -> list[Path]:
    return [path] if count == 1 else [path.with_name(f"{path.name}-{k}") for k in range(count)]


def camera_centers(poses: Float[np.ndarray, "F 3 4"]) -> Float[np.ndarray, "F 3"]:
    """[F, 3] centres of cameras of world-to-camera poses."""
    return -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])
