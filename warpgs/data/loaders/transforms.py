"""Fields of transforms.json files, which nerfstudio, instant-ngp and Blender's datasets share.

``transform_matrix`` is camera-to-world with OpenGL axes (x right, y up, z backward). Intrinsics are pixels from the
corner of the image: ``fl_x``, ``fl_y``, ``cx``, ``cy``, ``w``, ``h``, or a matrix ``K``, or ``camera_angle_x`` (the
horizontal field of view) with the principal point in the middle. Distortion is OpenCV's: ``k1``, ``k2``, ``p1``,
``p2``, ``k3``, or of a fisheye lens ``k1`` to ``k4``. Focal lengths of equirectangular images are nerfstudio's, pixels
per 180 degrees: half the width and the height where they have all directions. Each may be given once or per frame.
"""

import math
import reprlib
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from warpgs.data.exif import EXCHANGES_SIDES, orientation_of
from warpgs.data.images import image_size, orientation_to
from warpgs.data.lens import Lens, unsupported_model
from warpgs.errors import visible
from warpgs.files import read_json, read_numbers

from .listed import MAX_PATH, ListedFiles
from .matrices import (
    FOCAL,
    MAX_DIFFERENCE,
    contradictions,
    scale_note,
    scale_of_rotations,
    with_intrinsics,
    without_scale,
)
from .posed import opencv_from_opengl, world_to_camera
from .turned import unclear_note

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
"""Values of ``camera_model`` of a perspective lens; the others that are read are ``FISHEYE`` and ``PANORAMA``."""

FISHEYE, PANORAMA = "OPENCV_FISHEYE", "EQUIRECTANGULAR"

INSTANT_NGP = {
    "is_fisheye": FISHEYE,
    "equirectangular": "EQUIRECTANGULAR of equal area",  # rows are sines of latitudes
    "latlong": PANORAMA,
    "ftheta_p0": "FTHETA",
    "orthographic": "ORTHOGRAPHIC",
}
"""Fields of instant-ngp instead of ``camera_model``."""

MAX_TIME = 1e19
"""Maximum magnitude of a time: today's nanoseconds since 1970 are 1.8e18."""

SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""Suffixes that ``file_path`` may lack."""

MAX_OFF_CENTER = 0.1
"""Maximum distance of a principal point from the middle, over the side of the image, to tell how that is turned."""

IMAGES = ("file_path", "mask_path")
"""Fields whose files may have been converted to another image format."""


class Transforms:
    """A transforms.json file.

    Args:
        path: The file.

    Attributes:
        path: The file.
        fields: Its content.
        frames: The objects of its frames; there is at least one.

    Raises:
        ValueError: If the file is missing, damaged or without frames, or its camera model is not supported.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        fields = read_json(path)
        has_focal = any(key in fields for key in FOCAL)
        self.fields = with_intrinsics(path, fields, has_focal)
        self._files = ListedFiles(path.parent, path.name)
        self._unclear: list[Path] = []
        frames = self.fields.get("frames")
        if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
            raise ValueError(f"{path}: frames must be a list of at least one object")
        self.frames: list[dict[str, Any]] = [with_intrinsics(path, frame, has_focal) for frame in frames]
        self._matrix_notes = contradictions(path.name, self.fields, frames, self.frames)
        self._scale = scale_of_rotations(self._matrix(frame) for frame in frames)
        for frame in frames:
            model = self._model(frame)
            if model not in (known := (*PERSPECTIVE, FISHEYE, PANORAMA)):
                expected = f"expected one of {', '.join(known)}"
                raise ValueError(f"{path}: {unsupported_model(model, f'{expected}: export undistorted images')}")

    def file(self, frame: dict[str, Any], key: str) -> Path | None:
        """The file that a field of a frame names; None if there is no such field.

        Raises:
            ValueError: If the field is not a name, or there is no such file.
        """
        given = frame.get(key)
        if given is None:
            return None
        if not isinstance(given, str) or not given or "\0" in given or len(given) > MAX_PATH:
            raise ValueError(f"{self.path}: {key} must name a file, got {reprlib.repr(given)}")
        path = self._files.find(given, SUFFIXES, is_image=key in IMAGES)
        if path is None:
            raise ValueError(self._files.missing(given, f"{self.path.name} lists it as {key}"))
        return path

    @property
    def notes(self) -> tuple[str, ...]:
        """What was interpreted in the file so far."""
        unclear = (unclear_note(image) for image in self._unclear[:1])
        return (*self._files.notes, *self._matrix_notes, *scale_note(self.path.name, self._scale), *unclear)

    @property
    def found(self) -> Collection[Path]:
        """The files that were found so far."""
        return self._files.found

    def image(self, frame: dict[str, Any]) -> Path:
        """The image of a frame; raises as ``file``."""
        path = self.file(frame, "file_path")
        if path is None:
            raise ValueError(f"{self.path}: a frame has no file_path")
        return path

    def image_name(self, frame: dict[str, Any]) -> str:
        """The file_path of a frame as the folder spells it, which may differ from the index; raises as ``file``."""
        self.image(frame)
        return self._files.as_stored(frame["file_path"])

    def times(self, frames: Sequence[dict[str, Any]], *fields: str) -> tuple[str, list[int | float]] | None:
        """The first of some fields that all frames have, and the time of each frame in it; None if no frame has any.

        Raises:
            ValueError: If only some frames have one, or a time is not a finite number.
        """
        given = {field: sum(frame.get(field) is not None for frame in frames) for field in fields}
        field = max(fields, key=given.__getitem__)
        if not given[field]:
            return None
        if given[field] < len(frames):
            without = next(self._name(frame) for frame in frames if frame.get(field) is None)
            raise ValueError(
                f"{self.path}: {without} has no {field}, which {given[field]} of {len(frames)} frames have: "
                "give every frame one; without any, names tell the times"
            )
        return field, [self._time(frame, field) for frame in frames]

    def cameras(self, frames: Sequence[dict[str, Any]]) -> list[int] | None:
        """The field ``camera_id`` of each frame; None if no frame has it.

        Raises:
            ValueError: If only some frames have one, or it is not a whole number from 0 on.
        """
        if all(frame.get("camera_id") is None for frame in frames):
            return None
        ids: list[int] = []
        for frame in frames:
            i = frame.get("camera_id")
            if isinstance(i, bool) or not isinstance(i, int) or i < 0:
                raise ValueError(
                    f"{self.path}: camera_id of {self._name(frame)} must be a whole number from 0 on, got "
                    f"{reprlib.repr(i)}"
                )
            ids.append(i)
        return ids

    def _time(self, frame: dict[str, Any], field: str) -> int | float:
        time = frame[field]
        if isinstance(time, bool) or not isinstance(time, int | float) or not -MAX_TIME <= time <= MAX_TIME:
            raise ValueError(
                f"{self.path}: {field} of {self._name(frame)} must be a finite number of at most {MAX_TIME:g} in "
                f"magnitude, got {reprlib.repr(time)}"
            )
        return time

    def _name(self, frame: dict[str, Any]) -> str:
        return visible(str(frame.get("file_path")))[:80]

    def pose(self, frame: dict[str, Any]) -> Float[np.ndarray, "3 4"]:
        """[3, 4] world-to-camera pose of a frame, OpenCV axes.

        Raises:
            ValueError: If transform_matrix is missing or not rigid.
        """
        try:
            return world_to_camera(opencv_from_opengl(without_scale(self._matrix(frame), self._scale)))
        except ValueError as error:
            raise ValueError(f"{self.path}: transform_matrix of {frame.get('file_path')!r:.60}: {error}") from error

    def _matrix(self, frame: dict[str, Any]) -> Float[np.ndarray, "3 4"]:
        given = frame.get("transform_matrix")
        rows = len(given) if isinstance(given, list) else 4
        matrix = read_numbers(self.path, frame, "transform_matrix", (3 if rows == 3 else 4, 4))
        if (np.abs(matrix[3:, :3]) > MAX_DIFFERENCE).any():
            raise ValueError(
                f"{self.path}: transform_matrix of {self._name(frame)} must end with the row 0 0 0 1, got "
                f"{matrix[3].tolist()}; positions belong into its last column"
            )
        return matrix[:3]

    def lens(self, frame: dict[str, Any], image: Path) -> Lens:
        """The lens of a frame's full-size image; its size is that of the image file if it is not given.

        Raises:
            ValueError: If the focal length is missing, or a number is out of range.
        """
        if "w" in self._given(frame) and "h" in self._given(frame):
            width, height = (round(self._number(frame, key)) for key in ("w", "h"))
        else:
            width, height = self._size(frame, image)
        center = self._number(frame, "cx", width / 2), self._number(frame, "cy", height / 2)
        if self._model(frame) == PANORAMA:
            half_turn = self._number(frame, "fl_x", width / 2), self._number(frame, "fl_y", float(height))
            focal = half_turn[0] / math.pi, half_turn[1] / math.pi
            return self._checked(Lens(width, height, focal, center, model="equirectangular"))
        if (focal_x := self._focal(frame, "fl_x", "camera_angle_x", width)) is None:
            raise ValueError(self._without_focal(frame))
        focal = focal_x, self._focal(frame, "fl_y", "camera_angle_y", height) or focal_x
        k1, k2, k3, k4, p1, p2 = (self._number(frame, key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
        if self._model(frame) == FISHEYE:
            return self._checked(Lens(width, height, focal, center, (k1, k2, k3, k4), "fisheye"))
        if k4:
            raise ValueError(f"{self.path}: k4 must be 0, got {k4}; undistort the images first")
        return self._checked(Lens(width, height, focal, center, (k1, k2, p1, p2, k3)))

    def _checked(self, lens: Lens) -> Lens:
        try:
            return lens.checked()
        except ValueError as error:
            raise ValueError(f"{self.path}: {error}") from error

    def _without_focal(self, frame: dict[str, Any]) -> str:
        """Message that a frame has no focal length, and whether other frames have one."""
        found, fields = ", ".join(sorted(map(visible, frame))), "fl_x or camera_angle_x, nor a matrix K"
        count = sum(any(key in other for key in FOCAL) for other in self.frames)
        if not count:
            return f"{self.path} has no {fields}; a frame has {found:.200}"
        others = f"which {count} of {len(self.frames)} frames have: give every frame one"
        return f"{self.path}: {self._name(frame)} has no {fields}, {others}; it has {found:.200}"

    def _size(self, frame: dict[str, Any], image: Path) -> tuple[int, int]:
        """The size of an image where a frame does not give it: upright if only then the principal point is central."""
        stored = image_size(image)
        if not {"cx", "cy"} <= self._given(frame).keys() and orientation_of(image) >= EXCHANGES_SIDES:
            self._unclear.append(image)
        center = np.array(
            [self._number(frame, key, 0.5 * side) for key, side in zip(("cx", "cy"), stored, strict=True)]
        )

        def fits(size: tuple[int, int]) -> bool:
            return bool((np.abs(center / size - 0.5) < MAX_OFF_CENTER).all())

        return stored if orientation_to(image, stored, fits) == 1 else stored[::-1]

    def _focal(self, frame: dict[str, Any], key: str, angle_key: str, side: int) -> float | None:
        given = self._given(frame)
        if key in given:
            return self._number(frame, key)
        if angle_key not in given:
            return None
        angle = self._number(frame, angle_key)
        if not 0 < angle < math.pi:
            raise ValueError(f"{self.path}: {angle_key} must be between 0 and π, got {angle}")
        return 0.5 * side / math.tan(0.5 * angle)

    def _model(self, frame: dict[str, Any]) -> Any:
        given = self._given(frame)
        flags = (model for flag, model in INSTANT_NGP.items() if given.get(flag))
        return next(flags, given.get("camera_model", "OPENCV"))

    def _given(self, frame: dict[str, Any]) -> dict[str, Any]:
        return {**self.fields, **frame}

    def _number(self, frame: dict[str, Any], key: str, default: float | None = None) -> float:
        given = self._given(frame)
        if default is not None:
            given.setdefault(key, default)
        return float(read_numbers(self.path, given, key, ()))
