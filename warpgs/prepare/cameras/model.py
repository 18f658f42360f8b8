"""COLMAP's reconstruction as cameras, if it is good enough to train on."""

from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see ``colmap``
import numpy as np
import pycolmap

from warpgs.data.colmap import lens_of

from .recovered import Cameras, NoCamerasError, require_frames

MIN_ANGLE = 1.0
"""Minimum of the median triangulation angle [degrees]; with less, depth is undetermined."""

MIN_POINTS = 100
"""Minimum number of points; a camera that only rotates gives some by chance."""

MAX_ERROR = 2.0
"""Maximum mean reprojection error of a point [px]; others are omitted."""


def read_model(folder: Path) -> Any:
    """COLMAP's reconstruction in a folder; None if it is missing or damaged."""
    try:
        return pycolmap.Reconstruction(folder)
    except (RuntimeError, ValueError, IndexError):
        return None


def cameras_of_model(model: Any, names: list[str], weak_features: bool) -> Cameras:
    """The cameras and the reliable points of a reconstruction.

    Args:
        model: COLMAP's reconstruction.
        names: Frames that cameras were wanted for.
        weak_features: Whether features of low contrast were used.

    Raises:
        NoCamerasError: If there are too few, or the camera hardly moves.
    """
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    require_frames(len(images), len(names))
    poses = np.array([i.cam_from_world().matrix() for i in images])
    try:
        lens = lens_of(images[0].camera)
        _ = lens.distortion
    except ValueError as error:
        raise NoCamerasError(f"the lens that was found is wrong ({error}): give it (--focal, --intrinsics)") from error
    points = [p for p in model.points3D.values() if p.track.length() >= 3 and p.error <= MAX_ERROR]
    found = Cameras(
        [Path(i.name).stem for i in images],
        lens,
        poses,
        np.array([p.xyz for p in points]).reshape(-1, 3),
        float(model.compute_mean_reprojection_error()),
        _angle(model, points),
        weak_features,
    )
    _require_parallax(found)
    return found


def _require_parallax(found: Cameras) -> None:
    """Raises NoCamerasError if there are too few points, or the camera hardly moves."""
    if len(found.points) < MIN_POINTS:
        raise NoCamerasError(
            f"only {len(found.points)} points were found, at least {MIN_POINTS} are needed: too little of what stands "
            "still is sharp and has texture, or the camera hardly moves"
        )
    if found.angle < MIN_ANGLE:
        raise NoCamerasError(
            f"the camera hardly moves: the median triangulation angle is {found.angle:.1f}°, at least {MIN_ANGLE}° is "
            "needed; walk around the scene instead of turning on the spot"
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
