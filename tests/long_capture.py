"""Writes a capture of minutes, to measure trainings of long videos with: the studio, where things come and go.

    python -m tests.long_capture FOLDER --seconds 180 --size 854x480

One hand-held camera trains, a second one beside it evaluates twice a second. The blob is always there, the ring leaves
for a third of each minute, and every 13 seconds a visitor of other colours crosses the table in ten. No motion repeats.
Ray-traced by several processes, on a GPU where there is one; the bits depend on the machine.
"""

import argparse
import dataclasses
import math
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch

from warpgs.data import writer
from warpgs.data.units import SceneUnits
from warpgs.synthetic import studio
from warpgs.synthetic.bodies import Body, as_tensors, euler, even_samples
from warpgs.synthetic.raytrace import BLOB, CUBE, SPHERE, TracedImage, raytrace
from warpgs.visualize.images import to_bytes

PERIODS = (16.0, 11.3, 14.1)
"""Times in which the camera, the ring and the blob do what those of the studio do in the whole capture [s]."""

MINUTE, AWAY, WAY = 60.0, 20.0, 1.5
"""Every minute the ring is away for so long; the time that it takes to leave [s]."""

EVERY, STAY = 13.0, 10.0
"""Time between visitors, and time in which each crosses the table [s]."""

VAL_RATE = 2.0
"""Evaluation frames per second."""

MAX_PROCESSES = 16
"""Maximum number of processes, each of which traces and writes frames; on a GPU, too."""


def _away(t: float) -> float:
    """How far the ring has gone to the left, through the wall, 0 to 1."""
    in_minute = t % MINUTE - (MINUTE - AWAY)
    x = min(1.0, max(0.0, min(in_minute, AWAY - in_minute) / WAY))
    return x * x * (3.0 - 2.0 * x)


def moving_bodies(t: float) -> list[Body]:
    """All that moves at a time [s]."""
    ring, blob = studio.moving_bodies(t / PERIODS[1])[0], studio.moving_bodies(t / PERIODS[2])[1]
    x, y, z = ring.center
    bodies = [dataclasses.replace(ring, center=(x - 6.0 * _away(t), y, z)), blob]
    number, since = divmod(t, EVERY)
    if since <= STAY:
        random = np.random.default_rng(int(number))
        colors = [tuple(random.uniform(0.2, 0.95, 3).round(2).tolist()) for _ in range(2)]
        across = (2.0 * since / STAY - 1.0) * (-1.0) ** int(random.integers(2))
        y, hops = random.uniform(-0.9, 0.1), random.uniform(2.0, 4.0)
        height = 0.75 + 0.35 * abs(math.sin(math.pi * hops * since / STAY))
        shape, size = (SPHERE, CUBE, BLOB)[int(number) % 3], random.uniform(0.13, 0.2)
        turn = euler(x=0.6 * since, z=1.3 * since)
        visitor = Body(shape, (3.4 * across, y, height), (size,) * 3, (colors[0], colors[1]), 6.0, turn, bulge=0.1)
        bodies.append(visitor)
    return bodies


def _trace(t: float, shift: float, size: studio.StudioSize, device: torch.device) -> tuple[TracedImage, int]:
    static = studio.static_bodies()
    bodies = as_tensors([*static, *moving_bodies(t)], device)
    lamp = torch.tensor([[1.3, -1.0, 4.1], [0.45, 0.0, 0.0], [0.0, 0.45, 0.0]], device=device)
    camera = studio.camera_at(t / PERIODS[0], shift, size).to(device)
    samples = even_samples(size.num_samples, device)
    return raytrace(bodies, lamp, samples, camera.viewmat, camera.K, camera.size), len(static)


def _write(
    folder: Path, frame: tuple[str, int, float], rate: float, size: studio.StudioSize, device: torch.device
) -> np.ndarray:
    """Writes a frame: its name, its number, and how far the camera is beside the one that trains; returns points."""
    name, k, shift = frame
    traced, num_static = _trace(k / rate, shift, size, device)
    depth, static = traced.depth.cpu().numpy(), (traced.bodies < num_static).cpu().numpy()
    rotation, position = studio._pose(k / rate / PERIODS[0], shift)
    writer.write_image(folder, name, to_bytes(traced.image))
    writer.write_mask(folder, name, static)
    writer.write_camera(folder, name, studio.lens_of(size), rotation.round(9), position.round(9))
    if shift:
        return np.zeros((0, 3), np.float32)
    inverse = 1.0 / depth.astype(np.float64)
    writer.write_depth(folder, name, studio.sixteen_bits(inverse, k / size.num_frames))
    count = -(-size.num_points // size.num_frames)
    return studio.surface_points(inverse, static, studio.lens_of(size), (rotation, position), count, k)


def _write_part(
    folder: Path, frames: list[tuple[str, int, float]], rate: float, size: studio.StudioSize
) -> list[np.ndarray]:
    torch.set_num_threads(1)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    return [_write(folder, frame, rate, size, device) for frame in frames]


def write_long(folder: Path, seconds: float, rate: float, size: studio.StudioSize) -> None:
    """Writes the capture to an empty folder; ``size.num_frames`` is not used."""
    size = dataclasses.replace(size, num_frames=round(seconds * rate))
    every = max(1, round(rate / VAL_RATE))
    frames = [(f"left_{k:06d}", k, 0.0) for k in range(size.num_frames)]
    frames += [(f"right_{k:06d}", k, studio.BASELINE) for k in range(every // 2, size.num_frames, every)]
    num = min(MAX_PROCESSES, os.cpu_count() or 1)
    with ProcessPoolExecutor(num, multiprocessing.get_context("spawn")) as pool:
        jobs = [pool.submit(_write_part, folder, frames[k::num], rate, size) for k in range(num)]
        points = [part for job in jobs for part in job.result()]
    writer.write_scene(folder, SceneUnits(np.array(studio.CENTER), studio.SCALE), np.concatenate(points), 0.05, 3.0)
    val = [name for name, _, shift in frames if shift]
    ids = {name: int(shift > 0) for name, _, shift in frames}
    writer.write_index(folder, {name: k for name, k, _ in frames}, val, ids)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--size", default="854x480")
    parser.add_argument("--points", type=int, default=30_000)
    parser.add_argument("--samples", type=int, default=8)
    given = parser.parse_args()
    width, height = map(int, given.size.split("x"))
    options = {"num_points": given.points, "num_samples": given.samples}
    write_long(given.folder, given.seconds, given.rate, studio.StudioSize(width, height, **options))
