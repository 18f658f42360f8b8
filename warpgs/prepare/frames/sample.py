"""A short video to try ``warpgs prepare`` on: ray-traced, as a hand-held camera would record it.

A camera moves sideways past a corner of a room that is full of boxes and balls of random sizes and colours: places that
SIFT tells apart, unlike a checkerboard. In front of them a ring tumbles and a ball rolls and is squashed. The camera
shakes a little, so nothing repeats exactly.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.synthetic.bodies import Body, as_tensors, euler, even_samples
from warpgs.synthetic.raytrace import CUBE, SPHERE, TORUS, raytrace
from warpgs.video.encodings import ENCODINGS
from warpgs.video.writer import Video
from warpgs.visualize.images import to_bytes

RATE = 12.0
"""Frames per second."""

NUM_BODIES = 40
"""Number of boxes and balls along the walls and on the floor."""

MIN_SIDE, MIN_FRAMES = 64, 10
"""Minimum of the width and height [px], and of the number of frames, which ``warpgs prepare`` needs."""


@dataclass(frozen=True)
class SampleSize:
    """Size of the video.

    Attributes:
        width, height: Size of the frames [px].
        num_frames: Number of frames.
        num_samples: Samples per pixel.
    """

    width: int = 480
    height: int = 270
    num_frames: int = 48
    num_samples: int = 4


def write_sample(path: Path, size: SampleSize | None = None, log: Callable[[str], None] | None = None) -> None:
    """Writes the video.

    Args:
        path: File to write, with a suffix of ``ENCODINGS``; .mp4 loses least.
        size: Its size; the default size if None.
        log: Receives a line about what is traced, before a progress bar; None for no output at all.

    Raises:
        ValueError: If the suffix is unknown, the file exists (it may be a video of the user's own), or the size is too
            small for ``warpgs prepare``.
        OSError: If the file cannot be written; the message names it.
    """
    size = size or SampleSize()
    if path.suffix not in ENCODINGS:
        raise ValueError(f"{path} must end with {', '.join(ENCODINGS)}")
    if path.exists():
        raise ValueError(f"{path} exists: give another name, or delete it first")
    if min(size.width, size.height) < MIN_SIDE or size.num_frames < MIN_FRAMES or size.num_samples < 1:
        raise ValueError(f"the sample needs {MIN_FRAMES} frames of {MIN_SIDE}×{MIN_SIDE} pixels at least, got {size}")
    if log is not None:
        log(f"tracing {size.num_frames} frames of {size.width}×{size.height} for {path}")
    clutter = _clutter()
    with Video(path, RATE) as video:
        for k in progress(range(size.num_frames), "tracing", log is None):
            video.add(_frame(clutter, k / (size.num_frames - 1), size))


def _frame(clutter: list[Body], time: float, size: SampleSize) -> UInt8[np.ndarray, "H W 3"]:
    """[H, W, 3] the image at a time in [0, 1]."""
    cpu = torch.device("cpu")
    camera = _camera(time, size)
    lamp = torch.tensor(
        [[0.8, -2.2, 3.4], [0.06, 0.0, 0.0], [0.0, 0.06, 0.0]], dtype=torch.float32
    )  # small: sharp shadows
    bodies = as_tensors([*clutter, *_moving(time)], cpu)
    traced = raytrace(bodies, lamp, even_samples(size.num_samples, cpu), camera.viewmat, camera.K, camera.size)
    return to_bytes(traced.image)


def _camera(time: float, size: SampleSize) -> Camera:
    """The camera: 1.6 m sideways, with the shake of a hand."""
    sway = 2.0 * math.pi * time
    shake = [0.02 * math.sin(5.1 * sway + k) + 0.01 * math.sin(11.7 * sway + 2.0 * k) for k in range(5)]
    position = torch.tensor(
        [1.6 * (time - 0.5) + shake[0], -3.0 + 0.25 * math.sin(sway), 1.3 + 3.0 * shake[1]], dtype=torch.float32
    )
    target = torch.tensor([0.35 * (time - 0.5) + shake[2], 0.6 + shake[3], 0.75 + shake[4]], dtype=torch.float32)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float32)
    return Camera.looking_at(position, target, up, 0.9 * size.width, (size.width, size.height), time)


def _moving(time: float) -> list[Body]:
    """A ring that tumbles and swings, and a ball that rolls to and fro and is squashed."""
    angle = 2.0 * math.pi * time
    copper, checks = ((0.95, 0.62, 0.42), (0.55, 0.25, 0.15)), ((0.85, 0.25, 0.20), (0.95, 0.88, 0.60))
    ring = (-0.45 + 0.45 * math.sin(angle + 2.0), -0.45, 0.80 + 0.15 * math.cos(2.0 * angle))
    squash = 0.15 * math.sin(3.0 * angle)
    sizes = (0.24 * (1.0 + 0.5 * squash), 0.24 * (1.0 + 0.5 * squash), 0.24 * (1.0 - squash))
    ball = (0.45 + 0.40 * math.cos(angle), -0.55 + 0.15 * math.sin(angle), sizes[2])
    return [
        Body(TORUS, ring, (0.28, 0.28, 0.28), copper, 5.0, euler(x=0.9 + 1.5 * angle, z=angle)),
        Body(SPHERE, ball, sizes, checks, 6.0, euler(x=0.4, z=1.7 * math.sin(angle))),
    ]


def _clutter() -> list[Body]:
    """The room, and what stands in it and hangs on its walls."""
    random = np.random.default_rng(3)
    plaster = ((0.63, 0.62, 0.58), (0.70, 0.69, 0.64))
    bodies = [Body(CUBE, (0.0, 0.0, 2.0), (3.6, 3.6, 2.0), plaster, 11.0, euler(), shine=0.0)]
    for k in range(NUM_BODIES):
        light, dark = random.uniform(0.35, 0.95, 3), random.uniform(0.05, 0.75, 3)
        colors = (tuple(light.tolist()), tuple((light * dark).tolist()))
        x, u, turn = random.uniform(-2.6, 2.6), random.uniform(), random.uniform(-0.6, 0.6)
        half = random.uniform(0.10, 0.32, 3).tolist()
        frequency = float(random.uniform(1.5, 7.0))
        # On the wall behind, or on the floor behind what moves.
        position = (x, 2.0 + 1.4 * u, random.uniform(0.1, 2.4)) if k % 2 else (x, 2.2 * u - 0.1, half[2])
        shape = SPHERE if k % 5 == 0 else CUBE
        bodies.append(Body(shape, position, (half[0], half[1], half[2]), colors, frequency, euler(z=turn)))
    return bodies
