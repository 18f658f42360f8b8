"""The built-in capture ``builtin:studio``: a benchmark that everyone can make on a machine of their own.

480×270; 160 training frames of one hand-held camera, 80 evaluation frames of a second one beside it. On a table in a
room a mirroring ring tumbles, a glossy body is squashed and changes its lobes, and both throw soft shadows. Masks are
exact, points are noisy, depth is exact, has the errors of a network, or is missing:

    builtin:studio    builtin:studio?depth=network    builtin:studio?depth=none    builtin:studio?frames=12
    builtin:studio?tracks=exact    builtin:studio?tracks=broken       builtin:studio?sky=yes

With fewer frames, the camera and all that moves take wider steps along the same paths. With a sky, the table is on a
terrace with a low wall and a frame of beams.

The content is the same bits on every machine, so numbers can be compared: the images by the ray tracer (see its
kernels), the rest by computing in double precision before the last rounding.
"""

import math
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data import writer
from warpgs.data.images import decode
from warpgs.data.lens import Lens
from warpgs.data.units import SceneUnits
from warpgs.visualize.images import to_bytes

from .bodies import Body, as_tensors, euler, even_samples
from .cache import cached, content_folder
from .degraded_depth import DegradedDepth
from .open_sky import trace_under_sky
from .raytrace import BLOB, CUBE, SPHERE, TORUS, TracedImage, raytrace
from .room import BuiltinScene, stereo_frames, write_stereo_index

Depth = Literal["exact", "network", "none"]

CENTER, SCALE = (0.0, 0.3, 0.9), 0.25
"""Scene units are (p − CENTER) · SCALE."""

POINT_NOISE = 0.004
"""Standard deviation of the noise on the sparse points [world units]."""

MAX_DEPTH = 1e3
"""Depth beyond which there is nothing but the sky [world units]."""

BASELINE = 0.28
"""Distance of the evaluation camera, to the right of the training camera [world units]."""

VERSION = 1
"""Increase it when the content changes, so that cached captures are not used any more."""

Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True)
class StudioSize(BuiltinScene):
    """Size of the capture; numbers are compared at the default only."""

    width: int = 480
    height: int = 270
    num_frames: int = 160
    num_samples: int = 8
    num_points: int = 10_000


ROOM = ((0.60, 0.63, 0.70), (0.74, 0.71, 0.63))
"""Colours of walls and floor."""


def terrace() -> list[Body]:
    """What takes the place of the room under the sky."""
    wall = ((0.70, 0.52, 0.42), (0.58, 0.40, 0.34))
    return [
        Body(CUBE, (0.0, 0.6, -0.65), (4.2, 4.2, 0.05), ROOM, 13.0, euler(), shine=0.0),
        Body(CUBE, (0.0, 4.7, -0.25), (4.2, 0.10, 0.35), wall, 11.0, euler(), shine=0.0),
        *(Body(CUBE, (x, 0.6, -0.25), (0.10, 4.2, 0.35), wall, 11.0, euler(), shine=0.0) for x in (-4.1, 4.1)),
        *(Body(CUBE, (x, 4.5, 0.9), (0.06, 0.06, 1.5), wall, 7.0, euler(), shine=0.0) for x in (-2.4, -0.4, 1.6)),
        Body(CUBE, (-0.4, 4.5, 1.35), (2.6, 0.05, 0.05), wall, 9.0, euler(), shine=0.0),
    ]


def static_bodies(sky: bool = False) -> list[Body]:
    """The room, or a terrace under the sky, the table and the objects that rest on it."""
    wood, leg = ((0.84, 0.77, 0.56), (0.75, 0.66, 0.47)), ((0.52, 0.42, 0.30), (0.45, 0.36, 0.26))
    blue, grey = ((0.24, 0.40, 0.74), (0.88, 0.87, 0.78)), ((0.42, 0.52, 0.66), (0.80, 0.82, 0.84))
    violet, red = ((0.66, 0.46, 0.78), (0.74, 0.58, 0.82)), ((0.86, 0.36, 0.28), (0.90, 0.52, 0.36))
    pink, green = ((0.84, 0.42, 0.56), (0.92, 0.66, 0.72)), ((0.30, 0.56, 0.54), (0.42, 0.66, 0.62))
    corners = [(x, y) for x in (-1.55, 1.55) for y in (-0.9, 1.3)]
    room = [Body(CUBE, (0.0, 0.6, 1.9), (4.2, 4.2, 2.5), ROOM, 13.0, euler(), shine=0.0)]
    return [
        *(terrace() if sky else room),
        Body(CUBE, (0.0, 0.2, 0.54), (1.7, 1.25, 0.06), wood, 6.0, euler(), shine=0.05),
        Body(CUBE, (-0.55, 0.95, 0.94), (0.20, 0.20, 0.34), blue, 7.0, euler(z=0.4)),
        Body(CUBE, (0.35, 0.70, 0.76), (0.19, 0.15, 0.16), grey, 6.0, euler(z=-0.5)),
        Body(SPHERE, (0.95, 0.80, 0.77), (0.17, 0.17, 0.17), violet, 5.0, euler()),
        Body(SPHERE, (1.35, 1.05, 0.84), (0.24, 0.24, 0.24), red, 4.0, euler()),
        Body(SPHERE, (-1.25, 0.60, 0.80), (0.13, 0.13, 0.20), pink, 6.0, euler()),
        Body(SPHERE, (-0.15, 0.45, 0.78), (0.18, 0.18, 0.18), green, 5.0, euler(), shine=0.5, mirror=0.25),
        *(Body(CUBE, (x, y, -0.06), (0.07, 0.07, 0.54), leg, 9.0, euler()) for x, y in corners),
    ]


