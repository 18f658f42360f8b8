"""Cameras of OpenUSD files, as ``warpgs export --cameras usd`` and programs for animation write them.

A file of ``warpgs export`` has time samples where frames of the capture were, and says how the scene was turned. Of
others, one camera films at every time code of the stage, the first and the last of which are the times 0 and 1. They
are in the coordinates of files that ``warpgs export`` writes by default, upright, in metres of as many scene units.
"""

import math
import reprlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from warpgs.cameras import Camera, intrinsic_matrix
from warpgs.captures.findings import few_of
from warpgs.command_line.parsing import MAX_SIDE
from warpgs.data.camera_files import is_rotation
from warpgs.data.capture import Capture
from warpgs.files import MAX_NUMBER, require_file
from warpgs.formats.packages import required

from .camera_paths import MAX_FRAMES, evenly_spaced, middle_view
from .orientation import upright, vertical

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
"""Of files."""

ROTATION = "warpgsRotation"
"""Key of the layer's data (matrix3d): the rotation from scene coordinates to those of the file."""

SIZE = "warpgsSize"
"""Key of a camera's data (int2): width and height of its image [px]."""

MAX_BYTES = 1 << 30
"""Maximum size of a file [bytes]."""

MAX_PRIMS = 100_000
"""Maximum number of prims in a file."""

STILL_FRAMES = 120
"""Frames that a camera films that has neither time samples nor a stage with a range of time codes."""

Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])
"""From x right, y up, z backward to x right, y down, z forward."""


def read_usd_cameras(path: Path, capture: Capture, name: str | None) -> list[tuple[float, Camera]]:
    """The cameras of a file with their times in [0, 1], in no order.

    Images of other programs' cameras are as high as those of the capture, and as wide as the apertures say.

    Args:
        path: The file.
        capture: The capture of the run.
        name: Path or name of the prim of the camera; None for the only one, or all of a file of ``warpgs export``.

    Raises:
        ValueError: If the file is missing, damaged, too large or refers to others, if it has no or several such
            cameras, or if one is not a perspective camera with a rotation and positive apertures.
        OSError: If usd-core is not installed.
    """
    Usd, UsdGeom = required(path, "pxr.Usd", "usd-core"), required(path, "pxr.UsdGeom", "usd-core")
    stage = _opened(path)
    given = stage.GetRootLayer().customLayerData.get(ROTATION)
    prims = _cameras_of(path, stage, name, is_one=given is None)
    scene_from_file = _rotation(path, given).T if given is not None else _rotation_of(stage, capture)
    unit = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not 0 < unit <= MAX_NUMBER:
        raise ValueError(f"{path}: metersPerUnit must be positive, got {unit}")
    height, cameras = capture.cameras[middle_view(capture)].height, list[tuple[float, Camera]]()
    for prim in prims:
        codes = _codes(path, stage, prim, at_samples=given is not None)
        if len(cameras) + len(codes) > MAX_FRAMES:
            raise ValueError(f"{path} has more than {MAX_FRAMES:,} frames, which is the maximum")
        for code, time in codes:
            rotation, position = _pose(path, prim, Usd.TimeCode(code))
            pose = scene_from_file @ rotation, unit * scene_from_file @ position
            cameras.append((time, _camera(path, prim, Usd.TimeCode(code), pose, height)))
    return cameras


def _opened(path: Path) -> Any:
    """The stage of a file that refers to no other files."""
    require_file(path, MAX_BYTES)
    Sdf, Tf, Usd = (required(path, f"pxr.{name}", "usd-core") for name in ("Sdf", "Tf", "Usd"))
    try:
        layer = Sdf.Layer.OpenAsAnonymous(str(path))
        if layer is not None and (others := layer.GetCompositionAssetDependencies()):
            raise ValueError(f"{path} refers to other files, such as {others[0]}: write one with usdcat --flatten")
        stage = None if layer is None else Usd.Stage.Open(layer)
    except Tf.ErrorException as error:
        raise ValueError(f"{path} is not a file of OpenUSD, or damaged") from error
    if stage is None:
        raise ValueError(f"{path} is not a file of OpenUSD, or damaged")
    return stage


def _cameras_of(path: Path, stage: Any, name: str | None, is_one: bool) -> list[Any]:
    """The prims of cameras: the one that is named, the only one, or all."""
    UsdGeom = required(path, "pxr.UsdGeom", "usd-core")
    found = []
    for k, prim in enumerate(stage.Traverse()):
        if k >= MAX_PRIMS:
            raise ValueError(f"{path} has more than {MAX_PRIMS:,} prims, which is the maximum")
        if prim.HasAuthoredMetadata("clips"):
            raise ValueError(f"{path} refers to other files, by the clips of {prim.GetPath()}: flatten it")
        if prim.IsA(UsdGeom.Camera):
            found.append(UsdGeom.Camera(prim))
    paths = [str(camera.GetPath()) for camera in found]
    if name is not None:
        found = [camera for camera in found if name in (str(camera.GetPath()), camera.GetPrim().GetName())]
    if not paths:
        raise ValueError(f"{path} has no cameras: export the camera of the other program, too")
    if not found:
        raise ValueError(f"{path} has no camera {name}: give --view one of its cameras, {few_of(paths)}")
    if len(found) > 1 and (is_one or name is not None):
        raise ValueError(f"{path} has {len(found)} such cameras, choose one by --view: {few_of(paths)}")
    return found


