"""Matrices of cameras as files give them: intrinsics K, and poses whose rotations have one scale."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from warpgs.data.camera_files import is_rotation
from warpgs.files import read_numbers

NAMES = ("K", "intrinsic_matrix", "intrinsics", "intrinsic")
"""Fields that hold a matrix K."""

FOCAL = ("fl_x", "camera_angle_x")
"""Fields that are preferred to such a matrix."""

MAX_DIFFERENCE = 1e-3
"""Maximum relative difference between numbers that should be the same."""

MAX_FRACTION = 4.0
"""Numbers of a K in pixels are larger; in fractions of the image they are not."""


def with_intrinsics(path: Path, fields: dict[str, Any], has_others: bool) -> dict[str, Any]:
    """Fields of an object with ``fl_x``, ``fl_y``, ``cx`` and ``cy`` of its matrix K, if it has no focal length.

    K is [[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]], also as nine numbers, or in a 3×4 or 4×4 matrix.

    Args:
        path: The file, for messages.
        fields: The object.
        has_others: Whether the file has a focal length for all frames, so that another kind of K is ignored.

    Raises:
        ValueError: If K is something else.
    """
    name = next((name for name in NAMES if isinstance(fields.get(name), list)), None)
    if name is None or any(key in fields for key in FOCAL):
        return fields
    try:
        K = _checked(path, name, _square(path, fields, name))
    except ValueError:
        if has_others:
            return fields
        raise
    return {**fields, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}


def contradictions(
    name: str, fields: dict[str, Any], given: Sequence[dict[str, Any]], read: Sequence[dict[str, Any]]
) -> tuple[str, ...]:
    """A note on matrices of frames that are preferred to another focal length of the whole file, if there are any.

    Args:
        name: Name of the file.
        fields: Its content.
        given: Its frames.
        read: The same ``with_intrinsics``.
    """
    focal = fields.get("fl_x")
    if isinstance(focal, int | float):
        for before, after in zip(given, read, strict=True):
            if before is not after and abs(after["fl_x"] - focal) > 0.01 * focal:
                return (
                    f"{name} has fl_x {focal}, but a frame {after['fl_x']:.6g} in its matrix: the matrices are used",
                )
    return ()


def _checked(path: Path, name: str, K: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    expected = f"{path}: {name} must be [[fl_x, 0, cx], [0, fl_y, cy], [0, 0, 1]] in pixels, got {K.tolist()}"
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.allclose(K[2], [0, 0, 1]) and abs(K[1, 0]) <= MAX_DIFFERENCE):
        raise ValueError(expected)
    if abs(K[0, 1]) > MAX_DIFFERENCE * K[0, 0]:
        raise ValueError(f"{path}: cameras must have no skew, got {K[0, 1]} in {name}; undistort the images first")
    if np.abs(K).max() <= MAX_FRACTION:
        raise ValueError(f"{expected}: multiply its first row by the width of the image, its second by the height")
    return K


def _square(path: Path, fields: dict[str, Any], name: str) -> Float[np.ndarray, "3 3"]:
    rows = fields[name]
    columns = len(rows[0]) if rows and isinstance(rows[0], list) else 0
    if (len(rows), columns) in ((4, 4), (3, 4)):
        return read_numbers(path, fields, name, (len(rows), columns))[:3, :3]
    shape = (9,) if columns == 0 and len(rows) == 9 else (3, 3)
    return read_numbers(path, fields, name, shape).reshape(3, 3)


def scale_of_rotations(poses: Iterable[Float[np.ndarray, "3 C"]]) -> float:
    """The factor that the rotations in the first three columns of all poses are multiplied by.

    It is 1 if they are rotations, have no common factor, or are something else.
    """
    rotations = np.array([pose[:, :3] for pose in poses]).reshape(-1, 3, 3)
    with np.errstate(all="ignore"):
        scales = np.cbrt(np.linalg.det(rotations))
    if not np.isfinite(scales).all() or not len(scales) or scales.min() <= 0 or all(map(is_rotation, rotations)):
        return 1.0
    scale = float(np.median(scales))
    same = scales.max() - scales.min() <= 2 * MAX_DIFFERENCE * scale
    return scale if same and all(is_rotation(rotation / scale) for rotation in rotations) else 1.0


def without_scale(pose: Float[np.ndarray, "3 4"], scale: float) -> Float[np.ndarray, "3 4"]:
    """A pose with its rotation divided by a scale; positions stay."""
    return pose if scale == 1.0 else pose / np.array([scale, scale, scale, 1.0])


def scale_note(name: str, scale: float) -> tuple[str, ...]:
    """A note on rotations of a file that are scaled; none for a scale of 1."""
    text = f"the rotations in {name} are scaled by {scale:.6g}, divided out; positions and depth keep their units"
    return (text,) if scale != 1.0 else ()
