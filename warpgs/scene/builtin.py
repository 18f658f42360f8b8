"""The built-in scene: a chequered floor, three pillars and a tumbling ring, made of splats by formula."""

import math

import torch
from torch import Tensor

from warpgs.cameras import Camera

from .splats import Splats

FLOOR_HALF_SIZE = 2.0
FLOOR_SPLATS_PER_SIDE = 96
PILLAR_SPLATS = 1500
RING_SPLATS = 2500
RING_RADIUS, RING_THICKNESS = 0.55, 0.13


def builtin_splats(time: float) -> Splats:
    """The scene at a moment in [0, 1]: static floor and pillars, a dynamic ring that tumbles once."""
    parts = [_floor(), *(_pillar(angle) for angle in (0.4, 2.5, 4.6)), _ring(time)]
    means, normals, sizes, colors = (torch.cat(values) for values in zip(*parts, strict=True))
    num_ring = parts[-1][0].shape[0]
    flat = torch.tensor([1.0, 1.0, 0.15])
    return Splats(
        means=means,
        quats=_turn_z_to(normals),
        scales=(sizes[:, None] * flat).contiguous(),
        opacities=torch.full((means.shape[0],), 0.96),
        colors=colors.clamp(0.0, 1.0),
        is_dynamic=torch.arange(means.shape[0]) >= means.shape[0] - num_ring,
    )


def builtin_camera(time: float, width: int = 480, height: int = 270) -> Camera:
    """A camera that moves around the built-in scene; z is up."""
    angle = 0.9 + 0.5 * math.sin(2.0 * math.pi * time)
    position = torch.tensor([4.2 * math.cos(angle), 4.2 * math.sin(angle), 2.1])
    target, up = torch.tensor([0.0, 0.0, 0.45]), torch.tensor([0.0, 0.0, 1.0])
    return Camera.looking_at(position, target, up, focal=1.1 * width, size=(width, height), time=time)


_Part = tuple[Tensor, Tensor, Tensor, Tensor]


def _floor() -> _Part:
    line = torch.linspace(-FLOOR_HALF_SIZE, FLOOR_HALF_SIZE, FLOOR_SPLATS_PER_SIDE)
    x, y = (v.reshape(-1) for v in torch.meshgrid(line, line, indexing="ij"))
    means = torch.stack([x, y, torch.zeros_like(x)], -1)
    dark = ((torch.floor(x * 2) + torch.floor(y * 2)) % 2)[:, None]
    colors = 0.82 - 0.5 * dark * torch.tensor([0.9, 0.7, 0.4])
    return means, torch.tensor([0.0, 0.0, 1.0]).expand_as(means), torch.full_like(x, 0.028), colors


def _pillar(angle: float) -> _Part:
    turn = _golden(PILLAR_SPLATS) * 2.0 * math.pi
    height = torch.linspace(0.0, 1.1, PILLAR_SPLATS)
    normals = torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], -1)
    center = torch.tensor([1.3 * math.cos(angle), 1.3 * math.sin(angle), 0.0])
    means = center + 0.16 * normals + height[:, None] * torch.tensor([0.0, 0.0, 1.0])
    hue = torch.tensor([math.cos(angle), math.cos(angle - 2.1), math.cos(angle + 2.1)])
    colors = 0.5 + 0.3 * hue + 0.15 * normals[:, :1]
    return means, normals, torch.full_like(turn, 0.026), colors


def _ring(time: float) -> _Part:
    around = torch.linspace(0.0, 2.0 * math.pi, RING_SPLATS + 1)[:-1]
    across = _golden(RING_SPLATS) * 2.0 * math.pi
    outward = torch.stack([around.cos(), around.sin(), torch.zeros_like(around)], -1)
    up = torch.tensor([0.0, 0.0, 1.0])
    normals = across.cos()[:, None] * outward + across.sin()[:, None] * up
    means = RING_RADIUS * outward + RING_THICKNESS * normals
    colors = 0.55 + 0.3 * torch.stack([around.cos(), (around - 2.1).cos(), (around + 2.1).cos()], -1)
    a, b = 2.0 * math.pi * time, 1.0 + math.pi * time
    tumble_x = torch.tensor([[1.0, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]])
    tumble_y = torch.tensor([[math.cos(b), 0, math.sin(b)], [0, 1.0, 0], [-math.sin(b), 0, math.cos(b)]])
    rotation = tumble_x @ tumble_y
    lift = torch.tensor([0.0, 0.0, 0.85])
    return means @ rotation.T + lift, normals @ rotation.T, torch.full_like(around, 0.022), colors


def _golden(count: int) -> Tensor:
    """Evenly spread fractions by the golden ratio."""
    return torch.arange(count) * ((math.sqrt(5.0) - 1.0) / 2.0) % 1.0


def _turn_z_to(normals: Tensor) -> Tensor:
    """[N, 4] quaternions (w, x, y, z), not normalised, that turn the z axis to unit normals."""
    x, y, z = normals.unbind(-1)
    quats = torch.stack([1.0 + z, -y, x, torch.zeros_like(x)], -1)
    downwards = torch.tensor([0.0, 1.0, 0.0, 0.0])  # half a turn about x, where the formula has length zero
    return torch.where(z[:, None] > -0.9999, quats, downwards).contiguous()
