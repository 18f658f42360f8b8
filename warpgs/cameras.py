"""Pinhole cameras."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from .runtime.checks import check_image_size, check_same_device, check_tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera at one moment.

    Attributes:
        viewmat: [4, 4] rigid world-to-camera transform, OpenCV axes (x right, y down, z forward).
        K: [3, 3] intrinsics [px], pixel centres at +0.5, principal point anywhere, no skew.
        width, height: Size of the image [px].
        time: Moment in [0, 1].
    """

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int
    time: float = 0.0

    def __post_init__(self) -> None:
        check_tensor("viewmat", self.viewmat, (4, 4), {})
        check_tensor("K", self.K, (3, 3), {})
        check_same_device({"viewmat": self.viewmat, "K": self.K})
        check_image_size(self.width, self.height)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    def to(self, device: torch.device | str) -> "Camera":
        return dataclasses.replace(self, viewmat=self.viewmat.to(device), K=self.K.to(device))

    @property
    def position(self) -> Float[Tensor, "3"]:
        """Centre of the camera in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def project(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Int64[Tensor, " P"], Int64[Tensor, " P"], Float[Tensor, " P"], Bool[Tensor, " P"]]:
        """Row and column of the pixel that each point falls on, its depth, and whether the camera sees that place.

        Rows and columns of points outside are clamped into the image.
        """
        viewed = points @ self.viewmat[:3, :3].T + self.viewmat[:3, 3]
        depth = viewed[:, 2]
        pixels = (viewed @ self.K.T)[:, :2] / depth[:, None].clamp_min(1e-6)
        x, y = pixels.floor().unbind(1)
        inside = (depth > 1e-6) & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return y.clamp(0, self.height - 1).long(), x.clamp(0, self.width - 1).long(), depth, inside

    def unproject(
        self, row: Int64[Tensor, " P"], column: Int64[Tensor, " P"], depth: Float[Tensor, " P"]
    ) -> Float[Tensor, "P 3"]:
        """Points in the world at a depth behind the centres of pixels."""
        pixels = torch.stack([column + 0.5, row + 0.5, torch.ones_like(depth)], 1)
        viewed = (pixels @ torch.linalg.inv(self.K).T) * depth[:, None]
        return (viewed - self.viewmat[:3, 3]) @ self.viewmat[:3, :3]

    @staticmethod
    def looking_at(
        position: Float[Tensor, "3"],
        target: Float[Tensor, "3"],
        up: Float[Tensor, "3"],
        focal: float,
        size: tuple[int, int],
        time: float = 0.0,
    ) -> "Camera":
        """A camera at ``position`` that sees ``target`` in the middle of an image of ``size`` (width, height).

        ``up`` points up in the world; ``focal`` is the focal length [px].

        Raises:
            ValueError: If the camera would look nowhere, or along ``up``.
        """
        forward = torch.nn.functional.normalize(target - position, dim=0)
        sideways = torch.linalg.cross(forward, up)
        if not sideways.norm() > 1e-6 * up.norm():
            raise ValueError(
                f"a camera at {position.tolist()} cannot look at {target.tolist()} with {up.tolist()} up: "
                "there must be a way to go, and not along up"
            )
        right = torch.nn.functional.normalize(sideways, dim=0)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat = torch.eye(4, device=position.device)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ position
        width, height = size
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], device=position.device)
        return Camera(viewmat, K, width, height, time)
