"""Corrections of camera poses that are trained together with the scene (as BARF, Lin et al. 2021, and others do)."""

import dataclasses
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from warpgs.cameras import Camera


class PoseCorrections(nn.Module):
    """Small rigid motions of the cameras of T frames, each in the axes of the camera; none at first.

    Args:
        places: [T] which of the P motions each frame's camera has, from 0 on; see ``shared_places``.
        unit: Length of a translation of 1 [scene units]: the size of what an image shows, so that rotations and
            translations of one size move the image by about as much.

    Attributes:
        unit: As given.
        rotations: [P, 3] axes times angles [rad], for small angles: a rotation r has the quaternion (1, r / 2),
            normalized.
        translations: [P, 3] in ``unit``.
        places: As given.
    """

    _cross: Tensor
    places: Tensor

    def __init__(self, places: Int64[Tensor, " T"], unit: float) -> None:
        super().__init__()
        num = int(places.max()) + 1
        self.rotations = nn.Parameter(torch.zeros(num, 3, dtype=torch.float32))
        self.translations = nn.Parameter(torch.zeros(num, 3, dtype=torch.float32))
        self.unit = unit
        self.register_buffer("places", places)
        axes = torch.zeros(3, 3, 3, dtype=torch.float32)
        axes[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = 1.0
        self.register_buffer("_cross", axes - axes.mT, persistent=False)

    def forward(self, viewmat: Float[Tensor, "4 4"], index: Int64[Tensor, "1"]) -> Float[Tensor, "4 4"]:
        """The corrected world-to-camera transform of the camera of a frame.

        With u = r / 2 and U v = u × v, the quaternion (1, u) / |(1, u)| rotates by I + 2 / (1 + |u|²) (U + U²).
        """
        place = self.places.index_select(0, index)
        half = 0.5 * self.rotations.index_select(0, place)[0]
        translation = self.unit * self.translations.index_select(0, place)
        cross = (half[:, None, None] * self._cross).sum(0)
        rotation = 2.0 / (1.0 + half.square().sum()) * (cross + cross @ cross)
        motion = torch.cat([rotation, translation.T], 1)
        return viewmat + torch.cat([motion @ viewmat, torch.zeros_like(viewmat[:1])])

    def moved(self, camera: Camera, index: Int64[Tensor, "1"]) -> Camera:
        """A camera with its correction."""
        return dataclasses.replace(camera, viewmat=self(camera.viewmat, index))

    def angles(self) -> Float[Tensor, " P"]:
        """Angle of each motion [rad]."""
        return 2.0 * (0.5 * self.rotations.detach().norm(dim=1)).atan()

    def shifts(self) -> Float[Tensor, " P"]:
        """Distance of each motion, in ``unit``."""
        return self.translations.detach().norm(dim=1)


def shared_places(cameras: Sequence[Camera]) -> Int64[Tensor, " T"]:
    """A number for each camera, from 0 on, which those have in common that are at the same place.

    A camera that stands still has one error in all its frames. Were it corrected in each of them, the corrections would
    follow what moves.
    """
    found: dict[bytes, int] = {}
    keys = (b"".join(t.numpy().tobytes() for t in (c.viewmat, c.motion) if t is not None) for c in cameras)
    return torch.tensor([found.setdefault(key, len(found)) for key in keys])
