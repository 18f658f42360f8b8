"""What a capture takes from a COLMAP model: lenses, poses, and points with their colours.

COLMAP measures pixels from the corner of the image, as we do, and poses are world-to-camera with OpenCV axes.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from .colmap_files import read_model
from .lens import Lens

if TYPE_CHECKING:
    import pycolmap

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
"""Where a capture has its model."""

SIMPLE = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
"""Camera models with one focal length."""

FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")
"""Models of fisheye lenses, with 1, 2 and 4 coefficients; the first two have one focal length."""


class ModelImage(NamedTuple):
    """An image of a model: its file name, lens, and [3, 4] world-to-camera pose."""

    name: str
    lens: Lens
    pose: Float[np.ndarray, "3 4"]


class Model(NamedTuple):
    """A model: posed images, [P, 3] points and their RGB colours."""

    images: list[ModelImage]
    points: Float[np.ndarray, "P 3"]
    colors: UInt8[np.ndarray, "P 3"]


def find_model(root: Path) -> Path | None:
    """The folder of a capture's model; None if it has none."""
    found = (root / name for name in MODEL_FOLDERS)
    return next((path for path in found if any((path / f"cameras.{s}").is_file() for s in ("bin", "txt"))), None)


def load_model(folder: Path) -> Model:
    """The model of a folder.

    Raises:
        ValueError: If a file is missing or damaged, or a camera model cannot be represented.
    """
    model = read_model(folder)
    images = []
    for image in model.images.values():
        if image.has_pose:
            camera = model.cameras[image.camera_id]
            try:
                lens = lens_of(camera)
            except ValueError as error:
                raise ValueError(f"{folder}: camera {image.camera_id}: {error}") from error
            images.append(ModelImage(image.name, lens, image.cam_from_world().matrix()))
    found = [point for _, point in sorted(model.points3D.items())]
    points = np.array([point.xyz for point in found], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in found], np.uint8).reshape(-1, 3)
    return Model(images, points, colors)


def lens_of(camera: pycolmap.Camera) -> Lens:
    """The lens of a camera of a model.

    Raises:
        ValueError: If its camera model cannot be represented, or a number is out of range.
    """
    model, params = camera.model.name, camera.params.tolist()
    if model not in ("PINHOLE", "OPENCV", "FULL_OPENCV", *SIMPLE, *FISHEYE) or any(params[9:]):
        raise ValueError(f"the camera model {model} is not supported; first run colmap image_undistorter")
    fx, fy, cx, cy, *bent = (params[0], *params) if model in (*SIMPLE, *FISHEYE[:2]) else params
    if model in FISHEYE:
        k1, k2, k3, k4 = [*bent, 0.0, 0.0, 0.0][:4]
        return Lens(camera.width, camera.height, (fx, fy), (cx, cy), fisheye=(k1, k2, k3, k4)).checked()
    k1, k2, p1, p2, k3 = [*bent, 0.0, 0.0, 0.0, 0.0, 0.0][:5]  # in this order, as far as the model has them
    return Lens(camera.width, camera.height, (fx, fy), (cx, cy), (k1, k2, k3), (p1, p2)).checked()
