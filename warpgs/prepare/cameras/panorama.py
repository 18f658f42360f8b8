"""Panoramas as six perspective views: optical flow and triangulation need images of a plane.

The views look ahead, to the right, back, to the left, down and up, and overlap. COLMAP finds the cameras from the
panoramas themselves; masks and depth are found in each view over time and joined to panoramas.
"""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Shaped
from scipy.spatial.transform import Rotation

from warpgs.data.lens import Lens

from ..frames.images import read_images
from .posed_frames import PosedFrames
from .recovered import Cameras

HALF_ANGLE = math.radians(50.0)
"""Half of a view's angle from side to side; a cube's faces have 45°, without what optical flow needs around them."""

TURNS = np.stack(
    [
        *(Rotation.from_euler("y", -angle, degrees=True).as_matrix() for angle in (0, 90, 180, 270)),
        *(Rotation.from_euler("x", angle, degrees=True).as_matrix() for angle in (90, -90)),
    ]
)
"""[6, 3, 3] rotations from the axes of a panorama's camera to the axes of each view."""


def view_lens(side: int) -> Lens:
    """The lens of views with a side [px]."""
    return Lens.centered(0.5 * side / math.tan(HALF_ANGLE), (side, side))


def views_of(folder: Path, cameras: Cameras, side: int) -> Iterator[PosedFrames]:
    """The six views of the panoramas <folder>/<name>.png, one after the other: all may not fit into memory."""
    lens = view_lens(side)
    for turn in TURNS:
        images = [cut(image, turn, lens) for image in read_images(folder, cameras.names)]
        yield PosedFrames(images, lens, turn @ cameras.poses, cameras.points)


def cut(
    panorama: Shaped[np.ndarray, "H W *C"], turn: Float[np.ndarray, "3 3"], lens: Lens
) -> Shaped[np.ndarray, "h w *C"]:
    """The view of a panorama that a lens sees after a turn."""
    height, width = panorama.shape[:2]
    rays = lens.rays(*lens.pixel_centers()) @ turn
    maps = Lens.panorama((width, height)).project(rays.reshape(-1, 3)).reshape((*rays.shape[:2], 2)) - 0.5
    return cv2.remap(panorama, maps.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)


def joined(
    planes: Sequence[Sequence[Float[np.ndarray, "h w"]]], size: tuple[int, int], interpolation: int
) -> list[Float[np.ndarray, "H W"]]:
    """Panoramas of (width, height) [px] from a plane of every frame of each view.

    Every pixel is of the view whose axis is nearest.
    """
    panorama, lens = Lens.panorama(size), view_lens(planes[0][0].shape[0])
    rays = panorama.rays(*panorama.pixel_centers()) @ TURNS.transpose(0, 2, 1)[:, None]
    nearest = rays[..., 2].argmax(0)
    found = [np.zeros(nearest.shape, np.float32) for _ in planes[0]]
    for view, of_view in enumerate(planes):
        is_here = nearest == view
        maps = np.full((*nearest.shape, 2), -1.0, np.float32)
        maps[is_here] = lens.project(rays[view][is_here]) - 0.5
        for whole, plane in zip(found, of_view, strict=True):
            whole[is_here] = cv2.remap(plane, maps, None, interpolation, borderMode=cv2.BORDER_REPLICATE)[is_here]
    return found
