"""Writes what was recovered as a capture in the layout of NeRF-DS, in scene units around the static points."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from warpgs.data.images import decode
from warpgs.data.lens import Lens, pinhole_matrix, undistort
from warpgs.files import write_array, write_json, write_png

from .frames import SourceFrame
from .sfm import Cameras

KEPT_SHARE = 0.02
"""Share of the points at each end of each axis that does not count for the size of the scene: strays."""

FACTORS = (1, 2)
"""Downscalings that pictures and masks are written in; training takes the second with ``--factor 2``."""

MAX_MOVING = 0.5
"""Share of the frames that see a point where something moves, above which the point is left out."""


def pinhole_lens(lens: Lens) -> Lens:
    """The pinhole whose pictures ``undistort`` makes of the lens's."""
    K = pinhole_matrix(lens)
    return Lens(lens.width, lens.height, (K[0, 0], K[1, 1]), (K[0, 2], K[1, 2]))


def resized_lens(lens: Lens, width: int, height: int) -> Lens:
    """The lens for pictures scaled to another size."""
    x, y = width / lens.width, height / lens.height
    focal, center = (lens.focal[0] * x, lens.focal[1] * y), (lens.center[0] * x, lens.center[1] * y)
    return dataclasses.replace(lens, width=width, height=height, focal=focal, center=center)


def static_points(cameras: Cameras, moving: Sequence[Bool[np.ndarray, "H W"]]) -> Bool[np.ndarray, " P"]:
    """Which points most frames see where nothing moves.

    Args:
        cameras: With lens, poses and points.
        moving: [H, W] of every pose, in the size of the lens.
    """
    lens, points = cameras.lens, cameras.points
    hits, looks = np.zeros(len(points)), np.zeros(len(points))
    for pose, mask in zip(cameras.poses, moving, strict=True):
        seen = points @ pose[:, :3].T + pose[:, 3]
        front = seen[:, 2] > 0
        depth = np.where(front, seen[:, 2], 1.0)
        column, row = np.floor(lens.image(seen[:, 0] / depth, seen[:, 1] / depth)).clip(-1, 1e6).astype(int)
        inside = front & (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
        looks += inside
        hits[inside] += mask[row[inside], column[inside]]
    return hits <= MAX_MOVING * np.maximum(looks, 1)


def scene_units(points: Float[np.ndarray, "P 3"], centers: Float[np.ndarray, "F 3"]) -> tuple[np.ndarray, float]:
    """Center and scale that bring static points and cameras to about [-1, 1].

    Args:
        points: [P, 3] static points.
        centers: [F, 3] of the cameras.
    """
    low, high = np.quantile(points, [KEPT_SHARE, 1 - KEPT_SHARE], axis=0)
    low, high = np.minimum(low, centers.min(0)), np.maximum(high, centers.max(0))
    return (low + high) / 2.0, float(2.0 / (high - low).max())


def write_frames(root: Path, frames_folder: Path, cameras: Cameras, moving: Sequence[Bool[np.ndarray, "H W"]]) -> None:
    """Writes pictures, straightened, and masks in full and in half size, and the camera of every frame.

    Args:
        root: The capture.
        frames_folder: Of the frames as the lens took them.
        cameras: Of the frames.
        moving: [H, W] true where each straightened frame moves.

    Raises:
        ValueError: If a frame was damaged since it was taken.
        OSError: If a file can't be written; the message names it.
    """
    straight = pinhole_lens(cameras.lens)
    for name, pose, mask in zip(cameras.names, cameras.poses, moving, strict=True):
        image = cv2.cvtColor(decode(frames_folder / f"{name}.png"), cv2.COLOR_BGR2RGB)
        image, moving_here = undistort(image, cameras.lens), mask.astype(np.uint8)
        for factor in FACTORS:
            size = round(straight.width / factor), round(straight.height / factor)
            write_png(root / f"rgb/{factor}x/{name}.png", cv2.resize(image, size, interpolation=cv2.INTER_AREA))
            static = cv2.resize(255 * moving_here, size, interpolation=cv2.INTER_AREA) == 0  # no pixel of it moves
            write_png(root / f"resized_mask/{factor}x/{name}.png.png", static.astype(np.uint8) * 255)
        write_json(root / f"camera/{name}.json", _camera_facts(straight, pose))


def _camera_facts(lens: Lens, pose: Float[np.ndarray, "3 4"]) -> dict[str, object]:
    return {
        "orientation": pose[:, :3].tolist(),
        "position": (-pose[:, :3].T @ pose[:, 3]).tolist(),
        "focal_length": lens.focal[0],
        "principal_point": list(lens.center),
        "skew": 0.0,
        "pixel_aspect_ratio": lens.focal[1] / lens.focal[0],
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": [lens.width, lens.height],
    }


def write_facts(root: Path, cameras: Cameras, frames: Sequence[SourceFrame], holdout: int) -> None:
    """Writes points.npy, scene.json, metadata.json, and at last dataset.json, which makes the folder a capture.

    Args:
        root: The capture.
        cameras: With static points only.
        frames: Those of the cameras, in order.
        holdout: Every so many-th frame is for evaluation; 0 for none.

    Raises:
        OSError: If a file can't be written; the message names it.
    """
    centers = -np.einsum("fji,fj->fi", cameras.poses[:, :, :3], cameras.poses[:, :, 3])
    center, scale = scene_units(cameras.points, centers)
    depths = np.concatenate([cameras.points @ p[2, :3] + p[2, 3] for p in cameras.poses[:: max(1, len(centers) // 20)]])
    near, far = np.quantile(depths[depths > 0], [0.001, 0.999]) * scale
    facts = {"center": center.tolist(), "scale": scale, "near": 0.5 * near, "far": 2.0 * far}
    write_json(root / "scene.json", {**facts, "bbox": [[-1, -1, -1], [1, 1, 1]]})
    write_array(root / "points.npy", cameras.points)
    first = frames[0].step
    ids = [{"time_id": f.step - first, "warp_id": k, "appearance_id": k, "camera_id": 0} for k, f in enumerate(frames)]
    names = [f.name for f in frames]
    write_json(root / "metadata.json", dict(zip(names, ids, strict=True)))
    val = names[holdout // 2 :: holdout] if holdout else []
    train = [name for name in names if name not in val]
    counts = {"count": len(names), "num_exemplars": len(train)}
    write_json(root / "dataset.json", {**counts, "ids": names, "train_ids": train, "val_ids": val})
