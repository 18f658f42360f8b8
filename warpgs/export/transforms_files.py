"""Cameras as transforms.json: of nerfstudio, and of D-NeRF and other datasets rendered by Blender.

Poses are camera-to-world with OpenGL axes (x right, y up, z backward), in scene units; intrinsics are pixels from the
corner of the image.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.cameras import Camera
from warpgs.data.lens import Lens
from warpgs.files import write_json
from warpgs.formats.ply import write_ply

from .camera_set import CameraSet, held_lens

MODELS = {"radial": "OPENCV", "fisheye": "OPENCV_FISHEYE", "equirectangular": "EQUIRECTANGULAR"}
"""nerfstudio's ``camera_model`` of a lens."""


def write_nerfstudio(folder: Path, cameras: CameraSet) -> None:
    """transforms.json, and points.ply if there are points."""
    frames, fields = [], _transforms(cameras)
    models = {held_lens(name, camera, 5).model for name, camera in cameras.cameras.items()}
    if len(models) > 1:
        raise ValueError(
            f"transforms.json holds one kind of lens, these cameras have {len(models)}: {', '.join(models)}"
        )
    for name, camera in cameras.cameras.items():
        lens = Lens.of(camera)
        unit = math.pi if lens.model == "equirectangular" else 1.0  # nerfstudio's are pixels per 180 degrees
        names = ("k1", "k2", "k3", "k4") if lens.model == "fisheye" else ("k1", "k2", "p1", "p2", "k3")
        frames.append(
            {
                **_frame(f"images/{name}.png", camera),
                **{
                    "fl_x": unit * lens.focal[0],
                    "fl_y": unit * lens.focal[1],
                    "cx": lens.center[0],
                    "cy": lens.center[1],
                },
                **{"w": lens.width, "h": lens.height, **dict(zip(names, lens.coefficients, strict=False))},
            }
        )
    train = set(cameras.train)
    files = {is_train: [f"images/{n}.png" for n in cameras.cameras if (n in train) == is_train] for is_train in (1, 0)}
    splits = {"train_filenames": files[1], "val_filenames": files[0], "test_filenames": files[0]}
    model = MODELS[models.pop()]
    points = {"ply_file_path": "points.ply"} if len(cameras.points) else {}
    write_json(folder / "transforms.json", {"camera_model": model, **fields, **points, **splits, "frames": frames})
    if len(cameras.points):
        _write_points(folder / "points.ply", cameras)


def write_blender(folder: Path, cameras: CameraSet) -> None:
    """transforms_train.json and transforms_val.json as of D-NeRF, whose principal points are in the middle."""
    train = set(cameras.train)
    for split, is_train in (("train", True), ("val", False)):
        chosen = {name: camera for name, camera in cameras.cameras.items() if (name in train) == is_train}
        if not chosen:
            continue
        first = next(iter(chosen.values()))
        angle = 2.0 * np.arctan2(0.5 * first.width, float(first.K[0, 0]))
        frames = [_frame(f"./{split}/{name}", camera) for name, camera in chosen.items()]
        size = {"w": first.width, "h": first.height}
        fields = {"camera_angle_x": float(angle), **size, **_transforms(cameras), "frames": frames}
        write_json(folder / f"transforms_{split}.json", fields)


def _transforms(cameras: CameraSet) -> dict[str, Any]:
    """Fields of all transforms.json files: how scene coordinates became those of the file, as nerfstudio says it."""
    return {"applied_transform": np.hstack([cameras.rotation, np.zeros((3, 1))]).tolist()}


def _frame(file: str, camera: Camera) -> dict[str, Any]:
    """Fields of a frame of a transforms.json file: camera to world with OpenGL axes, time, and id of the camera."""
    matrix = np.linalg.inv(camera.viewmat.double().numpy()) * np.array([1.0, -1.0, -1.0, 1.0])
    return {"file_path": file, "transform_matrix": matrix.tolist(), "time": camera.time, "camera_id": camera.id}


def _write_points(path: Path, cameras: CameraSet) -> None:
    columns = [(axis, "<f4") for axis in "xyz"]
    if cameras.colors is not None:
        columns += [(channel, "|u1") for channel in ("red", "green", "blue")]
    table = np.zeros(len(cameras.points), columns)
    for k, (name, _) in enumerate(columns):
        table[name] = cameras.points[:, k] if k < 3 or cameras.colors is None else cameras.colors[:, k - 3]
    write_ply(path, {"vertex": table})
