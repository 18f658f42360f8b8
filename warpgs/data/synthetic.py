"""The built-in capture: a small room with a tumbling ring, a ball that squashes, and their moving shadows.

Ray-traced, and written in the layout of NeRF-DS, so that it takes the same way in as a real capture.
"""

import hashlib
import json
import math
import os
import shutil
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.files import write_array, write_json, write_png
from warpgs.ops.raytrace import CUBE, SPHERE, TORUS, Bodies, TracedImage, raytrace
from warpgs.progress import progress

CENTER, SCALE = (0.0, 0.0, 0.35), 0.4
"""Scene units are (p − CENTER) · SCALE."""

POINT_NOISE = 0.004
"""Standard deviation of the sparse points around their surfaces [world units]."""

BASELINE = 0.16
"""Distance of the evaluation camera, to the right of the training camera [world units]."""

VERSION = 3
"""To be raised when the pictures change, so that cached ones are made anew."""


@dataclass(frozen=True)
class BuiltinScene:
    """Size of the built-in capture.

    Attributes:
        width, height: Of the pictures [px].
        num_frames: Moments; each has a training frame, every other one an evaluation frame.
        num_samples: Samples a pixel.
        num_points: Sparse points.
    """

    width: int = 240
    height: int = 136
    num_frames: int = 60
    num_samples: int = 16
    num_points: int = 4000


@dataclass(frozen=True)
class _Body:
    """A unit shape, turned, scaled, then shifted into the world."""

    kind: int
    center: tuple[float, float, float]
    half_sizes: tuple[float, float, float]
    colors: tuple[tuple[float, float, float], tuple[float, float, float]]
    frequency: float
    turn: Tensor
    moves: bool = False


