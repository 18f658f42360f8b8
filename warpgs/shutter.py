"""Rolling shutters: a camera in motion while its rows are read. Formulas: kernels/shutter.py."""

import torch
from jaxtyping import Float
from torch import Tensor

MAX_READOUT = 1.0
"""How far from the middle row motion is extrapolated, as in kernels/shutter.py [readouts]; the image ends at 0.5."""


def at_row(viewed: Float[Tensor, "P 3"], motion: Float[Tensor, "2 3"], s: Float[Tensor, " P"]) -> Float[Tensor, "P 3"]:
    """[P, 3] points in the axes of a camera at rows of its image.

    Args:
        viewed: [P, 3] the points in its axes at the middle row.
        motion: [2, 3] rotation vector [radians] and translation of the camera while all rows are read.
        s: [P] share of the readout since the middle row, y / height - 0.5.
    """
    turn, move = motion.to(viewed)
    return _turned(viewed - s[:, None] * move, -s[:, None] * turn)


def at_middle_row(
    viewed: Float[Tensor, "P 3"], motion: Float[Tensor, "2 3"], s: Float[Tensor, " P"]
) -> Float[Tensor, "P 3"]:
    """The inverse of ``at_row``."""
    turn, move = motion.to(viewed)
    return _turned(viewed, s[:, None] * turn) + s[:, None] * move


def _turned(points: Float[Tensor, "P 3"], turns: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Points turned by rotation vectors, by the formula of Rodrigues."""
    angle = turns.norm(dim=1, keepdim=True) / torch.pi
    once = torch.linalg.cross(turns, points)
    return points + torch.sinc(angle) * once + 0.5 * torch.sinc(0.5 * angle) ** 2 * torch.linalg.cross(turns, once)
