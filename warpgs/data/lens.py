"""Straightening pictures: what a pinhole camera in the place of a real lens would have seen.

The files' camera (google/nerfies, camera.py), with x, y on the plane z = 1 and r² = x² + y²:

    d  = 1 + k1 r² + k2 r⁴ + k3 r⁶
    x' = x d + 2 p1 x y + p2 (r² + 2 x²)
    y' = y d + 2 p2 x y + p1 (r² + 2 y²)
    u  = focal x' + cx
    v  = focal aspect y' + cy

u, v are measured from the corner of the picture: Nerfies casts the ray of a pixel through its index + 0.5. So K is
ours as it stands. OpenCV puts pixel centres at whole numbers, hence the − 0.5 in the maps.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float, Shaped

STRONGEST_ZOOM = 2.0
"""A lens that needs more to fill the straight picture is taken for a mistake in its file."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a file's camera.

    Attributes:
        width, height: Size of its pictures [px].
        focal: (x, y) focal lengths [px].
        center: (x, y) principal point from the corner [px].
        radial: k1, k2, k3.
        tangential: p1, p2.
    """

    width: int
    height: int
    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def is_pinhole(self) -> bool:
        """Whether it is a pinhole already."""
        return not (any(self.radial) or any(self.tangential))

    def image(self, x: Float[np.ndarray, "..."], y: Float[np.ndarray, "..."]) -> Float[np.ndarray, "2 ..."]:
        """u, v of points on the plane z = 1 [px from the corner]."""
        k1, k2, k3 = self.radial
        p1, p2 = self.tangential
        r2 = x * x + y * y
        d = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        bent_x = x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        bent_y = y * d + 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
        return np.stack([self.focal[0] * bent_x + self.center[0], self.focal[1] * bent_y + self.center[1]])

    def rays(
        self, zoom: float, u: Float[np.ndarray, "..."], v: Float[np.ndarray, "..."]
    ) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
        """x, y on the plane z = 1 that a pinhole of ``zoom`` times the focal length shows at u, v."""
        return (u - self.center[0]) / (zoom * self.focal[0]), (v - self.center[1]) / (zoom * self.focal[1])

    def fills(self, zoom: float) -> bool:
        """Whether every pixel of the straight picture lies on the lens's picture, which is not folded there."""
        across, down = np.arange(self.width) + 0.5, np.arange(self.height) + 0.5
        left, top = np.full_like(down, 0.5), np.full_like(across, 0.5)
        border_u = np.concatenate([across, across, left, self.width - left])
        border_v = np.concatenate([top, self.height - top, down, down])
        x, y = self.rays(zoom, border_u, border_v)
        u, v = self.image(x, y)
        inside = (u >= 0.0) & (u <= self.width) & (v >= 0.0) & (v <= self.height)
        k1, k2, k3 = self.radial
        r2 = np.linspace(0.0, float((x * x + y * y).max()), 64)
        rising = 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3)) > 0.0  # d(r d)/dr: further out stays further
        return bool(inside.all() and rising.all())


@lru_cache(maxsize=4096)
def filling_zoom(lens: Lens) -> float:
    """The least factor ≥ 1 on the focal length with which the straight picture has no pixel from outside the lens's.

    Masks say static or dynamic, not unknown: pixels without truth would have to be learnt as one of both. A slightly
    longer focal length leaves none, and costs a rim of the picture.

    Raises:
        ValueError: If that takes more than ``STRONGEST_ZOOM``.
    """
    if lens.is_pinhole or lens.fills(1.0):
        return 1.0
    low, high = 1.0, STRONGEST_ZOOM
    if not lens.fills(high):
        raise ValueError(f"the distortion is too strong to straighten: {lens.radial}, {lens.tangential}")
    for _ in range(16):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if lens.fills(middle) else (middle, high)
    return high


def pinhole_matrix(lens: Lens) -> Float[np.ndarray, "3 3"]:
    """K of the straight pictures, pixel centres at +0.5.

    Raises:
        ValueError: If the distortion is too strong.
    """
    zoom = filling_zoom(lens)
    return np.array(
        [[zoom * lens.focal[0], 0.0, lens.center[0]], [0.0, zoom * lens.focal[1], lens.center[1]], [0.0, 0.0, 1.0]]
    )


@lru_cache(maxsize=4)
def _maps(lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    maps = lens.image(*lens.rays(filling_zoom(lens), u, v)) - 0.5
    return maps[0].astype(np.float32), maps[1].astype(np.float32)


def undistort(picture: Shaped[np.ndarray, "H W ..."], lens: Lens) -> Shaped[np.ndarray, "H W ..."]:
    """What the pinhole of ``pinhole_matrix`` sees; 8-bit pictures are interpolated, masks and depth are not mixed.

    Args:
        picture: [H, W, 3] 8-bit, [H, W] bool or [H, W] float as the lens took it.
        lens: Its intrinsics.
    """
    if lens.is_pinhole:
        return picture
    interpolation = cv2.INTER_LINEAR if picture.ndim == 3 else cv2.INTER_NEAREST
    plane = picture.astype(np.uint8) if picture.dtype == bool else picture
    # Repeating the border fills the outer half of its pixels, the only place the maps reach past pixel centres.
    straight = cv2.remap(plane, *_maps(lens), interpolation, borderMode=cv2.BORDER_REPLICATE)
    return straight.astype(picture.dtype)
