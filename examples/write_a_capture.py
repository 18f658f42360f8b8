"""Writes a small capture in the format of docs/capture-format.md, without warpgs.

A textured wall at z = 5, a step at z = 3.5 in front of it and a moving red square, seen by a camera that moves to the
right:

python examples/write_a_capture.py --out example && warpgs check example
"""

import argparse
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

COUNT, WIDTH, HEIGHT, FOCAL = 12, 96, 64, 80.0


def write(path: Path, content: Any) -> None:
    """Writes JSON, an array or an image, by the suffix of the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".json":
        path.write_text(json.dumps(content), encoding="utf-8")
    elif path.suffix == ".npy":
        np.save(path, content)
    else:
        cv2.imwrite(str(path), content)


def write_frame(root: Path, name: str, k: int, wall: np.ndarray) -> None:
    """Writes image, mask, depth and camera of frame k; the camera is at (x, 0, 0) and looks along z."""
    x = -1.0 + 2.0 * k / (COUNT - 1)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    z = np.where(row > 44, 3.5, 5.0)
    wall_x, wall_y = x + (column - WIDTH / 2) * z / FOCAL, (row - HEIGHT / 2) * z / FOCAL
    position = np.float32(256 + 40 * wall_x), np.float32(128 + 40 * wall_y)
    image = cv2.remap(wall, *position, cv2.INTER_LINEAR)
    moving = np.zeros((HEIGHT, WIDTH), bool)
    moving[20 + k : 36 + k, 30:46] = True
    image[moving] = (40, 40, 220)  # OpenCV's order is blue, green, red
    write(root / f"rgb/1x/{name}.png", image)
    write(root / f"resized_mask/1x/{name}.png.png", np.where(moving, 0, 255).astype(np.uint8))
    write(root / f"depth/1x/{name}.npy", (1.0 / np.where(moving, 3.0, z)).astype(np.float32))
    camera = {
        "orientation": np.eye(3).tolist(),
        "position": [x, 0.0, 0.0],
        "focal_length": FOCAL,
        "principal_point": [WIDTH / 2, HEIGHT / 2],
        "image_size": [WIDTH, HEIGHT],
    }
    write(root / f"camera/{name}.json", camera)


def main() -> None:
    """Writes the frames, points on wall and step, and the files that list them."""
    parser = argparse.ArgumentParser(description="Write a small capture.")
    parser.add_argument("--out", type=Path, default=Path("example"), help="folder to write (default: example)")
    root = parser.parse_args().out
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(40, 215, (32, 64, 3), dtype=np.uint8), (512, 256))  # 40 px per world unit
    ids = [f"frame_{k:03d}" for k in range(COUNT)]
    for k, name in enumerate(ids):
        write_frame(root, name, k, wall)
    on_wall = np.column_stack([rng.uniform(-3, 3, 500), rng.uniform(-2, 0.7, 500), np.full(500, 5.0)])
    on_step = np.column_stack([rng.uniform(-2, 2, 200), rng.uniform(0.55, 1.4, 200), np.full(200, 3.5)])
    write(root / "points.npy", np.vstack([on_wall, on_step]))
    write(root / "scene.json", {"center": [0.0, 0.0, 2.5], "scale": 0.3})
    write(root / "metadata.json", {name: {"time_id": k} for k, name in enumerate(ids)})
    splits = {"ids": ids, "train_ids": ids[:5] + ids[6:], "val_ids": [ids[5]], "layout": "nerfds"}
    write(root / "dataset.json", splits)


if __name__ == "__main__":
    main()
