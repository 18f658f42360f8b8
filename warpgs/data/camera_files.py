"""Cameras as Nerfies' layout has them: camera/<id>.json."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from warpgs.cameras import Camera
from warpgs.files import read_json

from .images import MAX_SIDE
from .lens import Lens, pinhole_matrix
from .units import SceneUnits

MAX_ROTATION_ERROR = 1e-3
"""Largest entry of R Rᵀ − 1 of a rotation; the files have six digits and more."""


def read_camera(path: Path, units: SceneUnits, factor: int, time: float) -> tuple[Camera, Lens]:
    """The pinhole camera of a frame, and the lens whose pictures are to be straightened for it.

    ``orientation`` has the world-to-camera rotation as rows, OpenCV axes; ``position`` is the camera's centre in the
    world. Focal length and principal point are in pixels of the full size.

    Args:
        path: camera/<id>.json.
        units: Of the scene.
        factor: Downscaling of the pictures.
        time: Moment in [0, 1].

    Raises:
        ValueError: If the file is missing, damaged, or no camera.
    """
    facts = read_json(path, "every frame needs its camera")
    lens = _lens(path, facts, factor)
    rotation, position = _numbers(path, facts, "orientation", (3, 3)), _numbers(path, facts, "position", (3,))
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
        raise ValueError(f"{path}: orientation is not a rotation")
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ units.from_world(position)
    try:
        K = pinhole_matrix(lens)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    viewmat_tensor, K_tensor = (torch.tensor(m, dtype=torch.float32) for m in (viewmat, K))
    return Camera(viewmat_tensor, K_tensor, lens.width, lens.height, time), lens


def _lens(path: Path, facts: dict[str, Any], factor: int) -> Lens:
    focal, aspect = _number(path, facts, "focal_length"), _number(path, facts, "pixel_aspect_ratio", 1.0)
    if focal <= 0 or aspect <= 0:
        raise ValueError(f"{path}: focal_length and pixel_aspect_ratio must be positive, got {focal}, {aspect}")
    if skew := _number(path, facts, "skew", 0.0):
        raise ValueError(f"{path}: cameras must have no skew, got {skew}; none of the datasets has any")
    x, y = _numbers(path, facts, "principal_point", (2,)) / factor
    # Old files say "tangential"; some hold a third zero.
    tangential = "tangential_distortion" if "tangential_distortion" in facts else "tangential"
    k1, k2, k3 = _coefficients(path, facts, "radial_distortion", 3)
    p1, p2 = _coefficients(path, facts, tangential, 2)
    full = _numbers(path, facts, "image_size", (2,))
    # As Nerfies rounds; the pictures are from the same code.
    width, height = (round(float(side) / factor) for side in full)
    if not (full > 0).all() or not 0 < min(width, height) <= max(width, height) <= MAX_SIDE:
        raise ValueError(f"{path}: image_size {full.tolist()} is out of range")
    return Lens(
        width=width,
        height=height,
        focal=(focal / factor, focal * aspect / factor),
        center=(float(x), float(y)),
        radial=(k1, k2, k3),
        tangential=(p1, p2),
    )


def _numbers(path: Path, facts: dict[str, Any], key: str, shape: tuple[int, ...]) -> Float[np.ndarray, "..."]:
    if key not in facts:
        raise ValueError(f"{path} has no {key}")
    try:
        values = np.array(facts[key], dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {key} must hold numbers") from error
    if values.shape != shape or not np.isfinite(values).all():
        raise ValueError(f"{path} must hold finite numbers: {key} is {list(shape)}, got {_short(facts[key])}")
    return values


def _number(path: Path, facts: dict[str, Any], key: str, default: float | None = None) -> float:
    given = facts if default is None else {key: default, **facts}
    return float(_numbers(path, given, key, ()))


def _coefficients(path: Path, facts: dict[str, Any], key: str, count: int) -> list[float]:
    """The first ``count`` of a list of coefficients, zeros for those that are not given; the rest must be zero."""
    given = facts.get(key) or []
    values = _numbers(path, {key: given}, key, (len(given) if isinstance(given, list) else count,)).tolist()
    if any(values[count:]):
        raise ValueError(f"{path}: {key} must be {count} numbers, got {_short(given)}")
    return [*values, *[0.0] * count][:count]


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:60]}…"
