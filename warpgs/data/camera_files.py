"""Camera files of the layout of Nerfies: camera/<id>.json."""

import reprlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from warpgs.cameras import Camera
from warpgs.files import read_json, read_numbers

from .lens import Lens
from .units import SceneUnits

MAX_ROTATION_ERROR = 1e-3
"""Maximum entry of R Rᵀ − 1 for a rotation R; the files have at least six digits."""


def is_rotation(matrix: Float[np.ndarray, "3 3"]) -> bool:
    """Whether a matrix from a file is a rotation, to the digits that files have."""
    return not (np.abs(matrix @ matrix.T - np.eye(3)).max() > MAX_ROTATION_ERROR or np.linalg.det(matrix) < 0)


def read_camera(
    path: Path, units: SceneUnits, factor: int, time: float, distortion: bool = True
) -> tuple[Camera, Lens]:
    """The camera of a frame, and its lens.

    In the file, ``orientation`` is the world-to-camera rotation (OpenCV axes) and ``position`` the camera centre in the
    world. Focal length and principal point are in pixels of the full size.

    Args:
        path: camera/<id>.json.
        units: Scene units of the capture.
        factor: Downscaling factor of the image.
        time: Time of the frame in [0, 1].
        distortion: Whether with its distortion and principal point; see ``load_capture``.

    Raises:
        ValueError: If the file is missing or damaged, or a field is missing or invalid.
    """
    fields = read_json(path, "every frame needs its camera")
    lens = _lens(path, fields, factor)
    rotation, position = read_numbers(path, fields, "orientation", (3, 3)), read_numbers(path, fields, "position", (3,))
    if not is_rotation(rotation):
        raise ValueError(f"{path}: orientation is not a rotation")
    try:
        lens = lens if distortion else lens.centered_pinhole
        return lens.checked().camera(rotation, units.from_world(position), time), lens
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _lens(path: Path, fields: dict[str, Any], factor: int) -> Lens:
    focal, aspect = _number(path, fields, "focal_length"), _number(path, fields, "pixel_aspect_ratio", 1.0)
    if skew := _number(path, fields, "skew", 0.0):
        raise ValueError(f"{path}: cameras must have no skew, got {skew}")
    x, y = read_numbers(path, fields, "principal_point", (2,)) / factor
    # Old files call the field "tangential"; some have a third coefficient, 0.
    tangential = "tangential_distortion" if "tangential_distortion" in fields else "tangential"
    k1, k2, k3 = _coefficients(path, fields, "radial_distortion", 3)
    p1, p2 = _coefficients(path, fields, tangential, 2)
    rational = _coefficients(path, fields, "rational_distortion", 3)
    radial = (k1, k2, p1, p2, k3, *rational, *_coefficients(path, fields, "prism_distortion", 4))
    fisheye = _coefficients(path, fields, "fisheye_distortion", 4) if "fisheye_distortion" in fields else None
    if fisheye is not None and any(radial):
        raise ValueError(f"{path}: a fisheye_distortion cannot have others beside it")
    if (is_panorama := fields.get("equirectangular", False)) not in (True, False):
        raise ValueError(f"{path}: equirectangular must be true or false, got {reprlib.repr(is_panorama)}")
    if is_panorama and (fisheye is not None or any(radial)):
        raise ValueError(f"{path}: an equirectangular image has no distortion")
    full = read_numbers(path, fields, "image_size", (2,))
    # Rounded as in Nerfies, whose code created the images.
    width, height = (round(float(side) / factor) for side in full)
    return Lens(
        width=width,
        height=height,
        focal=(focal / factor, focal * aspect / factor),
        center=(float(x), float(y)),
        coefficients=radial if fisheye is None else tuple(fisheye),
        model="equirectangular" if is_panorama else "radial" if fisheye is None else "fisheye",
    )


def _number(path: Path, fields: dict[str, Any], key: str, default: float | None = None) -> float:
    given = fields if default is None else {key: default, **fields}
    return float(read_numbers(path, given, key, ()))


def _coefficients(path: Path, fields: dict[str, Any], key: str, count: int) -> list[float]:
    """The first ``count`` coefficients of a list, padded with zeros; further coefficients must be zero."""
    given = fields.get(key) or []
    values = read_numbers(path, {key: given}, key, (len(given) if isinstance(given, list) else count,)).tolist()
    if any(values[count:]):
        raise ValueError(f"{path}: {key} must be {count} numbers, got {reprlib.repr(given)}")
    return [*values, *[0.0] * count][:count]