def _rotation(path: Path, given: Any) -> Float64[np.ndarray, "3 3"]:
    rotation = np.array(given, np.float64) if type(given).__name__ == "Matrix3d" else np.zeros((3, 3))
    if not is_rotation(rotation):
        raise ValueError(f"{path}: {ROTATION} must be a rotation")
    return rotation


def _rotation_of(stage: Any, capture: Capture) -> Float64[np.ndarray, "3 3"]:
    """To the coordinates of a scene from those of its upright files with the up axis of a stage."""
    from pxr import UsdGeom  # after ``required``

    y_up = Y_UP_FROM_Z_UP if UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z else np.eye(3)
    return upright(vertical(capture), y_up=True).T @ y_up


def _codes(path: Path, stage: Any, camera: Any, at_samples: bool) -> list[tuple[float, float]]:
    """The time codes of a camera's frames, and their times in [0, 1]."""
    start, end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
    samples = _samples(camera)
    if not stage.HasAuthoredTimeCodeRange() and samples:
        start, end = samples[0], samples[-1]
    if not (math.isfinite(start) and math.isfinite(end) and start <= end and end - start < MAX_FRAMES):
        raise ValueError(f"{path}: expected time codes of at most {MAX_FRAMES:,} frames, got {start:g} to {end:g}")
    if start == end:
        return [(start, time) for time in evenly_spaced(STILL_FRAMES)]
    codes = samples if at_samples and samples else [start + k for k in range(math.floor(end - start) + 1)]
    times = [(code, (code - start) / (end - start)) for code in codes]
    if not all(0 <= time <= 1 for _, time in times):
        raise ValueError(f"{path}: {camera.GetPath()} has time samples outside of the range {start:g} to {end:g}")
    return times


def _samples(camera: Any) -> list[float]:
    """The time codes at which a camera or what it is in changes, in order."""
    from pxr import UsdGeom  # after ``required``

    found, prim = {*camera.GetFocalLengthAttr().GetTimeSamples()}, camera.GetPrim()
    while prim and not prim.IsPseudoRoot():
        if prim.IsA(UsdGeom.Xformable):
            found |= {*UsdGeom.Xformable(prim).GetTimeSamples()}
        prim = prim.GetParent()
    return sorted(found)


def _pose(path: Path, camera: Any, code: Any) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
    """The rotation from a camera (x right, y down, z forward) to the file, without scale, and its position in it."""
    matrix = np.array(camera.ComputeLocalToWorldTransform(code), np.float64)  # of row vectors
    lengths = np.linalg.norm(matrix[:3, :3], axis=1)
    rotation = (matrix[:3, :3] / np.where(lengths > 0, lengths, 1.0)[:, None]).T
    if not (np.abs(matrix) <= MAX_NUMBER).all() or not is_rotation(rotation):
        raise ValueError(f"{path}: the transform of {camera.GetPath()} at {code} is more than turned, scaled and moved")
    return rotation @ OPENCV_FROM_OPENGL, matrix[3, :3]


def _camera(path: Path, camera: Any, code: Any, pose: tuple[np.ndarray, np.ndarray], height: int) -> Camera:
    """The camera of a prim at a time code, with an image of a height [px]."""
    if camera.GetProjectionAttr().Get(code) != "perspective":
        raise ValueError(f"{path}: {camera.GetPath()} must have the projection perspective")
    focal, across, down, right, up = (
        _number(path, getattr(camera, f"Get{name}Attr")(), code)
        for name in (
            *("FocalLength", "HorizontalAperture", "VerticalAperture"),
            *("HorizontalApertureOffset", "VerticalApertureOffset"),
        )
    )
    if not all(0 < value <= MAX_NUMBER for value in (focal, across, down)):
        raise ValueError(f"{path}: {camera.GetPath()} must have a positive focal length and apertures at {code}")
    given = camera.GetPrim().GetCustomDataByKey(SIZE)
    if given is not None and type(given).__name__ != "Vec2i":
        raise ValueError(f"{path}: {SIZE} of {camera.GetPath()} must be two integers")
    width, height = (round(height * min(across / down, MAX_SIDE)), height) if given is None else map(int, given)
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
        raise ValueError(f"{path}: {camera.GetPath()} would have an image of {width:,} × {height:,} pixels")
    if not (abs(right) <= across and abs(up) <= down):
        raise ValueError(f"{path}: {camera.GetPath()} has its axis outside of the image at {code}")
    center = (0.5 - right / across) * width, (0.5 + up / down) * height
    K = intrinsic_matrix((focal / across * width, focal / down * height), center)
    rotation, position = pose
    return Camera.posed(rotation.T, position, K, (width, height), 0.0)


def _number(path: Path, attribute: Any, code: Any) -> float:
    """The value of an attribute at a time code."""
    value = attribute.Get(code)
    if type(value) is not float:
        raise ValueError(f"{path}: {attribute.GetPath()} must be a number at {code}, got {reprlib.repr(value)}")
    return value
