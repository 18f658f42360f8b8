"""The built-in capture: a small room with a tumbling ring, a ball that is squashed, and their moving shadows.

It is ray-traced and written in the layout of NeRF-DS, so that it is loaded like a real capture.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int32
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data import writer
from warpgs.data.lens import Lens
from warpgs.data.units import SceneUnits
from warpgs.visualize.images import to_bytes

from .bodies import Body, as_tensors, euler, even_samples
from .cache import cached, content_folder
from .raytrace import CUBE, SPHERE, TORUS, raytrace

CENTER, SCALE = (0.0, 0.0, 0.35), 0.4
"""Scene units are (p − CENTER) · SCALE."""

POINT_NOISE = 0.004
"""Standard deviation of the noise on the sparse points [world units]."""

BASELINE = 0.16
"""Distance of the evaluation camera, to the right of the training camera [world units]."""

VERSION = 4
"""Increase it when the content changes, so that cached captures are not used any more."""


@dataclass(frozen=True)
class BuiltinScene:
    """Size of the built-in capture.

    Attributes:
        width, height: Size of the images [px].
        num_frames: Number of times; each has a training frame, every second one also an evaluation frame.
        num_samples: Samples per pixel.
        num_points: Number of sparse points.
    """

    width: int = 240
    height: int = 136
    num_frames: int = 60
    num_samples: int = 16
    num_points: int = 4000


def _static_bodies() -> list[Body]:
    upright, blue, green = euler(), ((0.25, 0.42, 0.72), (0.85, 0.86, 0.80)), ((0.30, 0.60, 0.42), (0.82, 0.84, 0.62))
    return [
        Body(CUBE, (0.0, 0.0, 1.2), (3.1, 3.1, 1.9), ((0.62, 0.66, 0.72), (0.74, 0.71, 0.64)), 8.0, upright),
        Body(CUBE, (0.0, 0.0, -0.06), (1.55, 1.25, 0.06), ((0.80, 0.72, 0.55), (0.72, 0.62, 0.46)), 7.0, upright),
        Body(CUBE, (-0.75, 0.62, 0.30), (0.22, 0.22, 0.30), blue, 4.6, euler(z=0.5)),
        Body(CUBE, (0.95, 0.55, 0.17), (0.19, 0.19, 0.17), green, 4.6, euler(z=-0.3)),
        Body(SPHERE, (0.30, 0.80, 0.22), (0.22, 0.22, 0.22), ((0.72, 0.40, 0.62), (0.80, 0.55, 0.70)), 6.0, upright),
    ]


def _moving_bodies(time: float) -> list[Body]:
    """The ring tumbles once while it swings back and forth; the ball rolls and is squashed."""
    angle = 2.0 * math.pi * time
    ring_center = (0.32 + 0.30 * math.sin(angle), -0.12, 0.62 + 0.06 * math.cos(angle))
    squash = 0.22 * math.sin(2.0 * angle)
    radius = 0.24
    half_sizes = (radius * (1 + 0.5 * squash), radius * (1 + 0.5 * squash), radius * (1 - squash))
    ball_center = (-0.52 + 0.26 * math.cos(angle), -0.42 + 0.12 * math.sin(angle), half_sizes[2])
    ring, ball = ((0.86, 0.58, 0.38), (0.70, 0.36, 0.24)), ((0.86, 0.30, 0.24), (0.93, 0.82, 0.50))
    return [
        Body(TORUS, ring_center, (0.25, 0.25, 0.25), ring, 4.0, euler(x=0.9 + angle, z=0.5 * angle)),
        Body(SPHERE, ball_center, half_sizes, ball, 5.0, euler(z=0.7 * math.sin(angle))),
    ]


def _camera(time: float, scene: BuiltinScene, shift: float) -> Camera:
    """The hand-held training camera at a time, moved to its right by ``shift``."""
    angle = -0.5 * math.pi + 0.42 * math.sin(2.0 * math.pi * (0.75 * time - 0.125))
    height = 1.25 + 0.18 * math.sin(2.0 * math.pi * (time + 0.2))
    position = torch.tensor([2.55 * math.cos(angle), 2.55 * math.sin(angle), height], dtype=torch.float32)
    target, up = torch.tensor([0.0, 0.1, 0.28], dtype=torch.float32), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32)
    camera = Camera.looking_at(position, target, up, 0.95 * scene.width, (scene.width, scene.height), time)
    moved = camera.viewmat.clone()
    moved[0, 3] -= shift
    return Camera(moved, camera.K, camera.width, camera.height, time)


def _lamp(device: torch.device) -> Tensor:
    return torch.tensor([[0.9, -1.1, 2.7], [0.22, 0.0, 0.0], [0.0, 0.22, 0.0]], dtype=torch.float32, device=device)


def trace(
    time: float, shift: float, scene: BuiltinScene, device: torch.device
) -> tuple[Camera, Float[Tensor, "H W 3"], Float[Tensor, "H W"], Int32[Tensor, "H W"]]:
    """Camera, image, depth and body index of a frame in world units, on the CPU.

    The time is in [0, 1], and the camera ``shift`` [world units] to the right of the training camera.
    """
    camera = _camera(time, scene, shift)
    bodies = as_tensors([*_static_bodies(), *_moving_bodies(time)], device)
    lamp, samples, traced_from = _lamp(device), even_samples(scene.num_samples, device), camera.to(device)
    image, depth, hits = raytrace(bodies, lamp, samples, traced_from.viewmat, traced_from.K, camera.size)
    return camera, image.cpu(), depth.cpu(), hits.cpu()


def stereo_frames(num_steps: int, baseline: float) -> list[tuple[str, int, float]]:
    """Name, time step, and shift to the right of every frame of a camera that trains, and one beside it that evaluates.

    The second one is at a distance of ``baseline`` [world units], and records every second step.

    Raises:
        ValueError: If there are fewer than two time steps.
    """
    if num_steps < 2:
        raise ValueError(f"a built-in capture needs at least 2 frames, got {num_steps}")
    right = [(f"right_{k:06d}", k, baseline) for k in range(0, num_steps, 2)]
    return [*((f"left_{k:06d}", k, 0.0) for k in range(num_steps)), *right]


def write_stereo_index(folder: Path, frames: Sequence[tuple[str, int, float]]) -> None:
    """Writes the time and camera of every frame, and which of them evaluate; raises as ``writer.write_index``."""
    cameras = {name: int(shift > 0) for name, _, shift in frames}
    steps = {name: step for name, step, _ in frames}
    writer.write_index(folder, steps, [name for name, camera in cameras.items() if camera], cameras)


def write_builtin_capture(folder: Path, scene: BuiltinScene, device: torch.device, quiet: bool = False) -> None:
    """Writes the capture to an empty folder.

    Raises:
        ValueError: If there are fewer than two frames.
        OSError: If a file cannot be written; the message names it.
    """
    num_static, frames, points = len(_static_bodies()), stereo_frames(scene.num_frames, BASELINE), []
    for name, k, shift in progress(frames, "creating the built-in scene", quiet):
        camera, image, depth, bodies = trace(k / (scene.num_frames - 1), shift, scene, device)
        static = bodies < num_static
        writer.write_image(folder, name, to_bytes(image))
        writer.write_mask(folder, name, static.numpy())
        lens = Lens.of(camera)
        writer.write_camera(folder, name, lens, camera.viewmat[:3, :3].numpy(), camera.position.numpy())
        if not shift:
            writer.write_depth(folder, name, _monocular(depth, k / scene.num_frames))
            points.append(_surface_points(depth, static, camera, k, scene))
    units = SceneUnits(np.array(CENTER), SCALE)
    writer.write_scene(folder, units, torch.cat(points)[: scene.num_points].numpy(), near=0.05, far=4.0)
    write_stereo_index(folder, frames)


def _monocular(depth: Tensor, phase: float) -> np.ndarray:
    """Inverse depth as a network predicts it: 16 bits, with a scale and an offset that drift from frame to frame."""
    inverse = 1.0 / depth
    low, high = inverse.min(), inverse.max()
    value = (inverse - low) / (high - low)
    value = (0.72 + 0.10 * math.sin(9.0 * phase)) * value + 0.12 + 0.05 * math.cos(7.0 * phase)
    return (value * 65535.0).round().numpy().astype(np.uint16)


def _surface_points(depth: Tensor, static: Tensor, camera: Camera, k: int, scene: BuiltinScene) -> Tensor:
    """The sparse points of frame ``k``: random static pixels, unprojected with some noise."""
    generator = torch.Generator().manual_seed(k)
    num_points = -(-scene.num_points // scene.num_frames)
    rows, columns = static.nonzero(as_tuple=True)
    chosen = torch.randperm(len(rows), generator=generator)[:num_points]
    row, column = rows[chosen], columns[chosen]
    points = camera.unproject(row, column, depth[row, column])
    return points + POINT_NOISE * torch.randn(points.shape, dtype=torch.float32, generator=generator)


def builtin_capture(
    cache_dir: Path | None = None,
    scene: BuiltinScene | None = None,
    device: torch.device | None = None,
    quiet: bool = False,
) -> Path:
    """The folder of the built-in capture, which is created on the first call.

    Args:
        cache_dir: Folder to keep it in; $XDG_CACHE_HOME/warpgs or ~/.cache/warpgs if None, or a temporary folder if
            that cannot be written.
        scene: Size of the capture; the default size if None.
        device: Device to trace on; the CPU if None.
        quiet: Whether to hide the line that it is made, and the progress bar, which needs a terminal.

    Raises:
        ValueError: If there are fewer than two frames.
        OSError: If it cannot be written; the message names the file or folder.
    """
    scene = scene or BuiltinScene()
    folder = content_folder(cache_dir, [VERSION, asdict(scene)]) / "builtin"
    device = device or torch.device("cpu")
    return cached(folder, lambda partial: write_builtin_capture(partial, scene, device, quiet), quiet)
