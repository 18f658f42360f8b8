"""Tracks of points of the studio: exact ones, and such as a network gives that loses its points."""

import shutil
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float

from warpgs.data.tracks import write_tracks

from .bodies import Body
from .cache import cached
from .raytrace import BLOB
from .studio import StudioSize, camera_at, moving_bodies, static_bodies, trace_bodies

NUM_QUERIES, MAX_PER_QUERY, MAX_STATIC = 20, 120, 10
"""Number of frames that points are chosen in, and of points of each moving and static body in each of these frames."""

MAX_OFFSET = 0.02
"""Maximum difference of the depth of a point and of the pixel that shows it, relative to it."""

DRIFTING, SPEED = 0.5, 0.003
"""Fraction of the broken tracks that drift, and how far they do from frame to frame, relative to the width."""

BREAKING = 0.4
"""Fraction of the broken tracks that jump to another point."""

WRONGLY_SEEN = 0.1
"""Fraction of the hidden positions of broken tracks that count as seen."""

Seen = tuple[Float[np.ndarray, "N F 2"], Bool[np.ndarray, "N F"]]
"""[N, F, 2] columns and rows of N points in F frames [px], and [N, F] whether they are seen there."""


def with_tracks(studio: Path, tracks: Literal["exact", "broken"], size: StudioSize, quiet: bool = False) -> Path:
    """The folder of a copy of the studio with tracks, which is created on the first call."""

    def write(partial: Path) -> None:
        shutil.copytree(studio, partial, dirs_exist_ok=True)
        seen = exact_tracks(size)
        write_tracks(partial, *(seen if tracks == "exact" else broken_tracks(seen)), (size.width, size.height))

    return cached(studio.with_name(f"{studio.name}-tracks-{tracks}"), write, quiet)


def exact_tracks(size: StudioSize) -> Seen:
    """Tracks of points of all bodies, chosen in frames that are evenly spread, most of them dynamic."""
    times = [k / (size.num_frames - 1) for k in range(size.num_frames)]
    shown = [_Shown(time, size) for time in times]
    random, parts = np.random.default_rng(0), []
    for query in np.unique(np.linspace(0, size.num_frames - 1, NUM_QUERIES).round().astype(int)):
        frame = shown[query]
        for index, body in enumerate(frame.bodies):
            rows, columns = (frame.hits == index).nonzero()
            chosen = random.permutation(len(rows))[: MAX_PER_QUERY if index >= frame.num_static else MAX_STATIC]
            row, column = torch.from_numpy(rows[chosen]), torch.from_numpy(columns[chosen])
            points = frame.camera.unproject(row, column, torch.from_numpy(frame.depth)[row, column])
            local = _into(body, points.double().numpy())
            parts.append([other.see(local, index) for other in shown])
    each = [[np.stack(values, 1) for values in zip(*part, strict=True)] for part in parts]
    positions, visible = (np.concatenate(values) for values in zip(*each, strict=True))
    return positions, visible


def broken_tracks(exact: Seen) -> Seen:
    """The same, as a network gives them that drifts, jumps to other points and sees what is hidden."""
    random, (positions, visible) = np.random.default_rng(0), exact
    count, num_frames = visible.shape
    width = np.nanmax(positions[visible][:, 0])
    kind, moved = random.random(count), positions.copy()
    first = visible.argmax(1)
    angle = random.uniform(0.0, 2.0 * np.pi, count)
    direction = np.stack([np.cos(angle), np.sin(angle)], 1)
    since = np.abs(np.arange(num_frames) - first[:, None])
    drifts = kind < DRIFTING
    moved[drifts] += (SPEED * width * since[..., None] * direction[:, None])[drifts]
    breaks = np.flatnonzero((kind >= DRIFTING) & (kind < DRIFTING + BREAKING))
    for track, other in zip(breaks, random.permutation(count), strict=False):
        start = random.integers(1, num_frames)
        moved[track, start:] = positions[other, start:]
    return moved, visible | (random.random(visible.shape) < WRONGLY_SEEN)


class _Shown:
    """What a frame shows.

    Attributes:
        camera: Its camera, in the world.
        bodies: All bodies at its time, the static ones first.
        num_static: Number of static ones.
        depth: [H, W] depth of each pixel [world units].
        hits: [H, W] index of the body that it shows.
    """

    def __init__(self, time: float, size: StudioSize) -> None:
        static = static_bodies()
        self.camera = camera_at(time, 0.0, size)
        self.bodies, self.num_static = [*static, *moving_bodies(time)], len(static)
        traced = trace_bodies(self.bodies, self.camera, 1)
        self.depth, self.hits = traced.depth.numpy(), traced.bodies.numpy()

    def see(
        self, local: Float[np.ndarray, "N 3"], index: int
    ) -> tuple[Float[np.ndarray, "N 2"], Bool[np.ndarray, " N"]]:
        """Where points of a body, as points of its unit shape, are in the image, and which of them are seen."""
        camera, points = self.camera, torch.from_numpy(_out_of(self.bodies[index], local)).float()
        placed, depth, is_before = camera.place(points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3])
        column, row = np.floor(placed.numpy()).astype(int).T
        inside = is_before.numpy() & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        row, column = np.where(inside, row, 0), np.where(inside, column, 0)
        is_near = np.abs(self.depth[row, column] - depth.numpy()) < MAX_OFFSET * depth.numpy()
        return placed.numpy(), inside & is_near & (self.hits[row, column] == index)


def _into(body: Body, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Points in the world as points of the unit shape; directions on a blob."""
    local = (points - np.array(body.center)) @ body.rotation.numpy() / np.array(body.half_sizes)
    return local / np.linalg.norm(local, axis=1, keepdims=True) if body.shape == BLOB else local


def _out_of(body: Body, local: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """The inverse of ``_into``."""
    if body.shape == BLOB:
        lobes = local[:, 0] * (local[:, 0] ** 2 - 3.0 * local[:, 1] ** 2)
        local = local * (1.0 + body.bulge * lobes)[:, None]
    return local * np.array(body.half_sizes) @ body.rotation.numpy().T + np.array(body.center)
