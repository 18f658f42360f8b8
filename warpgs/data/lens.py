"""Undistorting images: lens models, and the pinhole camera of the undistorted image.

The camera model of the files (google/nerfies, camera.py), with x, y on the plane z = 1 and r² = x² + y²:

    d  = 1 + k1 r² + k2 r⁴ + k3 r⁶
    x' = x d + 2 p1 x y + p2 (r² + 2 x²)
    y' = y d + 2 p2 x y + p1 (r² + 2 y²)
    u  = focal x' + cx
    v  = focal aspect y' + cy

or, for a fisheye lens, OpenCV's (cv2.fisheye), with θ = atan r the angle from the axis:

    x', y' = x d, y d,  d = (θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹) / r.

u, v are measured from the corner of the image: Nerfies casts the ray of a pixel through its index + 0.5, as we do, so K
needs no conversion. OpenCV has pixel centres at integers, hence the − 0.5 in the maps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Shaped
from torch import Tensor

from warpgs.cameras import intrinsic_matrix
from warpgs.files import MAX_NUMBER

from .images import MAX_PIXELS, MAX_SIDE

MIN_FOCAL = 1e-3
"""Minimum focal length [px]; the reciprocals of smaller ones overflow."""

MAX_ANGLE = np.radians(85.0)
"""Maximum angle from the axis at which a fisheye lens is inverted [radians]; the plane z = 1 ends at 90°."""

NUM_NEWTON_STEPS = 10
"""Steps that invert a fisheye lens; they converge to 1e-9 in five for real lenses."""

MAX_ZOOM = 2.0
"""Maximum zoom of the undistorted image; distortion that needs more is considered an error in the file."""

PANORAMAS = ("EQUIRECT", "SPHER", "PANORAMA", "LATLONG", "OMNI", "VR180", "360")
"""Parts of the names that programs give to camera models of panoramas."""


def unsupported_model(model: object, remedy: str) -> str:
    """Message that a camera model is not read, and what to do: ``remedy``, unless it is one of panoramas."""
    if any(part in str(model).upper() for part in PANORAMAS):
        return (
            f"the camera model {model} is not supported: it is one of 360° images, which must be cut into perspective "
            "views before their poses are estimated, as by ns-process-data images --camera-type equirectangular of "
            "nerfstudio or panorama_sfm.py of COLMAP"
        )
    return f"the camera model {model} is not supported; {remedy}"


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a camera with distortion.

    Attributes:
        width, height: Size of the image [px].
        focal: (x, y) focal lengths [px].
        center: (x, y) principal point from the corner of the image [px].
        radial: Distortion coefficients k1, k2, k3.
        tangential: Distortion coefficients p1, p2.
        fisheye: Coefficients k1 to k4 of a fisheye lens, which has no others; None if it is none.
    """

    width: int
    height: int
    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: tuple[float, float, float, float] | None = None

    @staticmethod
    def pinhole(K: Float[np.ndarray | Tensor, "3 3"], size: tuple[int, int]) -> "Lens":
        """The lens without distortion of intrinsics K and images of (width, height) [px]."""
        (fx, _, cx), (_, fy, cy), _ = K.tolist()
        return Lens(*size, (fx, fy), (cx, cy))

    @staticmethod
    def centered(focal: float, size: tuple[int, int]) -> "Lens":
        """A pinhole lens with square pixels and its axis in the middle of images of (width, height) [px]."""
        return Lens(*size, (focal, focal), (size[0] / 2.0, size[1] / 2.0))

    def checked(self, undistort: bool = True) -> "Lens":
        """This lens, if it can be used.

        Args:
            undistort: Whether its images are to be undistorted.

        Raises:
            ValueError: If a number is not finite or larger than ``files.MAX_NUMBER``, a focal length is below
                ``MIN_FOCAL``, the size is out of range, or the distortion is too strong to undistort and ``undistort``
                is true.
        """
        values = (*self.focal, *self.center, *self.radial, *self.tangential, *(self.fisheye or ()))
        if not (np.abs(values) <= MAX_NUMBER).all() or min(self.focal) < MIN_FOCAL:
            raise ValueError(
                f"focal lengths must be at least {MIN_FOCAL} px and intrinsics finite and at most {MAX_NUMBER:g}, "
                f"got {values}"
            )
        if not 0 < min(self.width, self.height) <= max(self.width, self.height) <= MAX_SIDE:
            raise ValueError(f"image size {self.width}×{self.height}, expected 1 to {MAX_SIDE} pixels per side")
        if self.width * self.height > MAX_PIXELS:
            raise ValueError(f"image size {self.width}×{self.height}, expected at most {MAX_PIXELS:,} pixels together")
        if undistort:
            filling_zoom(self)
        return self

    def resized(self, width: int, height: int) -> "Lens":
        """The lens of images that were resized to another size."""
        x, y = width / self.width, height / self.height
        focal, center = (self.focal[0] * x, self.focal[1] * y), (self.center[0] * x, self.center[1] * y)
        return replace(self, width=width, height=height, focal=focal, center=center)

    @property
    def is_pinhole(self) -> bool:
        """Whether there is no distortion."""
        return not (any(self.radial) or any(self.tangential)) and self.fisheye is None

    def image(self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]) -> Float[np.ndarray, "2 ..."]:
        """Projects points on the plane z = 1 to u, v [px from the corner]."""
        if self.fisheye is not None:
            r = np.hypot(x, y)
            theta = np.arctan(r)
            d = np.where(r > 0.0, _image_radius(theta, self.fisheye) / np.where(r > 0.0, r, 1.0), 1.0)
            return np.stack([self.focal[0] * x * d + self.center[0], self.focal[1] * y * d + self.center[1]])
        k1, k2, k3 = self.radial
        p1, p2 = self.tangential
        r2 = x * x + y * y
        d = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        distorted_x = x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        distorted_y = y * d + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
        return np.stack([self.focal[0] * distorted_x + self.center[0], self.focal[1] * distorted_y + self.center[1]])

    def unproject(
        self, u: Float[np.ndarray, "*N"], v: Float[np.ndarray, "*N"]
    ) -> tuple[Float[np.ndarray, "*N"], Float[np.ndarray, "*N"]]:
        """x, y on the plane z = 1 that the lens sees at u, v: the inverse of ``image``, up to ``MAX_ANGLE``."""
        x, y = self.rays(1.0, u, v)
        if self.fisheye is not None:
            radius = np.hypot(x, y)
            theta = np.minimum(radius, MAX_ANGLE)
            for _ in range(NUM_NEWTON_STEPS):
                theta = theta - (_image_radius(theta, self.fisheye) - radius) / np.maximum(
                    _slope(theta, self.fisheye), 0.1
                )
                theta = np.clip(theta, 0.0, MAX_ANGLE)
            scale = np.where(radius > 0.0, np.tan(theta) / np.where(radius > 0.0, radius, 1.0), 1.0)
            return x * scale, y * scale
        if not self.is_pinhole:
            coefficients = np.array([*self.radial[:2], *self.tangential, self.radial[2]])
            criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
            distorted = np.stack([x, y], -1).reshape(-1, 1, 2).astype(np.float64)
            if hasattr(cv2, "undistortPointsIter"):  # in OpenCV 4, whose undistortPoints takes no criteria
                found = cv2.undistortPointsIter(distorted, np.eye(3), coefficients, np.eye(3), np.eye(3), criteria)
            else:
                found = cv2.undistortPoints(distorted, np.eye(3), coefficients, None, None, None, criteria)
            x, y = found[:, 0].T.reshape(2, *np.shape(x))
        return x, y

    def pixel_centers(self) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
        """u and v of the centre of every pixel."""
        u, v = np.meshgrid(np.arange(self.width) + 0.5, np.arange(self.height) + 0.5)
        return u, v

    def unit_rays(self, positions: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 3"]:
        """[M, 3] unit vectors in the camera towards what the lens sees at positions [px from the corner]."""
        rays = np.stack([*self.unproject(positions[:, 0], positions[:, 1]), np.ones(len(positions))], 1)
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def rays(
        self, zoom: float, u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """x, y on the plane z = 1 that a pinhole camera with ``zoom`` times the focal length sees at u, v."""
        return (u - self.center[0]) / (zoom * self.focal[0]), (v - self.center[1]) / (zoom * self.focal[1])

    def covers(self, zoom: float) -> bool:
        """Whether every pixel of an image undistorted with ``zoom`` has a source, and the distortion is invertible."""
        across, down = np.arange(self.width) + 0.5, np.arange(self.height) + 0.5
        left, top = np.full_like(down, 0.5), np.full_like(across, 0.5)
        border_u = np.concatenate([across, across, left, self.width - left])
        border_v = np.concatenate([top, self.height - top, down, down])
        x, y = self.rays(zoom, border_u, border_v)
        u, v = self.image(x, y)
        inside = (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
        r2 = np.linspace(0.0, float((x * x + y * y).max()), 64)
        if self.fisheye is not None:
            increasing = _slope(np.arctan(np.sqrt(r2)), self.fisheye) > 0.0
        else:
            k1, k2, k3 = self.radial
            increasing = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3)) > 0.0  # d(r d)/dr > 0
        return bool(inside.all() and increasing.all())


def _image_radius(theta: Float[np.ndarray, "..."], k: Sequence[float]) -> Float[np.ndarray, "..."]:
    """Distance from the principal point, over the focal length, that a fisheye lens gives to an angle."""
    t = theta * theta
    return theta * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3]))))


