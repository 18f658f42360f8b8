"""Lenses by name: one file each."""

from typing import NamedTuple

import warp as wp

from .lens_equirectangular import equirectangular_point
from .lens_fisheye import fisheye_point
from .lens_pinhole import pinhole_point
from .lens_radial import radial_point


class LensKernels(NamedTuple):
    """A lens.

    Attributes:
        point: From a point in camera space to its point in the image and the Jacobian.
        is_wide: Whether it may see what is behind the plane z = 0: then points are culled by their distance and their
            angle from the axis instead of by z, and the depth of a splat is its distance.
    """

    point: wp.Function
    is_wide: bool = False


LENSES = {
    "pinhole": LensKernels(pinhole_point),
    "radial": LensKernels(radial_point),
    "fisheye": LensKernels(fisheye_point, is_wide=True),
    "equirectangular": LensKernels(equirectangular_point, is_wide=True),
}
"""Lenses by name."""
