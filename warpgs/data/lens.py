"""Intrinsics of the cameras of files, in double precision: what ``Camera`` has in single precision.

u, v are measured from the corner of the image, as in Nerfies and COLMAP; OpenCV has pixel centres at integers.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float

from warpgs.cameras import Camera, intrinsic_matrix
from warpgs.distortion import Distortion
from warpgs.files import MAX_NUMBER

from .images import MAX_PIXELS, MAX_SIDE

DistortionModel = Literal["radial", "fisheye", "equirectangular"]

MIN_FOCAL = 1e-3
"""Minimum focal length [px]; the reciprocals of smaller ones overflow."""

MAX_SLOPE = math.tan(math.radians(85.0))
"""Maximum distance from the axis on the plane z = 1 of what a fisheye lens sees there; the plane ends at 90°."""

MAX_REACH = 1.001
"""How much farther than half of all directions a panorama may reach: sizes are rounded."""

PANORAMAS = ("EQUIRECT", "SPHER", "PANORAMA", "LATLONG", "OMNI", "VR180", "360")
"""Parts of the names that programs give to camera models of panoramas."""


def unsupported_model(model: object, remedy: str) -> str:
    """Message that a camera model is not read, and what to do: ``remedy``, unless it is one of panoramas."""
    if any(part in str(model).upper() for part in PANORAMAS):
        return (
            f"the camera model {model} is not supported: it is one of 360° images, which must be equirectangular "
            "(EQUIRECTANGULAR); convert them, or cut them into perspective views before their poses are estimated"
        )
    return f"the camera model {model} is not supported; {remedy}"


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera with distortion.

    Attributes:
        width, height: Size of the image [px].
        focal: (x, y) focal lengths [px].
        center: (x, y) principal point from the corner of the image [px].
        coefficients: Of its distortion, in OpenCV's order, as ``Distortion`` has them; zeros at their end are omitted.
        model: What they are of; the focal lengths of an equirectangular image are pixels per radian.
    """

    width: int
    height: int
    focal: tuple[float, float]
    center: tuple[float, float]
    coefficients: tuple[float, ...] = ()
    model: DistortionModel = "radial"

    def __post_init__(self) -> None:
        count = max((k + 1 for k, value in enumerate(self.coefficients) if value), default=0)
        object.__setattr__(self, "coefficients", tuple(self.coefficients[:count]))

    @staticmethod
    def of(camera: Camera) -> "Lens":
        """The lens of a camera."""
        (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
        plain, distortion = Lens(*camera.size, (fx, fy), (cx, cy)), camera.distortion
        if distortion is None:
            return plain
        return replace(plain, coefficients=tuple(distortion.coefficients.tolist()), model=distortion.lens)

    @staticmethod
    def centered(focal: float, size: tuple[int, int]) -> "Lens":
        """A pinhole lens with square pixels and its axis in the middle of images of (width, height) [px]."""
        return Lens(*size, (focal, focal), (size[0] / 2.0, size[1] / 2.0))

    @staticmethod
    def panorama(size: tuple[int, int]) -> "Lens":
        """The lens of equirectangular images of all directions, of (width, height) [px]."""
        width, height = size
        focal, center = (width / math.tau, height / math.pi), (width / 2, height / 2)
        return Lens(width, height, focal, center, model="equirectangular")

    def checked(self) -> "Lens":
        """This lens, if its numbers can be used; ``distortion`` also refuses lenses that fold back.

        Raises:
            ValueError: If a number is not finite or larger than ``files.MAX_NUMBER``, a focal length is below
                ``MIN_FOCAL``, or the size is out of range.
        """
        values = (*self.focal, *self.center, *self.coefficients)
        if not (np.abs(values) <= MAX_NUMBER).all() or min(self.focal) < MIN_FOCAL:
            raise ValueError(
                f"focal lengths must be at least {MIN_FOCAL} px and intrinsics finite and at most {MAX_NUMBER:g}, "
                f"got {values}"
            )
        if not 0 < min(self.width, self.height) <= max(self.width, self.height) <= MAX_SIDE:
            raise ValueError(f"image size {self.width}×{self.height}, expected 1 to {MAX_SIDE} pixels per side")
        if self.width * self.height > MAX_PIXELS:
            raise ValueError(f"image size {self.width}×{self.height}, expected at most {MAX_PIXELS:,} pixels together")
        return self

    def resized(self, width: int, height: int) -> "Lens":
        """The lens of images that were resized to another size."""
        x, y = width / self.width, height / self.height
        focal, center = (self.focal[0] * x, self.focal[1] * y), (self.center[0] * x, self.center[1] * y)
        return replace(self, width=width, height=height, focal=focal, center=center)

    @property
    def centered_pinhole(self) -> "Lens":
        """A pinhole lens of these focal lengths, with its axis in the middle; raises ValueError of a panorama."""
        if self.is_panorama:
            raise ValueError("a panorama has no pinhole: omit --no-distortion, which is part of the preset paper")
        return Lens(self.width, self.height, self.focal, (self.width / 2, self.height / 2))

    @property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion."""
        return self.model == "radial" and not self.coefficients

    @property
    def is_panorama(self) -> bool:
        """Whether images are equirectangular."""
        return self.model == "equirectangular"

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """[3, 3] K [px]."""
        return intrinsic_matrix(self.focal, self.center)

    @property
    def distortion(self) -> Distortion | None:
        """The distortion, None of a pinhole.

        Raises:
            ValueError: If the lens folds back inside the image, or a panorama has more than all directions.
        """
        return _distortion(self)

    def camera(self, rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, "3"], time: float = 0.0) -> Camera:
        """A camera of this lens: see ``Camera.posed``; raises as ``distortion``."""
        posed = Camera.posed(rotation, position, self.matrix, (self.width, self.height), time)
        return replace(posed, distortion=self.distortion)

    def image(self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]) -> Float[np.ndarray, "2 ..."]:
        """Projects points on the plane z = 1 to u, v [px from the corner]."""
        return self.project(np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)).T.reshape(2, *np.shape(x))

    def project(self, viewed: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 2"]:
        """[P, 2] where points in the camera are in the image [px from the corner], of a pinhole if in front of it.

        In the precision of the points, because OpenCV misreads flow in double precision, which starts from it.
        """
        if (distortion := self.distortion) is None:
            bent = viewed[:, :2] / viewed[:, 2:]
        else:
            bent = distortion.bend(torch.from_numpy(viewed)).numpy()
        focal, center = np.array([self.focal, self.center], bent.dtype)
        return bent * focal + center

    def file_depths(self, viewed: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
        """[P] depth of points in the camera as depth files have it: z, but of a panorama the distance."""
        return np.linalg.norm(viewed, axis=1) if self.is_panorama else viewed[:, 2]

    def rays(self, u: Float[np.ndarray, "*N"], v: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N 3"]:
        """[..., 3] points in the camera at depth 1, as of ``Camera.depths``, that it sees at u, v; NaN at none."""
        slopes = np.stack([(u - self.center[0]) / self.focal[0], (v - self.center[1]) / self.focal[1]], -1)
        if (distortion := self.distortion) is None:
            return np.concatenate([slopes, np.ones_like(slopes[..., :1])], -1)
        return distortion.rays(torch.from_numpy(slopes.reshape(-1, 2))).numpy().reshape(*slopes.shape[:-1], 3)

    def unproject(
        self, u: Float[np.ndarray, "*N"], v: Float[np.ndarray, "*N"]
    ) -> tuple[Float[np.ndarray, "*N"], Float[np.ndarray, "*N"]]:
        """x, y on the plane z = 1 that the lens sees at u, v: the inverse of ``image``, up to ``MAX_SLOPE``."""
        x, y, z = np.moveaxis(self.rays(u, v), -1, 0)
        if self.model == "radial":
            return x, y
        slopes = (u - self.center[0]) / self.focal[0], (v - self.center[1]) / self.focal[1]
        across = np.hypot(x, y)
        # Also where the lens sees nothing, so that there is a direction.
        radius = np.where(z > across / MAX_SLOPE, across / np.where(z > 0.0, z, 1.0), MAX_SLOPE)
        factor = radius / np.maximum(np.hypot(*slopes), 1e-12)
        return slopes[0] * factor, slopes[1] * factor

    def pixel_centers(self) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
        """u and v of the centre of every pixel."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return u, v

    def axial_depths(self) -> Float[np.ndarray, "H W"]:
        """[H, W] z of what each pixel shows at depth 1: of a fisheye less than 1, and NaN from 90° on.

        It is 1 of a panorama, too: files have the distance from it.
        """
        return _axial_depths(self)

    def unit_rays(self, positions: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 3"]:
        """[M, 3] unit vectors in the camera towards what the lens sees at positions [px from the corner]."""
        rays = self.rays(positions[:, 0], positions[:, 1])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)


@lru_cache(maxsize=4096)
def _distortion(lens: Lens) -> Distortion | None:
    if lens.is_pinhole:
        return None
    if lens.is_panorama:
        return _panorama(lens)
    make = Distortion.fisheye if lens.model == "fisheye" else Distortion.radial
    return make(lens.coefficients, torch.tensor(lens.matrix, dtype=torch.float32), (lens.width, lens.height))


def _panorama(lens: Lens) -> Distortion:
    center, size = np.array(lens.center), np.array([lens.width, lens.height])
    aside, up = np.degrees(np.maximum(center, size - center) / lens.focal)
    if not (aside < MAX_REACH * 180.0 and up < MAX_REACH * 90.0):
        raise ValueError(
            f"a panorama reaches at most 180° to the sides and 90° up and down, this one {aside:.4g}° and {up:.4g}°"
        )
    return Distortion.equirectangular()


@lru_cache(maxsize=4)
def _axial_depths(lens: Lens) -> Float[np.ndarray, "H W"]:
    if lens.model != "fisheye":
        return np.ones((lens.height, lens.width), np.float32)
    z = lens.rays(*lens.pixel_centers())[..., 2].astype(np.float32)
    return np.where(z > 0.0, z, np.float32(np.nan))
