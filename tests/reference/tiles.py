"""Tile binning by brute force in plain torch, double precision."""

import torch
from torch import Tensor

from tests.reference.projection import Projection

ALPHA_MIN = 1 / 255
TILE_SIZE = 16


def max_alphas(splats: Projection, size: tuple[int, int], step: float) -> Tensor:
    """[N, tiles] maximum of alpha over a grid of points in the box of the pixel centres of each tile.

    Tiles are in row-major order; the points are ``step`` pixels apart and include the first pixel centre.
    """
    width, height = size
    mean, opacity = splats.means2d.double(), splats.opacities.double()[:, None, None]
    a, b, c = (entry[:, None, None] for entry in splats.conics.double().unbind(-1))
    maxima = []
    for top in range(0, height, TILE_SIZE):
        for left in range(0, width, TILE_SIZE):
            x = torch.arange(left + 0.5, min(left + TILE_SIZE, width), step, dtype=torch.float64)
            y = torch.arange(top + 0.5, min(top + TILE_SIZE, height), step, dtype=torch.float64)
            dx, dy = mean[:, 0, None, None] - x, mean[:, 1, None, None] - y[:, None]
            alphas = opacity * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
            maxima.append(alphas.flatten(1).max(1).values)
    return torch.stack(maxima, 1) * (splats.radii[:, :1] > 0)