def _slope(theta: Float[np.ndarray, "..."], k: Sequence[float]) -> Float[np.ndarray, "..."]:
    """Derivative of ``_image_radius``."""
    t = theta * theta
    return 1.0 + t * (3.0 * k[0] + t * (5.0 * k[1] + t * (7.0 * k[2] + t * 9.0 * k[3])))


@lru_cache(maxsize=4096)
def filling_zoom(lens: Lens) -> float:
    """The smallest factor ≥ 1 on the focal length with which every pixel of the undistorted image has a source pixel.

    Masks say static or dynamic, not unknown, so pixels without a source would be learned as one of the two. A slightly
    longer focal length avoids them and crops the border of the image.

    Raises:
        ValueError: If the factor is larger than ``MAX_ZOOM``.
    """
    if lens.is_pinhole or lens.covers(1.0):
        return 1.0
    low, high = 1.0, MAX_ZOOM
    if not lens.covers(high):
        raise ValueError(
            f"the distortion is too strong to undistort: {lens.fisheye or (*lens.radial, *lens.tangential)}"
        )
    for _ in range(16):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if lens.covers(middle) else (middle, high)
    return high


def pinhole_matrix(lens: Lens) -> Float[np.ndarray, "3 3"]:
    """K of the undistorted images, pixel centres at +0.5.

    Raises:
        ValueError: If the distortion is too strong.
    """
    zoom = filling_zoom(lens)
    return intrinsic_matrix((zoom * lens.focal[0], zoom * lens.focal[1]), lens.center)


@lru_cache(maxsize=4)
def _maps(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    maps = lens.image(*lens.rays(filling_zoom(lens), *lens.pixel_centers())) - 0.5
    return maps[0].astype(np.float32), maps[1].astype(np.float32)


def undistort(image: Shaped[np.ndarray, "H W ..."], lens: Lens) -> Shaped[np.ndarray, "H W ..."]:
    """The image that the pinhole camera of ``pinhole_matrix`` sees.

    Images are interpolated linearly; masks and depth take the nearest pixel.

    Args:
        image: [H, W, 3] 8-bit image, [H, W] bool mask or [H, W] float depth.
        lens: Intrinsics of the image.
    """
    if lens.is_pinhole:
        return image
    interpolation = cv2.INTER_LINEAR if image.ndim == 3 else cv2.INTER_NEAREST
    source = image.astype(np.uint8) if image.dtype == bool else image
    # The maps reach at most half a pixel beyond the centres of the border pixels; replicating the border covers that.
    undistorted = cv2.remap(source, *_maps(lens), interpolation, borderMode=cv2.BORDER_REPLICATE)
    return undistorted.astype(image.dtype)
