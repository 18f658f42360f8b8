"""Distortion: where a camera that is no pinhole puts a point. Formulas: kernels/lens_radial.py, lens_fisheye.py."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

NUM_RADIAL, NUM_FISHEYE = 12, 4

MARGIN = 1.3
"""How far beyond the image's corners a radial lens follows its formula, relative to their distance from the axis."""

MAX_ZOOM_OUT = 8.0
"""How much farther from the axis than a pinhole camera a radial lens may see [ratio of radii on the plane z = 1]."""

MAX_ANGLE = math.radians(178.0)
"""Maximum angle from the axis that a fisheye lens sees [radians]; the direction right behind it has no place."""

NUM_SAMPLES = 4_096
"""Radii or angles at which a lens is tested for folding back."""

NUM_STEPS = 40
"""Steps that invert a lens; real lenses converge to 1e-6 in ten."""


@dataclass(frozen=True)
class Distortion:
    """The distortion of a camera's lens.

    Attributes:
        lens: "radial": OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4; or "fisheye": those of
            cv2.fisheye, k1 to k4. Formulas: kernels/lens_radial.py, kernels/lens_fisheye.py.
        coefficients: [12] or [4].
        limit: How far from the axis the formula holds: the radius on the plane z = 1 beyond which a radial lens
            continues linearly, or the angle beyond which a fisheye lens sees nothing [radians].
    """

    lens: Literal["radial", "fisheye"]
    coefficients: Float[Tensor, " C"]
    limit: float

    @staticmethod
    def radial(coefficients: Sequence[float], K: Float[Tensor, "3 3"], size: tuple[int, int]) -> "Distortion":
        """The distortion of a lens with OpenCV's coefficients, on the device of K.

        Args:
            coefficients: Up to 12, in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4.
            K: [3, 3] intrinsics [px].
            size: (width, height) of the image [px].

        Raises:
            ValueError: If a coefficient is not finite, there are too many, or the lens folds back inside the image.
        """
        k = _tensor(coefficients, NUM_RADIAL, K.device)
        reach = _distances(K, size).norm(dim=0).item()
        radii = torch.linspace(0.0, MAX_ZOOM_OUT * reach, NUM_SAMPLES, dtype=torch.float64)
        along = torch.stack([radii, torch.zeros_like(radii)], 1)
        is_radial = torch.tensor([1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, *[0.0] * 4])
        ideal = k.double().cpu() * is_radial
        at_corner, turns = _checked_profile(radii, _radial(along, ideal)[:, 0], reach, k)
        return Distortion("radial", k, min(MARGIN * at_corner, turns))

    @staticmethod
    def fisheye(coefficients: Sequence[float], K: Float[Tensor, "3 3"], size: tuple[int, int]) -> "Distortion":
        """The distortion of a fisheye lens with up to 4 coefficients of cv2.fisheye; arguments as for ``radial``."""
        k = _tensor(coefficients, NUM_FISHEYE, K.device)
        reach = _distances(K, size).min().item()  # a circular image leaves the corners black
        theta = torch.linspace(0.0, MAX_ANGLE, NUM_SAMPLES, dtype=torch.float64)
        _, turns = _checked_profile(theta, _bent_angle(theta, k.double().cpu()), reach, k)
        return Distortion("fisheye", k, turns)

    def to(self, device: torch.device | str) -> "Distortion":
        """A copy on another device."""
        return dataclasses.replace(self, coefficients=self.coefficients.to(device))

    @property
    def measures_distance(self) -> bool:
        """Whether depth is the distance from the camera, because the lens may see behind it, instead of z."""
        return self.lens == "fisheye"

    def sees(self, viewed: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
        """Whether points in camera space are where the formula of the lens holds."""
        if self.lens == "fisheye":
            return torch.atan2(viewed[:, :2].norm(dim=1), viewed[:, 2]) < self.limit
        return (viewed[:, 2] > 0.0) & (viewed[:, :2].norm(dim=1) < self.limit * viewed[:, 2])

    def bend(self, viewed: Float[Tensor, "P 3"]) -> Float[Tensor, "P 2"]:
        """[P, 2] where the lens puts points in camera space, from the principal point [focal lengths]."""
        if self.lens == "fisheye":
            rho = viewed[:, :2].norm(dim=1).clamp_min(1e-12)
            bent = _bent_angle(torch.atan2(rho, viewed[:, 2]), self.coefficients.to(viewed))
            return viewed[:, :2] * (bent / rho)[:, None]
        return _radial(viewed[:, :2] / viewed[:, 2:], self.coefficients.to(viewed))

    def rays(self, bent: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
        """[P, 3] rays that the lens bends to positions [focal lengths]: of z = 1, or of a fisheye lens unit vectors."""
        k = self.coefficients.to(bent)
        if self.lens == "fisheye":
            radius = bent.norm(dim=1)
            theta = _inverse_angle(radius, k, self.limit)
            across = bent * (theta.sin() / radius.clamp_min(1e-12))[:, None]
            return torch.cat([across, theta.cos()[:, None]], 1)
        slopes = bent
        for _ in range(NUM_STEPS):
            slopes = slopes + (bent - _radial(slopes, k))
        return torch.cat([slopes, torch.ones_like(slopes[:, :1])], 1)


def _tensor(coefficients: Sequence[float], num: int, device: torch.device) -> Float[Tensor, " C"]:
    """Coefficients with zeros for missing ones."""
    values = [float(value) for value in coefficients]
    if len(values) > num or not all(map(math.isfinite, values)):
        raise ValueError(f"a lens has at most {num} finite coefficients here, got {values}")
    return torch.tensor(values + [0.0] * (num - len(values)), dtype=torch.float32, device=device)


def _distances(K: Float[Tensor, "3 3"], size: tuple[int, int]) -> Float[Tensor, "2"]:
    """[2] distances of the principal point to the farther vertical and horizontal border [focal lengths]."""
    center, focal = K[:2, 2].cpu(), K.diagonal()[:2].cpu()
    return torch.maximum(center, torch.tensor(size) - center) / focal


def _checked_profile(
    ideal: Float[Tensor, " S"], bent: Float[Tensor, " S"], reach: float, k: Float[Tensor, " C"]
) -> tuple[float, float]:
    """Where a lens reaches the border of the image, and where it turns, or else the last of the samples.

    Args:
        ideal: [S] increasing radii or angles.
        bent: [S] how far from the axis the lens puts them [focal lengths].
        reach: Distance of the image's border from the axis [focal lengths].
        k: Its coefficients, for the message.

    Raises:
        ValueError: If the lens turns before it reaches the border.
    """
    num_rising = int((bent.diff() > 0.0).long().cumprod(0).sum())
    if num_rising < len(ideal) - 1 and bent[num_rising] < reach:
        values = ", ".join(f"{value:g}" for value in k.tolist())
        raise ValueError(
            f"the lens folds back inside the image: it bends nothing farther than {bent[num_rising]:.3g} focal lengths "
            f"from the axis, and the border is at {reach:.3g}; its coefficients are {values}"
        )
    return float(ideal[int((bent[: num_rising + 1] < reach).sum().clamp(max=num_rising))]), float(ideal[num_rising])


def _radial(slopes: Float[Tensor, "P 2"], k: Float[Tensor, "12"]) -> Float[Tensor, "P 2"]:
    x, y = slopes.unbind(1)
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = k
    r2 = x * x + y * y
    d = (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    bent_x = x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2)
    bent_y = y * d + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + r2 * s4)
    return torch.stack([bent_x, bent_y], 1)


def _bent_angle(theta: Float[Tensor, " P"], k: Float[Tensor, "4"]) -> Float[Tensor, " P"]:
    s = theta * theta
    return theta * (1.0 + s * (k[0] + s * (k[1] + s * (k[2] + s * k[3]))))


def _inverse_angle(bent: Float[Tensor, " P"], k: Float[Tensor, "4"], limit: float) -> Float[Tensor, " P"]:
    """The angles up to a limit that the lens bends to positions, by bisection: it rises up to there."""
    low, high = torch.zeros_like(bent), torch.full_like(bent, limit)
    for _ in range(NUM_STEPS):
        middle = 0.5 * (low + high)
        is_below = _bent_angle(middle, k) < bent
        low, high = torch.where(is_below, middle, low), torch.where(is_below, high, middle)
    return 0.5 * (low + high)
