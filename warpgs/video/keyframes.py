"""Camera paths from a JSON file of keyframes.

    {"up": [0, -1, 0], "keyframes": [
        {"view": "000012", "time": 0.0, "at": 0},
        {"position": [0.1, 0, -1], "target": [0, 0, 0], "time": 0.5, "focal": 600, "at": 2.5},
        {"view": "000040", "time": 1.0, "at": 4}]}

Every keyframe has a ``time`` of the scene in [0, 1] and a camera: a ``view`` of the capture, or a ``position`` with a
``target`` [scene units], or a ``viewmat`` with ``K``, ``width`` and ``height``, as the viewer saves it. All images have
the size of the first keyframe, which is the capture's unless given. ``focal`` [px at that size] replaces the focal
length. ``at`` is the position of a keyframe on the path, in any increasing unit; if no keyframe has it, they are evenly
spaced. ``up`` defaults to the upward direction of the capture.
"""

import dataclasses
import itertools
import re
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.camera_files import is_rotation
from warpgs.data.capture import Capture, missing_view
from warpgs.files import read_json, write_json

from . import camera_paths

POSES = ("view", "position", "viewmat")
KEYS = {*POSES, "target", "K", "width", "height", "time", "focal", "at"}
MAX_BYTES = 1 << 20
"""Maximum size of a file of keyframes."""

MAX_SIDE = 32768
"""Maximum width and height [px]."""

MAX_VALUE = 1e9
"""Maximum absolute value of every number."""

MIN_FOCAL = 1e-3
"""Minimum focal length [px]."""

FOLDER = "paths"
"""Subfolder of a run folder for the paths that the viewer saves."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _-]{0,63}")
"""Valid names of paths; a name comes from a browser and must not lead out of the folder."""


def path_of(run: Path, name: str, replaces: bool = False) -> Path:
    """A file in a run folder for a path.

    Args:
        run: Run folder.
        name: Name of the path.
        replaces: Whether it replaces a file of that name; otherwise it is numbered if the name is taken.

    Raises:
        ValueError: If the name has other characters than letters, digits, spaces, - and _, or too many.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"the name of a path must have 1 to 64 letters, digits, spaces, - and _, got {name!r}")
    path = run / FOLDER / f"{name}.json"
    numbered = (path.with_name(f"{name}-{k}.json") for k in range(2, 10_000))
    return path if replaces else next(p for p in (path, *numbered) if not p.exists())


def write_path(path: Path, cameras: Sequence[Camera]) -> None:
    """Writes cameras as keyframes, in their order.

    Raises:
        ValueError: If there is no camera.
        OSError: If the file cannot be written; the message names it.
    """
    if not cameras:
        raise ValueError("a path needs at least one keyframe")
    keyframes = [
        {
            "time": camera.time,
            "viewmat": camera.viewmat.tolist(),
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
        }
        for camera in cameras
    ]
    write_json(path, {"keyframes": keyframes})


def saved_names(run: Path) -> list[str]:
    """Names of the paths that are saved in a run folder, in the order of their names."""
    return sorted(path.stem for path in (run / FOLDER).glob("*.json") if NAME.fullmatch(path.stem))


def read_path(path: Path, capture: Capture, frames: int) -> list[Camera]:
    """Reads the keyframes of a file and interpolates ``frames`` cameras.

    Raises:
        ValueError: If the file is missing, damaged or not a valid path; the message names it.
    """
    cameras, knots = read_keyframes(path, capture)
    return along(cameras, knots, frames)


def along(cameras: Sequence[Camera], knots: Sequence[float], frames: int) -> list[Camera]:
    """``frames`` cameras along a path, at equal distances between the first and the last knot."""
    at = [knots[0] + (knots[-1] - knots[0]) * fraction for fraction in camera_paths.evenly_spaced(frames)]
    return camera_paths.interpolated(cameras, knots, at, smooth=True)


def read_keyframes(path: Path, capture: Capture) -> tuple[list[Camera], list[float]]:
    """The cameras of a file's keyframes, and the position of each on the path; raises as ``read_path``."""
    values = read_json(path, max_bytes=MAX_BYTES)
    if unknown := sorted(set(values) - {"up", "keyframes"}):
        raise ValueError(f"{path} has an unknown field {unknown[0][:60]!r}, expected up and keyframes")
    keyframes = values.get("keyframes")
    if not isinstance(keyframes, list) or not keyframes:
        raise ValueError(f"{path} has no list of keyframes")
    up = _vector(f"{path}: up", values["up"]) if "up" in values else camera_paths.upward(capture)
    cameras: list[Camera] = []
    for k, value in enumerate(keyframes):
        size = cameras[0].size if cameras else None
        cameras.append(_keyframe(f"{path}: keyframe {k}", value, capture, up, size))
    return cameras, _knots(path, keyframes)


