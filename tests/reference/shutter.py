"""A rolling shutter in plain torch: matrix exponentials and derivatives of the point by the time of its row."""

import torch
from torch import Tensor

from tests.reference import lenses
from warpgs.ops.projection import View


def cross_matrix(a: Tensor) -> Tensor:
    """[N, 3, 3] matrices of a × for [N, 3] vectors."""
    x, y, z = a.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)


def at_row(t: Tensor, view: View, s: Tensor) -> Tensor:
    """[N, 3] points in the axes of the camera at s of the readout since the middle row."""
    return (rotation(view, s) @ (t - s[:, None] * view.motion[1])[..., None])[..., 0]


def rotation(view: View, s: Tensor) -> Tensor:
    """[N, 3, 3] from the axes of the camera at the middle row to those at s."""
    return torch.linalg.matrix_exp(cross_matrix(-s[:, None] * view.motion[0]))


def speed(t: Tensor, view: View, s: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """[N, 2] points of the image at s, [N, 2, 3] the Jacobian there, and [N, 2] derivatives of the points by s."""
    moved = at_row(t, view, s)
    point, jacobian = lenses.point_and_jacobian(moved, view)
    turn, move = view.motion
    velocity = -torch.linalg.cross(turn.expand_as(moved), moved) - (rotation(view, s) @ move)
    return point, jacobian, (jacobian @ velocity[..., None])[..., 0]


def point_and_jacobian(t: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor]:
    """[N, 2] points of the image, [N, 2, 3] how they change with t, and [N, 3] the points in the axes of their row."""
    middle, _, w = speed(t, view, torch.zeros_like(t[:, 0]))
    s = ((middle[:, 1] / view.height - 0.5) / (1 - w[:, 1] / view.height).clamp(min=0.25)).clamp(-1, 1)
    point, jacobian, w = speed(t, view, s)
    # y = (s + ½) height holds for every t: ds = (J dt)_y / (height - w_y), and the point moves by J dt + w ds.
    later = (jacobian[:, 1] / (view.height - w[:, 1]).clamp(min=0.25 * view.height)[:, None])[:, None, :]
    return point, (jacobian + w[..., None] * later) @ rotation(view, s), at_row(t, view, s)
