"""Distortion: where a camera that is no pinhole puts a point. Formulas: kernels/lens_*.py."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from .runtime.checks import as_number, check_image_size, check_tensor, one_line_repr

Coefficients = Sequence[float] | Shaped[Tensor, "..."] | Shaped[np.ndarray, "..."]
"""Coefficients of a lens, also as OpenCV returns them: [1, C] or [C, 1]."""

NUM_COEFFICIENTS = {"radial": 12, "fisheye": 4, "equirectangular": 0}

MARGIN = 1.3
"""How far beyond the image's corners a radial lens follows its formula, relative to their distance from the axis, and a
fisheye lens sees, relative to their angle, but at least to 90 degrees as a pinhole does: splats behind the camera are
smeared over the image, because their ellipse does not follow the circle around the direction right behind."""

RADIAL_TERMS = torch.tensor([1.0, 1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0, *[0.0] * 4])
"""Which coefficients of a radial lens act along the radius."""

MAX_ZOOM_OUT = 8.0
"""How much farther from the axis than a pinhole camera a radial lens may see [ratio of radii on the plane z = 1]."""

MAX_ANGLE = math.radians(178.0)
"""Maximum angle from the axis that a fisheye lens sees [radians]; the direction right behind it has no place."""

NUM_SAMPLES = 4_096
"""Radii or angles at which a lens is tested for folding back."""

TINY = 1e-12
"""Least distance from the axis that something is divided by: on the axis 0 / 0 is then 0."""

NUM_HALVINGS = 24
"""Steps of the bisection that inverts a lens along its radius."""

NUM_NEWTON_STEPS = 5
"""Steps from there that invert the tangential and prism terms, too."""

MAX_RESIDUAL = 1e-5
"""Distance from a position up to which a ray is bent to it [focal lengths]."""

NUM_BORDER_POINTS = 64
"""Points of each side of the image at which a radial lens is inverted to test it."""


@dataclass(frozen=True)
class Distortion:
    """The distortion of a camera's lens.

    Attributes:
        lens: "radial": OpenCV's coefficients k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4; "fisheye": those of
            cv2.fisheye, k1 to k4; or "equirectangular", without any. Formulas: kernels/lens_*.py.
        coefficients: [12], [4] or [0].
        limit: How far from the axis the formula holds: the radius on the plane z = 1 beyond which a radial lens
            continues linearly, or the angle beyond which other lenses see nothing [radians].
        circle: Angle at which the circular image of a fisheye ends; pixels beyond it show nothing [radians]. Gaussians
            are rendered up to ``limit`` all the same, because they reach into the circle.

    Raises:
        ValueError: On an unknown lens, a wrong shape or dtype, a limit that is not positive and finite, or for a
            fisheye above 178 degrees, or a circle that is not positive.
    """

    lens: Literal["radial", "fisheye", "equirectangular"]
    coefficients: Float[Tensor, " C"]
    limit: float
    circle: float = math.inf

    def __post_init__(self) -> None:
        if self.lens not in NUM_COEFFICIENTS:
            raise ValueError(f"lens must be one of {', '.join(NUM_COEFFICIENTS)}, got {one_line_repr(self.lens)}")
        check_tensor("coefficients", self.coefficients, (NUM_COEFFICIENTS[self.lens],), {})
        limit = as_number("limit", self.limit)
        if not 0.0 < limit < math.inf or (self.lens == "fisheye" and limit > MAX_ANGLE):
            raise ValueError(f"limit must be positive and finite, of a fisheye at most {MAX_ANGLE:.4g}, got {limit}")
        if not (circle := as_number("circle", self.circle)) > 0.0:
            raise ValueError(f"circle must be positive, got {circle}")
        object.__setattr__(self, "limit", limit)
        object.__setattr__(self, "circle", circle)

    @staticmethod
    def radial(coefficients: Coefficients, K: Float[Tensor, "3 3"], size: tuple[int, int]) -> "Distortion":
        """The distortion of a lens with OpenCV's coefficients, on the device of K.

        Args:
            coefficients: Up to 12, in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4; a tensor keeps
                its gradient.
            K: [3, 3] intrinsics [px].
            size: (width, height) of the image [px].

        Raises:
            ValueError: If a coefficient is not finite, there are too many, K or the size is wrong, or the lens folds
                back inside the image.
        """
        k = _tensor("radial", coefficients, K)
        reach = _distances(K, size).norm(dim=0).item()
        radii = torch.linspace(0.0, MAX_ZOOM_OUT * reach, NUM_SAMPLES, dtype=torch.float64)
        along = torch.stack([radii, torch.zeros_like(radii)], 1)
        ideal = k.detach().double().cpu() * RADIAL_TERMS
        at_corner, turns = _checked_profile(radii, _radial(along, ideal)[:, 0], reach, k, reach)
        lens = Distortion("radial", k, min(MARGIN * at_corner, turns))
        border = _border(K, size)
        if not bool((has_ray := lens.rays(border).isfinite().all(1)).all()):
            x, y = (border[~has_ray][0] * K.diagonal()[:2] + K[:2, 2]).tolist()
            raise ValueError(
                f"the lens folds back inside the image: it bends nothing to ({x:.0f}, {y:.0f}) px on the border; its "
                f"coefficients are {_text(k)}"
            )
        return lens

    @staticmethod
    def fisheye(coefficients: Coefficients, K: Float[Tensor, "3 3"], size: tuple[int, int]) -> "Distortion":
        """The distortion of a fisheye lens with up to 4 coefficients of cv2.fisheye; arguments as for ``radial``."""
        k = _tensor("fisheye", coefficients, K)
        distances = _distances(K, size)
        theta = torch.linspace(0.0, MAX_ANGLE, NUM_SAMPLES, dtype=torch.float64)
        bent = _bent_angle(theta, k.detach().double().cpu())
        # A circular image leaves the corners black; it ends where the lens turns, if that is before the corner.
        at_corner, turns = _checked_profile(theta, bent, distances.norm().item(), k, distances.min().item())
        circle = turns if at_corner == turns else math.inf
        return Distortion("fisheye", k, min(max(MARGIN * at_corner, math.pi / 2), turns), circle)

    @staticmethod
    def equirectangular() -> "Distortion":
        """A panorama's: the middle of the image is forward, and columns are longitudes, rows latitudes, as in OpenSfM.

        Focal lengths are pixels per radian: of a full image (width / 2π, height / π), with the principal point in its
        middle. What is at the left and right border of 360 degrees is composited at both.
        """
        return Distortion("equirectangular", torch.zeros(0, dtype=torch.float32), math.pi)

    def to(self, device: torch.device | str) -> "Distortion":
        """A copy on another device."""
        return dataclasses.replace(self, coefficients=self.coefficients.to(device))

    @property
    def measures_distance(self) -> bool:
        """Whether depth is the distance from the camera, because the lens may see behind it, instead of z."""
        return self.lens != "radial"

    def sees(self, viewed: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
        """Whether points in camera space are where the formula of the lens holds, and inside its circle."""
        if self.measures_distance:
            return torch.atan2(viewed[:, :2].norm(dim=1), viewed[:, 2]) <= min(self.limit, self.circle)
        return (viewed[:, 2] > 0.0) & (viewed[:, :2].norm(dim=1) < self.limit * viewed[:, 2])

    def shows(self, bent: Float[Tensor, "P 2"]) -> Bool[Tensor, " P"]:
        """Whether positions [focal lengths] are inside the circular image; all are, if that is not known."""
        return bent.norm(dim=1) <= _bent_angle(bent.new_full((1,), self.circle), self.coefficients.to(bent))

    def bend(self, viewed: Float[Tensor, "P 3"]) -> Float[Tensor, "P 2"]:
        """[P, 2] where the lens puts points in camera space, from the principal point [focal lengths]."""
        if self.lens == "fisheye":
            rho = viewed[:, :2].norm(dim=1).clamp_min(TINY)
            bent = _bent_angle(torch.atan2(rho, viewed[:, 2]), self.coefficients.to(viewed))
            return viewed[:, :2] * (bent / rho)[:, None]
        if self.lens == "equirectangular":
            x, y, z = viewed.unbind(1)
            return torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], 1)
        return _radial(viewed[:, :2] / viewed[:, 2:], self.coefficients.to(viewed))

    @torch.no_grad()
    def rays(self, bent: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
        """[P, 3] rays that the lens bends to positions [focal lengths], NaN where it bends none that it sees.

        They have z = 1, or, where depth is distance, are unit vectors. Computed in double precision, without gradients.
        """
        k, position = self.coefficients.to(bent).double(), bent.double()
        if self.lens == "fisheye":
            radius = position.norm(dim=1)
            theta = _inverse(lambda theta: _bent_angle(theta, k), radius, self.limit)
            across = position * (theta.sin() / radius.clamp_min(TINY))[:, None]
            rays = torch.cat([across, theta.cos()[:, None]], 1)
            is_found = ((_bent_angle(theta, k) - radius).abs() < MAX_RESIDUAL) & (theta <= self.circle)
        elif self.lens == "equirectangular":
            (sin_lon, sin_lat), (cos_lon, cos_lat) = position.sin().unbind(1), position.cos().unbind(1)
            rays = torch.stack([cos_lat * sin_lon, sin_lat, cos_lat * cos_lon], 1)
            is_found = (position.abs() < position.new_tensor([math.pi, math.pi / 2]) + MAX_RESIDUAL).all(1)
        else:
            slopes = _inverse_radial(position, k, self.limit)
            rays = torch.cat([slopes, torch.ones_like(slopes[:, :1])], 1)
            is_found = (_radial(slopes, k) - position).norm(dim=1) < MAX_RESIDUAL
            is_found &= slopes.norm(dim=1) < (1.0 + MAX_RESIDUAL) * self.limit
        return torch.where(is_found[:, None], rays, math.nan).to(bent)


def _tensor(lens: str, coefficients: Coefficients, K: Float[Tensor, "3 3"]) -> Float[Tensor, " C"]:
    """Coefficients with zeros for missing ones, on the device of K."""
    check_tensor("K", K, (3, 3), {})
    num, k = NUM_COEFFICIENTS[lens], torch.as_tensor(coefficients, dtype=torch.float32, device=K.device).flatten()
    if len(k) > num or not bool(k.isfinite().all()):
        raise ValueError(f"a {lens} lens has at most {num} finite coefficients here, got {k.tolist()}")
    return torch.nn.functional.pad(k, (0, num - len(k)))


def _text(k: Float[Tensor, " C"]) -> str:
    return ", ".join(f"{value:g}" for value in k.tolist())


def _distances(K: Float[Tensor, "3 3"], size: tuple[int, int]) -> Float[Tensor, "2"]:
    """[2] distances of the principal point to the farther vertical and horizontal border [focal lengths]."""
    check_image_size(*size)
    center, focal = K[:2, 2].detach().cpu(), K.diagonal()[:2].detach().cpu()
    return torch.maximum(center, torch.tensor(size) - center) / focal


def _border(K: Float[Tensor, "3 3"], size: tuple[int, int]) -> Float[Tensor, "B 2"]:
    """[B, 2] points on the border of the image, from the principal point [focal lengths]."""
    along = torch.linspace(0.0, 1.0, NUM_BORDER_POINTS)
    low, high = torch.zeros_like(along), torch.ones_like(along)
    sides = [torch.stack(side, 1) for side in ((along, low), (along, high), (low, along), (high, along))]
    return (torch.cat(sides).to(K.device) * torch.tensor(size, device=K.device) - K[:2, 2]) / K.diagonal()[:2]


def _checked_profile(
    ideal: Float[Tensor, " S"], bent: Float[Tensor, " S"], corner: float, k: Float[Tensor, " C"], reach: float
) -> tuple[float, float]:
    """Where a lens reaches the corner of the image, and where it turns, or else the last of the samples.

    Args:
        ideal: [S] increasing radii or angles.
        bent: [S] how far from the axis the lens puts them [focal lengths].
        corner: Distance of the image's farthest corner from the axis [focal lengths].
        k: Its coefficients, for the message.
        reach: Distance of the border that it has to reach [focal lengths].

    Raises:
        ValueError: If the lens turns before it reaches the border.
    """
    num_rising = int((bent.diff() > 0.0).long().cumprod(0).sum())
    if num_rising < len(ideal) - 1 and bent[num_rising] < reach:
        raise ValueError(
            f"the lens folds back inside the image: it bends nothing farther than {bent[num_rising]:.3g} focal lengths "
            f"from the axis, and the border is at {reach:.3g}; its coefficients are {_text(k)}"
        )
    return float(ideal[int((bent[: num_rising + 1] < corner).sum().clamp(max=num_rising))]), float(ideal[num_rising])


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


def _inverse(function: Callable[[Tensor], Tensor], values: Float[Tensor, " P"], limit: float) -> Float[Tensor, " P"]:
    """Where in [0, limit] a function that rises there has each value, or is closest to it, by bisection."""
    low, high = torch.zeros_like(values), torch.full_like(values, limit)
    for _ in range(NUM_HALVINGS):
        middle = 0.5 * (low + high)
        is_below = function(middle) < values
        low, high = torch.where(is_below, middle, low), torch.where(is_below, high, middle)
    return 0.5 * (low + high)


def _inverse_radial(position: Float[Tensor, "P 2"], k: Float[Tensor, "12"], limit: float) -> Float[Tensor, "P 2"]:
    """Slopes that a radial lens bends to positions, by bisection of its radial terms and then by Newton's method.

    The usual fixed point x + (bent - f(x)) diverges where the lens magnifies, f' > 2, and hardly moves near its limit.
    """
    profile, radius = k * RADIAL_TERMS.to(k), position.norm(dim=1)
    along_x = _inverse(lambda r: _radial(torch.stack([r, torch.zeros_like(r)], 1), profile)[:, 0], radius, limit)
    slopes = position * (along_x / radius.clamp_min(TINY))[:, None]
    for _ in range(NUM_NEWTON_STEPS):
        with torch.enable_grad():
            residuals = _radial(slopes.requires_grad_(), k) - position
            rows = [torch.autograd.grad(part.sum(), slopes, retain_graph=True)[0] for part in residuals.unbind(1)]
        (xx, xy), (yx, yy) = (row.unbind(1) for row in rows)
        x, y = residuals.detach().unbind(1)
        slopes = slopes.detach() - torch.stack([yy * x - xy * y, xx * y - yx * x], 1) / (xx * yy - xy * yx)[:, None]
    return slopes
