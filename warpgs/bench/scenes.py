"""Scenes for measurements: several views of each. Random ones."""

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from warpgs.cameras import Camera, intrinsic_matrix
from warpgs.model.gaussians import SH_C0
from warpgs.model.splats import Splats
from warpgs.ops.sh import num_bases

Branches = Literal["none", "random", "disc"]

SEED = 0
SH_NOISE = 0.1
"""Standard deviation of the coefficients of spherical harmonics from degree 1 on."""

DISC_AREA = 0.2
"""Fraction of the image area that the disc of dynamic Gaussians covers."""


@dataclass(frozen=True)
class Views:
    """A scene from one or more cameras with images of one size.

    Attributes:
        name: Of the scene.
        splats: Of each camera: at its time.
        cameras: The cameras.
        antialias: Whether opacities compensate for the low-pass filter (Mip-Splatting).
    """

    name: str
    splats: list[Splats]
    cameras: list[Camera]
    antialias: bool = False


@dataclass(frozen=True)
class Scene:
    """Specification of a random scene.

    Attributes:
        name: Name on the command line.
        width, height: Size of the image [px].
        num_gaussians: Number of Gaussians; all project into the image.
        pixels: Twice the median standard deviation of a Gaussian on screen [px].
    """

    name: str
    width: int
    height: int
    num_gaussians: int
    pixels: float

    def make(self, branches: Branches, device: str, sh_degree: int | None = None) -> tuple[Splats, Camera]:
        """The splats and the camera; ``is_dynamic`` is set unless ``branches`` is none."""
        splats, camera = random_splats(self.num_gaussians, self.width, self.height, self.pixels, SEED)
        if sh_degree is not None:
            splats = with_harmonics(splats, sh_degree)
        if branches == "random":
            coins = torch.rand(
                self.num_gaussians, dtype=torch.float32, generator=torch.Generator().manual_seed(SEED + 1)
            )
            splats = dataclasses.replace(splats, is_dynamic=coins < 0.5)
        if branches == "disc":
            splats = dataclasses.replace(splats, is_dynamic=in_disc(splats.means, camera))
        return splats.to(device), camera.to(device)

    def views(self, branches: Branches, device: str, sh_degree: int | None = None) -> Views:
        """As of ``make``."""
        splats, camera = self.make(branches, device, sh_degree)
        return Views(self.name, [splats], [camera])


SCENES = {
    scene.name: scene
    for scene in (
        Scene("small", 480, 270, 100_000, 3.0),
        Scene("large", 1920, 1080, 1_000_000, 4.0),
        Scene("wide", 1920, 1080, 200_000, 20.0),
    )
}


def random_splats(N: int, width: int, height: int, pixels: float, seed: int) -> tuple[Splats, Camera]:
    """Gaussians spread evenly over an image and over depths of 2 to 10, with random shapes, opacities and colours.

    A seed gives the same scene on every machine: all values are sampled on the CPU, in a fixed order.

    Args:
        N: Number of Gaussians.
        width, height: Size of the image [px].
        pixels: Twice the median standard deviation of a Gaussian on screen [px].
        seed: Seed of torch's CPU generator.

    Returns:
        Splats with three colour channels, and a camera at the origin that looks along +z, with a focal length of 0.9
        image widths.
    """
    generator = torch.Generator().manual_seed(seed)
    focal = 0.9 * width
    z = torch.rand(N, dtype=torch.float32, generator=generator) * 8 + 2
    u = torch.rand(N, dtype=torch.float32, generator=generator) * width
    v = torch.rand(N, dtype=torch.float32, generator=generator) * height
    means = torch.stack([(u - width / 2) * z / focal, (v - height / 2) * z / focal, z], -1)
    quats = torch.randn(N, 4, dtype=torch.float32, generator=generator)
    scales = (
        torch.exp(torch.randn(N, 3, dtype=torch.float32, generator=generator) * 0.8)
        * (pixels * 0.5)
        * z[:, None]
        / focal
    )
    opacities = torch.sigmoid(torch.randn(N, dtype=torch.float32, generator=generator) * 1.5)
    colors = torch.rand(N, 3, dtype=torch.float32, generator=generator)
    K = torch.tensor(intrinsic_matrix((focal, focal), (width / 2, height / 2)), dtype=torch.float32)
    return Splats(means, quats, scales, opacities, colors), Camera(torch.eye(4, dtype=torch.float32), K, width, height)


def with_harmonics(splats: Splats, degree: int) -> Splats:
    """The splats with spherical harmonics of a degree whose mean over all directions is their colour."""
    assert splats.colors is not None
    generator = torch.Generator().manual_seed(SEED + 2)
    sh = SH_NOISE * torch.randn(len(splats.means), num_bases(degree), 3, dtype=torch.float32, generator=generator)
    sh[:, 0] = (splats.colors - 0.5) / SH_C0
    return dataclasses.replace(splats, colors=None, sh=sh)


def in_disc(means: Tensor, camera: Camera) -> Tensor:
    """[N] whether means in camera space project into a disc around the image center that covers ``DISC_AREA`` of it."""
    center = torch.tensor([camera.width / 2, camera.height / 2], dtype=torch.float32)
    homogeneous = means @ camera.K.T
    means2d = homogeneous[:, :2] / homogeneous[:, 2:]
    return (means2d - center).square().sum(-1) < DISC_AREA * camera.width * camera.height / math.pi
