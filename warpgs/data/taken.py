"""Frames as they were taken, with the distortion of their lens, for an evaluation that resamples no ground truth."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import torch
from jaxtyping import Float

from warpgs.cameras import intrinsic_matrix

from .capture import Frame, TakenFrame
from .lens import MAX_ZOOM, Lens

MARGIN = 2
"""Pixels of the wide image around what the distorted image shows, for interpolation."""

MAX_ERROR = 0.05
"""Maximum distance between a pixel and the projection of its ray [px]."""


def without_distortion(lens: Lens) -> Lens:
    """The lens as if it did not distort, for which ``undistort`` leaves images as they are."""
    return replace(lens, radial=(0.0, 0.0, 0.0), tangential=(0.0, 0.0), fisheye=None)


def taken_frame(frame: Frame, lens: Lens) -> TakenFrame:
    """The frame with the wide camera.

    Args:
        frame: With image and masks as they are in the files.
        lens: Of the frame.

    Raises:
        ValueError: If the distortion cannot be inverted.
    """
    K, (width, height), positions = _wide_pinhole(lens)
    camera = replace(frame.camera, K=torch.tensor(K, dtype=torch.float32), width=width, height=height)
    return TakenFrame(replace(frame, camera=camera), torch.tensor(positions, dtype=torch.float32))


def taken_reader(read: Callable[[str, Lens], Frame], lenses: Mapping[str, Lens]) -> Callable[[str], TakenFrame] | None:
    """Reads frames as they were taken; None if no lens distorts. Fisheye frames raise a ValueError.

    A pinhole camera that sees what a fisheye sees would be far larger than the frame.

    Args:
        read: Reads a frame, undistorted as for a lens.
        lenses: The lens of each frame.
    """
    return None if all(lens.is_pinhole for lens in lenses.values()) else partial(_read_taken, read, lenses)


def _read_taken(read: Callable[[str, Lens], Frame], lenses: Mapping[str, Lens], name: str) -> TakenFrame:
    if lenses[name].fisheye:
        raise ValueError(f"frame {name} was taken by a fisheye lens: it can only be evaluated undistorted")
    return taken_frame(read(name, without_distortion(lenses[name])), lenses[name])


@lru_cache(maxsize=4)
def _wide_pinhole(lens: Lens) -> tuple[Float[np.ndarray, "3 3"], tuple[int, int], Float[np.ndarray, "H W 2"]]:
    """K and (width, height) of the wide camera, and ``TakenFrame.positions``."""
    u, v = lens.pixel_centers()
    x, y = lens.unproject(u, v)
    positions = np.moveaxis(without_distortion(lens).image(x, y), 0, -1)
    error = np.abs(lens.image(x, y) - np.stack([u, v])).max()
    if not error < MAX_ERROR or np.ptp(positions, (0, 1)).max() > MAX_ZOOM * max(lens.width, lens.height):
        raise ValueError(f"the distortion cannot be inverted: {lens.radial}, {lens.tangential}")
    corner = np.floor(positions.min((0, 1))) - MARGIN
    width, height = (np.ceil(positions.max((0, 1))) + MARGIN - corner).astype(int).tolist()
    K = intrinsic_matrix(lens.focal, (lens.center[0] - corner[0], lens.center[1] - corner[1]))
    return K, (width, height), positions - corner
