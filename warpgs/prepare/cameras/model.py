"""COLMAP's reconstruction as cameras, if it is good enough to train on."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see ``colmap``
import numpy as np
import pycolmap
from jaxtyping import Float

from warpgs.data.colmap import lens_of
from warpgs.data.lens import Lens

from .recovered import Cameras, NoCamerasError, require_cameras, require_frames

MIN_ANGLE = 1.0
"""Minimum of the median triangulation angle [degrees]; with less, depth is undetermined."""

MIN_POINTS, MIN_POINTS_OF_FEW = 100, 50
"""Minimum number of points; a camera that only rotates gives some by chance. The second is of a few cameras that stand
still, with an image each."""

MAX_ERROR = 2.0
"""Maximum mean reprojection error of a point [px]; others are omitted."""

MIN_TRACK, MIN_TRACK_OF_FEW, FEW_IMAGES = 3, 2, 12
"""Minimum number of images that see a point, and the same if there are few images."""


def read_model(folder: Path) -> Any:
    """COLMAP's reconstruction in a folder; None if it is missing or damaged."""
    try:
        return pycolmap.Reconstruction(folder)
    except (RuntimeError, ValueError, IndexError):
        return None


def cameras_of_model(model: Any, groups: Sequence[Sequence[str]], sources: Sequence[str], weak: bool) -> list[Cameras]:
    """The cameras and the reliable points of a reconstruction.

    Args:
        model: COLMAP's reconstruction.
        groups: Frames of each camera that poses were wanted for.
        sources: Video of each camera, for messages; not needed for one.
        weak: Whether features of low contrast were used.

    Raises:
        NoCamerasError: If there are too few, or the camera hardly moves.
    """
    placed = {Path(i.name).stem: i for i in model.images.values() if i.has_pose}
    images = [[placed[name] for name in sorted(group) if name in placed] for group in groups]
    if len(groups) == 1:
        require_frames(len(placed), len(groups[0]))
    else:
        require_cameras([*map(len, images)], [*map(len, groups)], sources)
    # Each of a few cameras that stand still sees a point once.
    length = MIN_TRACK if len(placed) > FEW_IMAGES else MIN_TRACK_OF_FEW
    points = [p for p in model.points3D.values() if p.track.length() >= length and p.error <= MAX_ERROR]
    error, angle = float(model.compute_mean_reprojection_error()), _angle(model, points)
    _require_parallax(len(points), angle, is_one=len(groups) == 1, is_few=len(placed) <= FEW_IMAGES)
    return [
        Cameras(
            [Path(i.name).stem for i in own],
            _lens_of(own[0]),
            np.array([i.cam_from_world().matrix() for i in own]),
            _positions(points if len(groups) == 1 else _seen(points, own)),
            error,
            angle,
            weak,
        )
        for own in images
    ]


def _lens_of(image: Any) -> Lens:
    try:
        lens = lens_of(image.camera)
        _ = lens.distortion
    except ValueError as error:
        raise NoCamerasError(f"the lens that was found is wrong ({error}): give it (--focal, --intrinsics)") from error
    return lens


def _seen(points: Sequence[Any], images: Sequence[Any]) -> list[Any]:
    """The points that some images see."""
    ids = {image.image_id for image in images}
    return [point for point in points if any(element.image_id in ids for element in point.track.elements)]


def _positions(points: Sequence[Any]) -> Float[np.ndarray, "P 3"]:
    return np.array([p.xyz for p in points]).reshape(-1, 3)


def _require_parallax(num_points: int, angle: float, *, is_one: bool, is_few: bool) -> None:
    """Raises NoCamerasError if there are too few points, or the camera hardly moves."""
    whose = "the camera hardly moves" if is_one else "the cameras are at nearly one place"
    least = MIN_POINTS_OF_FEW if is_few and not is_one else MIN_POINTS
    if num_points < least:
        raise NoCamerasError(
            f"only {num_points} points were found, at least {least} are needed: too little of what stands "
            f"still is sharp and has texture, or {whose}"
        )
    if angle < MIN_ANGLE:
        advice = "walk around the scene instead of turning on the spot" if is_one else "film from different places"
        raise NoCamerasError(
            f"{whose}: the median triangulation angle is {angle:.1f}°, at least {MIN_ANGLE}° is needed; {advice}"
        )


def _angle(model: Any, points: list[Any]) -> float:
    """Median triangulation angle of some points [degrees]: the largest angle between two rays to a point."""
    largest = []
    for point in points[:: max(1, len(points) // 500)]:
        centers = [model.images[e.image_id].projection_center() for e in point.track.elements]
        rays = np.array(centers) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        largest.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return float(np.median(largest)) if largest else 0.0