def moving_bodies(time: float) -> list[Body]:
    """The ring tumbles while it swings to and fro; the blob rolls, is squashed and changes its lobes."""
    angle = 2.0 * math.pi * time
    ring = (0.30 + 0.55 * math.sin(angle + 0.4), -0.10 + 0.25 * math.cos(angle), 1.12 + 0.14 * math.sin(2.0 * angle))
    squash = 0.20 * math.sin(3.0 * angle)
    radius = 0.30
    sizes = (radius * (1.0 + 0.5 * squash), radius * (1.0 + 0.5 * squash), radius * (1.0 - squash))
    blob = (-0.55 + 0.45 * math.cos(angle + 0.9), -0.45 + 0.20 * math.sin(angle), 0.60 + 1.12 * sizes[2])
    copper, checks = ((0.95, 0.72, 0.58), (0.86, 0.56, 0.42)), ((0.85, 0.36, 0.32), (0.94, 0.86, 0.56))
    tumble = euler(x=1.2 + 2.0 * angle, z=1.5 * angle)
    bulge = 0.2 * math.sin(2.0 * angle)
    return [
        Body(TORUS, ring, (0.30, 0.30, 0.30), copper, 3.0, tumble, shine=0.9, mirror=0.5),
        Body(BLOB, blob, sizes, checks, 5.5, euler(x=0.3, z=1.2 * angle), shine=0.6, bulge=bulge),
    ]


def _pose(time: float, shift: float) -> tuple[Float[np.ndarray, "3 3"], Vector]:
    """World-to-camera rotation and position of the hand-held camera, moved to its right by ``shift``."""
    angle = -0.5 * math.pi + 0.50 * math.sin(2.0 * math.pi * (0.8 * time + 0.07))
    height = 1.78 + 0.27 * math.sin(2.0 * math.pi * (1.7 * time + 0.02))
    position = np.array([3.1 * math.cos(angle), 3.1 * math.sin(angle), height])
    rotation = looking_at_table(position)
    return rotation, position + shift * rotation[0]


def looking_at_table(position: Vector) -> Float[np.ndarray, "3 3"]:
    """World-to-camera rotation of a camera that looks at what moves, with z up."""
    forward = np.array([0.0, 0.3, 0.82]) - position
    forward /= math.sqrt(sum(x * x for x in forward.tolist()))
    right = np.array([forward[1], -forward[0], 0.0]) / math.hypot(forward[0], forward[1])
    return np.stack([right, np.cross(forward, right), forward])


def camera_at(time: float, shift: float, size: StudioSize) -> Camera:
    """The hand-held camera at a time in [0, 1], moved to its right by ``shift`` [world units]."""
    rotation, position = _pose(time, shift)
    return lens_of(size).camera(rotation, position, time)