def _keyframe(name: str, value: Any, capture: Capture, up: Tensor, size: tuple[int, int] | None) -> Camera:
    """The camera of a keyframe, with the image size of the first one."""
    if not isinstance(value, dict):
        raise ValueError(f"{name} must be a JSON object, got {type(value).__name__}")
    if unknown := sorted(set(value) - KEYS):
        raise ValueError(f"{name} has an unknown field {unknown[0][:60]!r}, expected some of {', '.join(sorted(KEYS))}")
    if sum(pose in value for pose in POSES) != 1 or ("target" in value) != ("position" in value):
        raise ValueError(f"{name} must have either a view, or a position and a target, or a viewmat")
    camera = _posed(name, value, capture, up)
    camera = camera if size is None else _with_size(camera, size)
    if "focal" in value:
        focal = _focal(f"{name}: focal", value["focal"])
        K = camera.K.clone()
        K[1, 1] *= focal / float(K[0, 0])
        K[0, 0] = focal
        camera = dataclasses.replace(camera, K=K)
    time = _number(f"{name}: time", value.get("time"))
    if not 0 <= time <= 1:
        raise ValueError(f"{name}: time must be in [0, 1], got {time}")
    return dataclasses.replace(camera, time=time)


def _posed(name: str, value: dict[str, Any], capture: Capture, up: Tensor) -> Camera:
    """The camera of a keyframe with its own image size, at time 0."""
    first = capture.cameras[capture.train[0]]
    if "view" in value:
        view = value["view"]
        if not isinstance(view, str) or view not in capture.cameras:
            raise ValueError(f"{name}: {missing_view(capture, view)}")
        return capture.cameras[view].pinhole
    if "viewmat" in value:
        return _from_matrices(name, value, first)
    position, target = (_vector(f"{name}: {end}", value[end]) for end in ("position", "target"))
    forward = target - position
    if float(torch.linalg.cross(forward, up).norm()) <= 1e-4 * float(forward.norm() * up.norm()):
        raise ValueError(f"{name}: position and target coincide, or the view direction is parallel to up")
    turned = Camera.looking_at(position, target, up, 1.0, first.size)
    return Camera(turned.viewmat, first.K, first.width, first.height)


def _from_matrices(name: str, value: dict[str, Any], first: Camera) -> Camera:
    """A camera as the viewer saves it; without intrinsics, those of the capture's first camera."""
    viewmat = _matrix(f"{name}: viewmat", value["viewmat"], 4)
    if not is_rotation(viewmat[:3, :3].numpy()) or viewmat[3].tolist() != [0, 0, 0, 1]:
        raise ValueError(f"{name}: viewmat must be a rotation and a translation from world to camera")
    if not {"K", "width", "height"} & value.keys():
        return Camera(viewmat, first.K, first.width, first.height)
    if not {"K", "width", "height"} <= value.keys():
        raise ValueError(f"{name} must have all of K, width and height, or none")
    K = _matrix(f"{name}: K", value["K"], 3)
    for axis in range(2):
        _focal(f"{name}: K", value["K"][axis][axis])
    if not (K[0, 1] == K[1, 0] == 0 and K[2].tolist() == [0, 0, 1]):
        raise ValueError(f"{name}: K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {K.tolist()}")
    width, height = value["width"], value["height"]
    if any(type(side) is not int or not 0 < side <= MAX_SIDE for side in (width, height)):
        raise ValueError(
            f"{name}: expected a width and a height of 1 to {MAX_SIDE}, got {reprlib.repr((width, height))}"
        )
    return Camera(viewmat, K, width, height)


def _with_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same view in an image of another size, with the same vertical field of view."""
    width, height = size
    zoom = height / camera.height
    K = camera.K.clone()
    K[:2] *= zoom
    K[0, 2] += (width - camera.width * zoom) / 2
    return Camera(camera.viewmat, K, width, height, camera.time)


def _knots(path: Path, keyframes: Sequence[dict[str, Any]]) -> list[float]:
    """The position of each keyframe on the path."""
    given = [value["at"] for value in keyframes if "at" in value]
    if not given:
        return [float(k) for k in range(len(keyframes))]
    if len(given) < len(keyframes):
        raise ValueError(f"{path}: either every keyframe has a field at, or none has")
    knots = [_number(f"{path}: at", value) for value in given]
    if any(b <= a for a, b in itertools.pairwise(knots)):
        raise ValueError(f"{path}: at must increase from keyframe to keyframe, got {reprlib.repr(knots)}")
    return knots


def _number(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= MAX_VALUE:
        raise ValueError(f"{name} must be a number, got {reprlib.repr(value)}")
    return float(value)


def _focal(name: str, value: Any) -> float:
    """A focal length that is also valid in single precision and at every image size."""
    focal = _number(name, value)
    if focal < MIN_FOCAL:
        raise ValueError(f"{name} must have a focal length of at least {MIN_FOCAL} px, got {focal}")
    return focal


def _vector(name: str, value: Any) -> Tensor:
    if not isinstance(value, list) or len(value) != 3:
        raise ValueError(f"{name} must be three numbers, got {reprlib.repr(value)}")
    return torch.tensor([_number(name, v) for v in value], dtype=torch.float32)


def _matrix(name: str, value: Any, size: int) -> Tensor:
    if not isinstance(value, list) or len(value) != size or any(type(r) is not list or len(r) != size for r in value):
        raise ValueError(f"{name} must be {size} rows of {size} numbers")
    return torch.tensor([[_number(name, v) for v in row] for row in value], dtype=torch.float32)
