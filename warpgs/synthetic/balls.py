"""The built-in capture ``builtin:balls``: small objects that move far between frames, seen by a camera that jumps.

The layout is that of D-NeRF: 200×200 images with alpha, a camera at a random point of a hemisphere in every frame, no
masks, no depth and no points. Five balls circle over nothing, two diameters from frame to frame; each evaluation frame
is seen from a new point, every second one at a time halfway between two training frames.
"""

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.config import Color
from warpgs.files import write_json, write_png
from warpgs.visualize.images import averaged, to_bytes

from .bodies import Body, as_tensors, euler
from .cache import cached, content_folder
from .raytrace import SPHERE, raytrace

VERSION = 1
"""Increase it when the content changes, so that cached captures are not used any more."""

DISTANCE, TARGET = 4.0, (0.0, 0.0, 0.3)
"""Distance of the cameras from the point that they look at, as in D-NeRF [world units]."""

ANGLE = 0.6911112070083618
"""Horizontal field of view of D-NeRF [rad]."""

RADIUS = 0.1
"""Radius of each ball [world units]."""

COLORS: list[tuple[Color, Color]] = [
    ((0.90, 0.20, 0.15), (0.95, 0.45, 0.20)),
    ((0.15, 0.35, 0.90), (0.20, 0.60, 0.90)),
    ((0.15, 0.65, 0.25), (0.40, 0.80, 0.30)),
    ((0.60, 0.20, 0.75), (0.80, 0.35, 0.80)),
    ((0.85, 0.65, 0.10), (0.70, 0.50, 0.15)),
]
"""The two colours of each ball's checkerboard."""

SUPERSAMPLING = 4
"""Samples per pixel along each axis."""


@dataclass(frozen=True)
class BallsSize:
    """Size of the capture.

    Attributes:
        side: Width and height of the images [px].
        num_frames: Number of training frames, one per time.
        num_val: Number of evaluation frames.
        turns: Mean number of turns of the balls over the capture; they make one fewer to one more.
    """

    side: int = 200
    num_frames: int = 100
    num_val: int = 20
    turns: float = 8.0


def _balls(time: float, size: BallsSize) -> list[Body]:
    bodies = []
    for k, colors in enumerate(COLORS):
        angle = 2.0 * math.pi * ((size.turns + 0.5 * (k - 2)) * (-1) ** k * time + 0.23 * k)
        reach = 0.9 - 0.1 * k
        height = 0.15 + 0.13 * k + 0.2 * math.sin(0.5 * angle + k)
        center = (reach * math.cos(angle), reach * math.sin(angle), height)
        bodies.append(Body(SPHERE, center, (RADIUS,) * 3, colors, 4.8, euler(), shine=0.1))
    return bodies


def trace(time: float, position: Float[np.ndarray, "3"], size: BallsSize) -> tuple[Camera, UInt8[np.ndarray, "H W 4"]]:
    """Camera and RGBA image of a frame; colours are not multiplied by alpha.

    The time is in [0, 1], the position in world units.
    """
    cpu, side = torch.device("cpu"), size.side * SUPERSAMPLING
    focal = 0.5 * side / math.tan(0.5 * ANGLE)
    target, up = torch.tensor(TARGET, dtype=torch.float32), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32)
    camera = Camera.looking_at(torch.from_numpy(position).float(), target, up, focal, (side, side), time)
    lamp = torch.tensor([[1.5, -1.0, 6.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0]], dtype=torch.float32)
    center = torch.full((1, 4), 0.5, dtype=torch.float32)
    traced = raytrace(as_tensors(_balls(time, size), cpu), lamp, center, camera.viewmat, camera.K, camera.size)
    hit = (traced.bodies >= 0).float()[..., None]
    alpha, color = averaged(hit, SUPERSAMPLING), averaged(traced.image.clamp(0, 1) * hit, SUPERSAMPLING)
    return camera, to_bytes(torch.cat([color / alpha.clamp_min(1e-6), alpha], 2))


def _frame(folder: Path, name: str, time: float, random: np.random.Generator, size: BallsSize) -> dict[str, Any]:
    """Writes the image of a frame from a random point of the upper hemisphere; its entry in transforms.json."""
    height = random.uniform(0.15, 0.9)
    angle = random.uniform(0.0, 2.0 * math.pi)
    flat = math.sqrt(1.0 - height**2)
    direction = np.array([flat * math.cos(angle), flat * math.sin(angle), height])
    camera, rgba = trace(time, np.array(TARGET) + DISTANCE * direction, size)
    write_png(folder / f"{name}.png", rgba)
    pose = np.linalg.inv(camera.viewmat.double().numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
    return {"file_path": f"./{name}", "time": time, "transform_matrix": pose.round(9).tolist()}


def write_balls(folder: Path, size: BallsSize, quiet: bool = False) -> None:
    """Writes the capture to an empty folder.

    Raises:
        ValueError: If there are fewer than two frames.
        OSError: If a file cannot be written; the message names it.
    """
    if size.num_frames < 2:
        raise ValueError(f"the balls need at least 2 frames, got {size.num_frames}")
    last, random = size.num_frames - 1, np.random.default_rng(0)
    times = {"train": [k / last for k in range(size.num_frames)]}
    steps = [math.floor((k + 0.5) * last / size.num_val) + 0.5 * (k % 2) for k in range(size.num_val)]
    times["test"] = [min(1.0, step / last) for step in steps]
    for split, of_split in times.items():
        shown = progress(list(enumerate(of_split)), f"creating builtin:balls, {split}", quiet)
        entries = [_frame(folder, f"{split}/r_{k:03d}", time, random, size) for k, time in shown]
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": entries})


def balls_capture(cache_dir: Path | None = None, size: BallsSize | None = None, quiet: bool = False) -> Path:
    """The folder of the capture, which is created on the first call; see ``builtin_capture`` of room.py."""
    size = size or BallsSize()
    folder = content_folder(cache_dir, ["balls", VERSION, asdict(size)]) / "balls"
    return cached(folder, lambda partial: write_balls(partial, size, quiet), quiet)