def trace(time: float, shift: float, size: StudioSize, sky: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Image [H, W, 3], depth [H, W] in world units, 1e6 in the sky, and static mask [H, W] of a frame.

    The time is in [0, 1], and the camera ``shift`` [world units] to the right of the training camera.
    """
    return trace_from(camera_at(time, shift, size), size, sky)


def trace_from(camera: Camera, size: StudioSize, sky: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """The same through a camera in world units, at its time, which may be later than 1."""
    static = static_bodies(sky)
    traced = trace_bodies([*static, *moving_bodies(camera.time)], camera, size.num_samples, sky)
    return traced.image, traced.depth, traced.bodies < len(static)


def trace_bodies(bodies: Sequence[Body], camera: Camera, num_samples: int, sky: bool = False) -> TracedImage:
    """What a camera in world units sees of bodies under the lamp of the studio, and behind them of the sky."""
    cpu = torch.device("cpu")  # a GPU rounds otherwise
    lamp = torch.tensor([[1.3, -1.0, 4.1], [0.45, 0.0, 0.0], [0.0, 0.45, 0.0]], dtype=torch.float32)
    samples = even_samples(num_samples, cpu)
    if sky:
        return trace_under_sky(bodies, lamp, samples, camera)
    return raytrace(as_tensors(bodies, cpu), lamp, samples, camera.viewmat, camera.K, camera.size)


def write_studio(folder: Path, size: StudioSize, quiet: bool = False, sky: bool = False) -> None:
    """Writes the capture, with exact depth, to an empty folder.

    Raises:
        ValueError: If there are fewer than two frames.
        OSError: If a file cannot be written; the message names it.
    """
    frames, points = stereo_frames(size.num_frames, BASELINE), []
    for name, k, shift in progress(frames, "creating builtin:studio, once for all runs", quiet):
        time = k / (size.num_frames - 1)
        image, depth, static = trace(time, shift, size, sky)
        rotation, position = _pose(time, shift)
        writer.write_image(folder, name, to_bytes(image))
        writer.write_mask(folder, name, static.numpy())
        writer.write_camera(folder, name, lens_of(size), rotation.round(9), position.round(9))
        if not shift:
            inverse = 1.0 / depth.numpy().astype(np.float64)
            writer.write_depth(folder, name, sixteen_bits(inverse, k / size.num_frames))
            count = -(-size.num_points // size.num_frames)
            surface = static.numpy() & (depth.numpy() < MAX_DEPTH)
            points.append(surface_points(inverse, surface, lens_of(size), (rotation, position), count, k))
    units = SceneUnits(np.array(CENTER), SCALE)
    writer.write_scene(folder, units, np.concatenate(points)[: size.num_points], near=0.05, far=3.0)
    write_stereo_index(folder, frames)


def lens_of(size: StudioSize) -> Lens:
    """The lens of all cameras."""
    return Lens.centered(0.82 * size.width, (size.width, size.height))


def sixteen_bits(inverse: Float[np.ndarray, "H W"], phase: float) -> np.ndarray:
    """Inverse depth with a scale and an offset that drift from frame to frame, as 16 bits."""
    value = (inverse - inverse.min()) / (inverse.max() - inverse.min())
    value = (0.70 + 0.10 * math.sin(9.0 * phase)) * value + 0.12 + 0.05 * math.cos(7.0 * phase)
    return (value * 65535.0).round().astype(np.uint16)


def surface_points(
    inverse: Float[np.ndarray, "H W"],
    static: Bool[np.ndarray, "H W"],
    lens: Lens,
    pose: tuple[Float[np.ndarray, "3 3"], Vector],
    count: int,
    seed: int,
) -> Float[np.ndarray, "P 3"]:
    """The sparse points of a frame, in the world: random static pixels, unprojected with some noise.

    Args:
        inverse: [H, W] its inverse depth.
        static: [H, W] its static mask.
        lens: Its lens.
        pose: Its world-to-camera rotation and its position.
        count: Number of points, if there are as many static pixels.
        seed: Seed of the choice and of the noise.
    """
    random, (rotation, position) = np.random.default_rng(seed), pose
    rows, columns = static.nonzero()
    chosen = random.permutation(len(rows))[:count]
    row, column = rows[chosen], columns[chosen]
    local = np.stack([*lens.unproject(column + 0.5, row + 0.5), np.ones(len(row))], 1) / inverse[row, column, None]
    points = local @ rotation + position + POINT_NOISE * random.standard_normal((len(row), 3))
    return points.round(6).astype(np.float32)


def studio_capture(
    depth: Depth = "exact",
    cache_dir: Path | None = None,
    size: StudioSize | None = None,
    quiet: bool = False,
    sky: bool = False,
) -> Path:
    """The folder of the capture with exact depth, with the errors of a network, or without; see ``builtin_capture``.

    With ``sky``, the room is open.
    """
    size, name = size or StudioSize(), "studio-sky" if sky else "studio"
    root = content_folder(cache_dir, [name, VERSION, asdict(size)])
    exact = cached(root / name, lambda partial: write_studio(partial, size, quiet, sky), quiet)
    if depth == "exact":
        return exact
    copy = root / f"{name}-depth-{depth}"
    return cached(copy, lambda partial: _copy(exact, partial, depth == "network"), quiet)


def _copy(exact: Path, folder: Path, with_depth: bool) -> None:
    """Copies a capture without its depth, or with the errors of a network in it."""
    shutil.copytree(exact, folder, ignore=shutil.ignore_patterns("depth"), dirs_exist_ok=True)
    if not with_depth:
        return
    files = sorted((exact / "depth/1x").glob("*.png"))
    errors = DegradedDepth(len(files))
    for k, path in enumerate(files):
        inverse = decode(path).astype(np.float64)
        mask = decode(exact / f"resized_mask/1x/{path.name}.png")
        writer.write_depth(folder, path.stem, errors(k, inverse, mask == 0))
