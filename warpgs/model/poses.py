"""Corrections of camera poses that are trained together with the scene (as BARF, Lin et al. 2021, and others do)."""

import dataclasses

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from warpgs.cameras import Camera


class PoseCorrections(nn.Module):
    """A small rigid motion for each of T cameras, in the axes of the camera; none at first.

    Args:
        num: T.
        unit: Length of a translation of 1 [scene units]: the size of what an image shows, so that rotations and
            translations of one size move the image by about as much.

    Attributes:
        unit: As given.
        rotations: [T, 3] axes times angles [rad], for small angles: a rotation r has the quaternion (1, r / 2),
            normalized.
        translations: [T, 3] in ``unit``.
    """

    _cross: Tensor

    def __init__(self, num: int, unit: float) -> None:
        super().__init__()
        self.rotations = nn.Parameter(torch.zeros(num, 3, dtype=torch.float32))
        self.translations = nn.Parameter(torch.zeros(num, 3, dtype=torch.float32))
        self.unit = unit
        axes = torch.zeros(3, 3, 3, dtype=torch.float32)
        axes[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0
        self.register_buffer("_cross", axes - axes.mT, persistent=False)

    def forward(self, viewmat: Float[Tensor, "4 4"], index: Int64[Tensor, "1"]) -> Float[Tensor, "4 4"]:
        """The corrected world-to-camera transform of a camera.

        With u = r / 2 and U v = u × v, the quaternion (1, u) / |(1, u)| rotates by I + 2 / (1 + |u|²) (U + U²).
        """
        half = 0.5 * self.rotations.index_select(0, index)[0]
        translation = self.unit * self.translations.index_select(0, index)
        cross = (half[:, None, None] * self._cross).sum(0)
        rotation = 2.0 / (1.0 + half.square().sum()) * (cross + cross @ cross)
        motion = torch.cat([rotation, translation.T], 1)
        return viewmat + torch.cat([motion @ viewmat, torch.zeros_like(viewmat[:1])])

    def moved(self, camera: Camera, index: Int64[Tensor, "1"]) -> Camera:
        """A camera with its correction."""
        return dataclasses.replace(camera, viewmat=self(camera.viewmat, index))

    def angles(self) -> Float[Tensor, " T"]:
        """Angle by which each camera is turned [rad]."""
        return 2.0 * (0.5 * self.rotations.detach().norm(dim=1)).atan()

    def shifts(self) -> Float[Tensor, " T"]:
        """Distance by which each camera is shifted, in ``unit``."""
        return self.translations.detach().norm(dim=1)