def _turn(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Tensor:
    """Rotation about x, then y, then z [rad]."""
    matrices = []
    for axis, angle in enumerate((x, y, z)):
        c, s = math.cos(angle), math.sin(angle)
        m = torch.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        m[i, i], m[i, j], m[j, i], m[j, j] = c, -s, s, c
        matrices.append(m)
    return matrices[2] @ matrices[1] @ matrices[0]


def _static_bodies() -> list[_Body]:
    straight = _turn()
    return [
        _Body(CUBE, (0.0, 0.0, 1.2), (3.1, 3.1, 1.9), ((0.62, 0.66, 0.72), (0.74, 0.71, 0.64)), 8.0, straight),
        _Body(CUBE, (0.0, 0.0, -0.06), (1.55, 1.25, 0.06), ((0.80, 0.72, 0.55), (0.72, 0.62, 0.46)), 7.0, straight),
        _Body(
            CUBE, (-0.75, 0.62, 0.30), (0.22, 0.22, 0.30), ((0.25, 0.42, 0.72), (0.85, 0.86, 0.80)), 4.6, _turn(z=0.5)
        ),
        _Body(
            CUBE, (0.95, 0.55, 0.17), (0.19, 0.19, 0.17), ((0.30, 0.60, 0.42), (0.82, 0.84, 0.62)), 4.6, _turn(z=-0.3)
        ),
        _Body(SPHERE, (0.30, 0.80, 0.22), (0.22, 0.22, 0.22), ((0.72, 0.40, 0.62), (0.80, 0.55, 0.70)), 6.0, straight),
    ]


def _moving_bodies(time: float) -> list[_Body]:
    """The ring tumbles once while it sways to and fro; the ball rolls and squashes."""
    turn = 2.0 * math.pi * time
    ring_center = (0.32 + 0.30 * math.sin(turn), -0.12, 0.62 + 0.06 * math.cos(turn))
    squash = 0.22 * math.sin(2.0 * turn)
    radius = 0.24
    half_sizes = (radius * (1 + 0.5 * squash), radius * (1 + 0.5 * squash), radius * (1 - squash))
    ball_center = (-0.52 + 0.26 * math.cos(turn), -0.42 + 0.12 * math.sin(turn), half_sizes[2])
    ring, ball = ((0.86, 0.58, 0.38), (0.70, 0.36, 0.24)), ((0.86, 0.30, 0.24), (0.93, 0.82, 0.50))
    return [
        _Body(TORUS, ring_center, (0.25, 0.25, 0.25), ring, 4.0, _turn(x=0.9 + turn, z=0.5 * turn), moves=True),
        _Body(SPHERE, ball_center, half_sizes, ball, 5.0, _turn(z=0.7 * math.sin(turn)), moves=True),
    ]


def _as_tensors(bodies: list[_Body], device: torch.device) -> Bodies:
    rows = []
    for body in bodies:
        # World → body is the inverse of scale, turn, shift.
        linear = torch.diag(1.0 / torch.tensor(body.half_sizes)) @ body.turn.T
        rows.append(torch.cat([linear, -(linear @ torch.tensor(body.center, dtype=torch.float32))[:, None]], 1))
    return Bodies(
        torch.tensor([body.kind for body in bodies], dtype=torch.int32, device=device),
        torch.stack(rows).contiguous().to(device),
        torch.tensor([body.colors for body in bodies], device=device),
        torch.tensor([body.frequency for body in bodies], device=device),
    )


def _camera(time: float, scene: BuiltinScene, shift: float) -> Camera:
    """The hand-held camera of a moment; ``shift`` to its right."""
    angle = -0.5 * math.pi + 0.42 * math.sin(2.0 * math.pi * (0.75 * time - 0.125))
    height = 1.25 + 0.18 * math.sin(2.0 * math.pi * (time + 0.2))
    position = torch.tensor([2.55 * math.cos(angle), 2.55 * math.sin(angle), height])
    target, up = torch.tensor([0.0, 0.1, 0.28]), torch.tensor([0.0, 0.0, 1.0])
    camera = Camera.looking_at(position, target, up, 0.95 * scene.width, (scene.width, scene.height), time)
    moved = camera.viewmat.clone()
    moved[0, 3] -= shift
    return Camera(moved, camera.K, camera.width, camera.height, time)


def _lamp(device: torch.device) -> Tensor:
    return torch.tensor([[0.9, -1.1, 2.7], [0.22, 0.0, 0.0], [0.0, 0.22, 0.0]], device=device)


def _samples(count: int, device: torch.device) -> Tensor:
    """Evenly spread places in the pixel, by an additive recurrence, and on the lamp, by a Fibonacci lattice.

    A lattice stays evenly spread when the pixels shift it modulo 1: shadows have a fifth less noise than with the
    recurrence in all four dimensions (measured at 16 samples).
    """
    root = 1.1673039782614187  # the real root of x⁵ = x + 1
    golden = 0.5 * (5.0**0.5 - 1.0)
    k = torch.arange(count, dtype=torch.float64)
    places = [0.5 + (k + 1) / root, 0.5 + (k + 1) / root**2, (k + 0.5) / count, k * golden]
    return (torch.stack(places, 1) % 1.0).float().contiguous().to(device)


def picture(time: float, shift: float, scene: BuiltinScene, device: torch.device) -> tuple[TracedImage, Camera]:
    """What a camera ``shift`` world units to the right of the training camera sees, in world units."""
    camera = _camera(time, scene, shift).to(device)
    bodies = _as_tensors([*_static_bodies(), *_moving_bodies(time)], device)
    lamp, samples = _lamp(device), _samples(scene.num_samples, device)
    return raytrace(bodies, lamp, samples, camera.viewmat, camera.K, camera.size), camera


def write_builtin_capture(folder: Path, scene: BuiltinScene, device: torch.device, quiet: bool = False) -> None:
    """Writes the capture into an empty folder.

    Raises:
        ValueError: If there are fewer than two frames.
        OSError: If a file can't be written; the message names it.
    """
    if scene.num_frames < 2:
        raise ValueError(f"the built-in scene needs at least 2 frames, got {scene.num_frames}")
    num_static = len(_static_bodies())
    jobs = [("left", k, 0.0) for k in range(scene.num_frames)]
    jobs += [("right", k, BASELINE) for k in range(0, scene.num_frames, 2)]
    metadata, points = {}, []
    for side, k, shift in progress(jobs, "making the built-in scene", quiet):
        name = f"{side}_{k:06d}"
        shot, camera = picture(k / (scene.num_frames - 1), shift, scene, device)
        static = (shot.bodies < num_static).cpu()
        metadata[name] = {"time_id": k, "warp_id": k, "appearance_id": k, "camera_id": int(side == "right")}
        write_png(folder / f"rgb/1x/{name}.png", (shot.image.cpu().clamp(0, 1) * 255).round().byte().numpy())
        write_png(folder / f"resized_mask/1x/{name}.png.png", static.byte().numpy() * 255)
        write_json(folder / f"camera/{name}.json", _camera_facts(camera.to("cpu")))
        if side == "left":
            write_png(folder / f"depth/1x/{name}.png", _monocular(shot.depth.cpu(), k / scene.num_frames))
            points.append(_surface_points(shot.depth.cpu(), static, camera.to("cpu"), k, scene))
    write_json(folder / "metadata.json", metadata)
    left, right = ([n for n in metadata if n.startswith(side)] for side in ("left", "right"))
    dataset = {"count": len(metadata), "num_exemplars": len(left), "ids": [*metadata], "train_ids": left}
    write_json(folder / "dataset.json", {**dataset, "val_ids": right})
    write_json(
        folder / "scene.json",
        {"center": CENTER, "scale": SCALE, "bbox": [[-1, -1, -1], [1, 1, 1]], "near": 0.05, "far": 4.0},
    )
    write_array(folder / "points.npy", torch.cat(points)[: scene.num_points].numpy())


def _camera_facts(camera: Camera) -> dict[str, object]:
    return {
        "orientation": camera.viewmat[:3, :3].tolist(),
        "position": camera.position.tolist(),
        "focal_length": camera.K[0, 0].item(),
        "principal_point": camera.K[:2, 2].tolist(),
        "skew": 0.0,
        "pixel_aspect_ratio": 1.0,
        "radial_distortion": [0.0, 0.0, 0.0],
        "tangential_distortion": [0.0, 0.0],
        "image_size": list(camera.size),
    }


def _monocular(depth: Tensor, phase: float) -> np.ndarray:
    """Inverse depth as a network gives it: 16 bits, with a scale and an offset that drift from frame to frame."""
    inverse = 1.0 / depth
    low, high = inverse.min(), inverse.max()
    value = (inverse - low) / (high - low)
    value = (0.72 + 0.10 * math.sin(9.0 * phase)) * value + 0.12 + 0.05 * math.cos(7.0 * phase)
    return (value * 65535.0).round().numpy().astype(np.uint16)


def _surface_points(depth: Tensor, static: Tensor, camera: Camera, k: int, scene: BuiltinScene) -> Tensor:
    """A frame's share of the sparse points: random static pixels, lifted, a little off their surfaces."""
    generator = torch.Generator().manual_seed(k)
    share = -(-scene.num_points // scene.num_frames)
    rows, columns = static.nonzero(as_tuple=True)
    chosen = torch.randperm(len(rows), generator=generator)[:share]
    row, column = rows[chosen], columns[chosen]
    points = camera.unproject(row, column, depth[row, column])
    return points + POINT_NOISE * torch.randn(points.shape, generator=generator)


def builtin_capture(
    cache_dir: Path | None = None,
    scene: BuiltinScene | None = None,
    device: torch.device | None = None,
    quiet: bool = False,
) -> Path:
    """The folder of the built-in capture, made on the first call.

    It is written beside its place and moved there whole, so a capture that was interrupted is never used.

    Args:
        cache_dir: Folder to keep it in; $XDG_CACHE_HOME/warpgs or ~/.cache/warpgs if None.
        scene: Its size; the default one if None.
        device: Where to trace; the CPU if None.
        quiet: Whether to show no progress bar; there is none either where stdout is no terminal.

    Raises:
        ValueError: If there are fewer than two frames.
        OSError: If it can't be written; the message says what.
    """
    scene = scene or BuiltinScene()
    if cache_dir is None:
        cache_dir = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warpgs"
    key = hashlib.blake2b(json.dumps([VERSION, asdict(scene)]).encode(), digest_size=6).hexdigest()
    folder = cache_dir / key / "builtin"
    if folder.is_dir():
        return folder
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix="partial-"))
    except OSError as error:
        raise OSError(f"the built-in scene can't be kept in {folder.parent}: {error.strerror}") from error
    try:
        write_builtin_capture(partial, scene, device or torch.device("cpu"), quiet)
        try:
            partial.rename(folder)
        except OSError:
            if not folder.is_dir():  # else another process was faster, and made the same
                raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder
