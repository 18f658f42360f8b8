"""Bodies of the built-in captures, and where samples of a pixel lie."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.config import Color

from .raytrace import Bodies


@dataclass(frozen=True)
class Body:
    """A unit shape: scaled by ``half_sizes``, then rotated, then shifted to ``center``.

    Attributes:
        shape: SPHERE, CUBE, TORUS or BLOB of ``synthetic/raytrace.py``.
        center: Its centre in the world.
        half_sizes: Scale along each axis of the body.
        colors: The two colours of its checkerboard.
        frequency: Angular frequency of the checkerboard [rad per unit of body space].
        rotation: [3, 3] in double precision.
        shine: Strength of the highlight.
        mirror: Fraction of mirrored light.
        bulge: Height of a blob's lobes.
    """

    shape: int
    center: tuple[float, float, float]
    half_sizes: tuple[float, float, float]
    colors: tuple[Color, Color]
    frequency: float
    rotation: Float[Tensor, "3 3"]
    shine: float = 0.18
    mirror: float = 0.0
    bulge: float = 0.0


def euler(x: float = 0.0, z: float = 0.0) -> Float[Tensor, "3 3"]:
    """Rotation about x, then z [rad], in double precision."""
    matrices = []
    for axis, angle in ((0, x), (2, z)):
        c, s = math.cos(angle), math.sin(angle)
        m = torch.eye(3, dtype=torch.float64)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        m[i, i], m[i, j], m[j, i], m[j, j] = c, -s, s, c
        matrices.append(m)
    return matrices[1] @ matrices[0]


def as_tensors(bodies: Sequence[Body], device: torch.device) -> Bodies:
    """Bodies for the ray tracer.

    Everything is computed in double precision and rounded once, so that machines agree on the last bit.
    """
    rows = []
    for body in bodies:
        linear = torch.diag(1.0 / torch.tensor(body.half_sizes, dtype=torch.float64)) @ body.rotation.T
        offset = linear @ torch.tensor(body.center, dtype=torch.float64)
        rows.append(torch.cat([linear, -offset[:, None]], 1).float())
    return Bodies(
        torch.tensor([body.shape for body in bodies], dtype=torch.int32, device=device),
        torch.stack(rows).contiguous().to(device),
        torch.tensor([body.colors for body in bodies], dtype=torch.float32, device=device),
        torch.tensor([body.frequency for body in bodies], dtype=torch.float32, device=device),
        torch.tensor([(body.shine, body.mirror, body.bulge) for body in bodies], dtype=torch.float32, device=device),
    )


def even_samples(count: int, device: torch.device) -> Float[Tensor, "S 4"]:
    """Positions in the pixel (additive recurrence) and on the lamp (Fibonacci lattice), evenly distributed.

    A lattice stays even when each pixel shifts it modulo 1: shadows have 20 % less noise than with the recurrence in
    all four dimensions (measured with 16 samples).
    """
    root = 1.1673039782614187  # the real root of x⁵ = x + 1
    golden = 0.5 * (5.0**0.5 - 1.0)
    k = torch.arange(count, dtype=torch.float64)
    positions = [0.5 + (k + 1) / root, 0.5 + (k + 1) / root**2, (k + 0.5) / count, k * golden]
    return (torch.stack(positions, 1) % 1.0).float().contiguous().to(device)
