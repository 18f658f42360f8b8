"""Colour of dynamic Gaussians from the light that they reflect.

    n = R (e + c) / |R (e + c)|,   r = d − 2 (d · n) n,   d = (mean − viewpoint) / |mean − viewpoint|

R is the rotation of a deformed Gaussian, e its shortest axis at rest, as in GaussianShader (Jiang et al. 2024) and
SpectroMotion (Fan et al. 2025), and c a learned correction of it. The normal n is turned towards the camera. Directions
are in world axes: what a Gaussian mirrors (r) and how it is lit (n) change as it turns, while its spherical harmonics
do not. The colour is added to theirs.
"""

import copy
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import normalize

CORRECTION = 3
"""The first numbers of a Gaussian's reflectance: the correction of its shortest axis, in its own axes."""

BANDS = 3
"""Number of frequencies in the encoding of the reflected direction."""

MATERIAL, WIDTH = 8, 64
"""Learned numbers per Gaussian that the network gets, and units of each of its two hidden layers."""


class Light(nn.Module):
    """The light around Gaussians: a network of r, n, d · n and their material (Ref-NeRF, Verbin et al. 2022).

    ``like`` is a tensor of the device and the type that its parameters get.

    Attributes:
        size: Learned numbers per Gaussian: the correction of its normal, and its material.
    """

    size = CORRECTION + MATERIAL

    def __init__(self, like: Tensor) -> None:
        super().__init__()
        sizes = (3 + 6 * BANDS + 3 + 1 + MATERIAL, WIDTH, WIDTH, 3)
        layers = [nn.Linear(a, b, device=like.device, dtype=like.dtype) for a, b in pairwise(sizes)]
        nn.init.zeros_(layers[-1].weight)
        nn.init.zeros_(layers[-1].bias)
        self.layers = nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])

    def forward(
        self, d: Float[Tensor, "D 3"], n: Float[Tensor, "D 3"], material: Float[Tensor, "D F"]
    ) -> Float[Tensor, "D 3"]:
        """Colours of Gaussians by the direction d of the ray to them and their normals n; 0 at first."""
        cosine = (d * n).sum(1, keepdim=True)
        return self.layers(torch.cat([_encoded(d - 2.0 * cosine * n), n, cosine, material], 1))


@dataclass(frozen=True)
class Reflections:
    """What D deformed Gaussians reflect, seen from anywhere.

    Attributes:
        light: The light around them.
        normals: [D, 3] of length 1, of either sign.
        material: [D, F] learned numbers that ``light`` gets.
    """

    light: Light
    normals: Float[Tensor, "D 3"]
    material: Float[Tensor, "D F"]

    def colors(self, means: Float[Tensor, "D 3"], viewmat: Float[Tensor, "4 4"]) -> Float[Tensor, "D 3"]:
        """What is added to their colours, seen from a camera."""
        viewpoint = -(viewmat[:3, :3] * viewmat[:3, 3:]).sum(0)
        d = normalize(means - viewpoint, dim=1)
        away = (d * self.normals).sum(1, keepdim=True) > 0.0
        return self.light(d, torch.where(away, -self.normals, self.normals), self.material)

    def to(self, device: torch.device | str) -> "Reflections":
        """A copy on another device."""
        light, tensors = copy.deepcopy(self.light).to(device), (self.normals.to(device), self.material.to(device))
        return Reflections(light, *tensors)


def reflections(
    light: Light, log_scales: Float[Tensor, "D 3"], quats: Float[Tensor, "D 4"], reflectances: Float[Tensor, "D F"]
) -> Reflections:
    """What Gaussians reflect.

    Args:
        light: The light around them.
        log_scales: [D, 3] sizes at rest.
        quats: [D, 4] deformed rotations of any length.
        reflectances: [D, light.size] learned correction of the shortest axis, and material.
    """
    axis = torch.arange(3, device=quats.device) == log_scales.detach().argmin(1, keepdim=True)
    v = axis.to(quats.dtype) + reflectances[:, :CORRECTION]
    unit = normalize(quats, dim=1)
    w, u = unit[:, :1], unit[:, 1:]
    rotated = v + 2.0 * torch.linalg.cross(u, torch.linalg.cross(u, v) + w * v)
    return Reflections(light, normalize(rotated, dim=1), reflectances[:, CORRECTION:])


def _encoded(x: Float[Tensor, "D 3"]) -> Float[Tensor, "D encoded"]:
    angles = torch.cat([x * 2.0**k for k in range(BANDS)], 1)
    return torch.cat([x, angles.sin(), angles.cos()], 1)
