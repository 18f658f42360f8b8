"""Writes small captures of the three datasets."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from warpgs.captures.opening import load_capture
from warpgs.files import write_array, write_png

SIZE = (40, 24)
"""(width, height) of the full-size images [px]."""

CENTER, SCALE = (0.5, -0.25, 1.0), 0.5
"""center and scale of scene.json."""

FACTORS = {"nerfds": 1, "hypernerf": 2, "iphone": 2}


def write_json(path: Path, values: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values))


def edit_json(path: Path, **changes: object) -> None:
    """Changes some entries of a JSON object; None removes an entry, while others that are null stay."""
    values = {**json.loads(path.read_text()), **changes}
    write_json(path, {key: value for key, value in values.items() if value is not None or key not in changes})


def look_away(root: Path) -> None:
    """Turns every camera around its vertical axis, so that it does not see the points."""
    for path in (root / "camera").iterdir():
        rotation = np.array(json.loads(path.read_text())["orientation"])
        edit_json(path, orientation=(np.diag([-1.0, 1.0, -1.0]) @ rotation).tolist())


def exchange_cameras(root: Path) -> None:
    """Gives every frame the camera of a random one."""
    paths = sorted((root / "camera").iterdir())
    cameras = np.random.default_rng(0).permutation([path.read_text() for path in paths])
    for path, text in zip(paths, cameras, strict=True):
        path.write_text(text)


def stop_time(root: Path) -> None:
    """Gives all frames one time."""
    names = json.loads((root / "metadata.json").read_text())
    write_json(root / "metadata.json", {name: {"time_id": 0} for name in names})


def camera_fields(k: int, size: tuple[int, int] = SIZE) -> dict[str, object]:
    """A camera file: rotated, with the principal point off the image centre, not at the scene centre."""
    rotation = cv2.Rodrigues(np.array([0.1 * k, 0.3, -0.05 * k]))[0]
    return {
        "orientation": rotation.tolist(),
        "position": [0.2 * k, 0.1, -2.0],
        "focal_length": 50.0,
        "principal_point": [size[0] / 2 + 1.5, size[1] / 2 - 2.0],
        "skew": 0.0,
        "pixel_aspect_ratio": 1.0,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": list(size),
    }


def image_of(name: str, size: tuple[int, int] = SIZE) -> np.ndarray:
    """[H, W, 3] RGB noise, different for every name."""
    seed = int.from_bytes(name.encode()[-4:], "big")
    return np.random.default_rng(seed).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)


def dynamic_block(size: tuple[int, int] = SIZE) -> np.ndarray:
    """[H, W] mask file: 0 in a dynamic block, else 255."""
    mask = np.full((size[1], size[0]), 255, np.uint8)
    mask[4:9, 3:10] = 0
    return mask


def ids_of(dataset: str) -> tuple[list[str], list[str]]:
    """train_ids and val_ids; two cameras, four times."""
    if dataset == "iphone":
        return [f"0_{k:05d}" for k in range(4)], [f"1_{k:05d}" for k in range(0, 4, 2)]
    return [f"left_{k:06d}" for k in range(4)], [f"right_{k:06d}" for k in range(0, 4, 2)]


def write_capture(root: Path, dataset: str = "nerfds") -> Path:
    """A capture of four training and two evaluation frames with all files that its dataset has."""
    train, val = ids_of(dataset)
    factor = FACTORS[dataset]
    size = (SIZE[0] // factor, SIZE[1] // factor)
    metadata = {}
    for name in [*train, *val]:
        step = int(name.split("_")[1])
        ids = {"warp_id": step, "appearance_id": step, "camera_id": int(name in val)}
        metadata[name] = ids if dataset == "iphone" else {**ids, "time_id": step}
        write_png(root / f"rgb/{factor}x/{name}.png", image_of(name, size))
        write_json(root / f"camera/{name}.json", camera_fields(step + 10 * (name in val)))
        if dataset == "nerfds":
            write_png(root / f"resized_mask/1x/{name}.png.png", dynamic_block())
    if dataset == "iphone":
        for name in train:
            write_array(root / f"depth/2x/{name}.npy", np.full((size[1], size[0], 1), 2.0, np.float32))
        for name in val:
            write_png(root / f"covisible/2x/val/{name}.png", dynamic_block(size))
        for split, ids in (("train", train), ("val", val)):
            write_json(root / f"splits/{split}.json", {"frame_names": ids, "camera_ids": [], "time_ids": []})
    index = {"count": 6, "num_exemplars": 4, "ids": [*train, *val], "train_ids": train, "val_ids": val}
    write_json(root / "dataset.json", index)
    write_json(root / "metadata.json", metadata)
    write_json(root / "scene.json", {"center": CENTER, "scale": SCALE, "near": 0.1, "far": 2.0})
    write_array(root / "points.npy", np.arange(30, dtype=np.float64).reshape(10, 3))
    return root


def refused(root: Path, match: str, dataset: str | None = None, **options: Any) -> None:
    """The capture is refused in one line, on opening or when its frames are read."""
    with pytest.raises(ValueError, match=match) as caught:
        read_all(root, dataset, **options)
    assert "\n" not in str(caught.value)


def read_all(root: Path, dataset: str | None = None, **options: Any) -> None:
    """Opens a capture and reads its frames."""
    capture = load_capture(root, dataset, **options)
    for name in (*capture.train, *capture.val):
        capture.frame(name)
