"""What a capture takes from a COLMAP model: lenses, poses, and points with their colours.

COLMAP measures pixels from the corner of the image, as we do, and poses are world-to-camera with OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from .colmap_files import read_model
from .lens import DistortionModel, Lens, unsupported_model

if TYPE_CHECKING:
    import pycolmap

SIMPLE = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
"""Camera models with one focal length."""

NUM_PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "FULL_OPENCV": 12,
    "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "OPENCV_FISHEYE": 8,
}  # fmt: skip
"""Camera models that can be represented, and the number of their parameters: focal lengths, principal point, and
OpenCV's coefficients as far as the model has them."""

PANORAMA = "EQUIRECTANGULAR"
"""The camera model of panoramas, whose parameters are width and height."""


class ModelImage(NamedTuple):
    """An image of a model: its file name, lens, [3, 4] world-to-camera pose, and the id of its camera."""

    name: str
    lens: Lens
    pose: Float[np.ndarray, "3 4"]
    camera: int


class Model(NamedTuple):
    """A model: posed images, [P, 3] points and their RGB colours, and what had to be interpreted, one sentence each."""

    images: list[ModelImage]
    points: Float[np.ndarray, "P 3"]
    colors: UInt8[np.ndarray, "P 3"]
    notes: list[str]


def load_model(folder: Path) -> Model:
    """The model of a folder.

    Raises:
        ValueError: If a file is missing or damaged, or a camera model cannot be represented.
    """
    images: list[ModelImage] = []
    notes: list[str] = []
    model = read_model(folder, notes.append)
    for image in model.images.values():
        if image.has_pose:
            camera = model.cameras[image.camera_id]
            try:
                lens = lens_of(camera)
            except ValueError as error:
                raise ValueError(f"{folder}: camera {image.camera_id}: {error}") from error
            images.append(ModelImage(image.name, lens, image.cam_from_world().matrix(), image.camera_id))
    found = [point for _, point in sorted(model.points3D.items())]
    points = np.array([point.xyz for point in found], np.float64).reshape(-1, 3)
    colors = np.array([point.color for point in found], np.uint8).reshape(-1, 3)
    return Model(images, points, colors, notes)


def lens_of(camera: pycolmap.Camera) -> Lens:
    """The lens of a camera of a model; as ``lens_of_parameters``."""
    return lens_of_parameters(camera.model.name, (camera.width, camera.height), camera.params.tolist())


def lens_of_parameters(model: str, size: tuple[int, int], params: Sequence[float]) -> Lens:
    """The lens of a camera model, the (width, height) of its images, and its parameters.

    Args:
        model: Name of the camera model.
        size: Width and height of the images [px].
        params: Parameters of the camera model.

    Raises:
        ValueError: If the camera model cannot be represented, or a number is missing or out of range.
    """
    if model == PANORAMA:
        return Lens.panorama(size)
    if model not in NUM_PARAMETERS:
        raise ValueError(unsupported_model(model, "first run colmap image_undistorter, whose output is read"))
    if len(params) != NUM_PARAMETERS[model]:
        raise ValueError(f"{model} has {NUM_PARAMETERS[model]} parameters, got {len(params)}")
    fx, fy, cx, cy, *coefficients = (params[0], *params) if model in SIMPLE else params
    kind: DistortionModel = "fisheye" if model.endswith("FISHEYE") else "radial"
    return Lens(*size, (fx, fy), (cx, cy), tuple(coefficients), kind).checked()


def parameters_of_lens(lens: Lens) -> tuple[str, list[float]]:
    """The camera model that represents a lens, and its parameters."""
    if lens.is_panorama:
        return PANORAMA, [float(lens.width), float(lens.height)]
    name = "OPENCV_FISHEYE" if lens.model == "fisheye" else "OPENCV" if len(lens.coefficients) <= 4 else "FULL_OPENCV"
    parameters = [*lens.focal, *lens.center, *lens.coefficients, *[0.0] * 8]
    return name, parameters[: NUM_PARAMETERS[name]]
