"""Areas of an image that are selected in, and what is drawn of a selection."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.editing.marked import Marked
from warpgs.model.gaussians import SH_C0
from warpgs.model.splats import Splats
from warpgs.runs.trained import TrainedScene

from .layers import Image

Point = tuple[float, float]
"""A position on the screen: x and y in [0, 1], from the upper left corner."""

Area = Bool[np.ndarray, "H W"]

TINT, STRENGTH = (1.0, 0.55, 0.1), 0.7
"""Colour of selected Gaussians, and its part in what they show."""

LINE = (255, 160, 60)
"""Colour of the outline of a lasso."""

DOT_PIXELS = 4
"""Radius of a corner of a lasso [px]."""


class Marks(NamedTuple):
    """What is drawn over an image.

    Attributes:
        selected: Gaussians of the scene without edits that are tinted.
        outline: Corners of a lasso that is not closed yet.
    """

    selected: Marked | None = None
    outline: tuple[Point, ...] = ()


NO_MARKS = Marks()
"""Nothing is selected."""


def polygon(size: tuple[int, int], corners: Sequence[Point]) -> Area:
    """The pixels of a (width, height) image inside of a polygon, by the even-odd rule."""
    area = np.zeros(size[::-1], np.uint8)
    cv2.fillPoly(area, [_pixels(size, corners)], 1)
    return area.astype(bool)


def disc(size: tuple[int, int], center: Point, radius: float) -> Area:
    """The pixels of a (width, height) image inside of a circle with a radius [px]."""
    area = np.zeros(size[::-1], np.uint8)
    (middle,) = _pixels(size, [center])
    cv2.circle(area, middle.tolist(), round(radius), 1, cv2.FILLED)
    return area.astype(bool)


def inside(splats: Splats, camera: Camera, area: Area) -> Bool[Tensor, " N"]:
    """Which Gaussians have their projected centres in an area of the camera's image."""
    row, column, _, is_visible = camera.to(splats.means.device).project(splats.means)
    return torch.from_numpy(area).to(row.device)[row, column] & is_visible


def rows_of(scene: TrainedScene, selected: Marked) -> Bool[Tensor, " N"]:
    """Which Gaussians of an edited scene are selected."""
    mask = torch.from_numpy(selected.mask).to(scene.device)
    return mask if scene.rows is None else mask[scene.rows]


def tinted(splats: Splats, is_selected: Bool[Tensor, " N"]) -> Splats:
    """The Gaussians with those tinted that are selected."""
    assert splats.sh is not None
    color = torch.tensor(TINT, dtype=torch.float32, device=is_selected.device)
    sh = (1.0 - STRENGTH) * splats.sh
    sh[:, 0] += STRENGTH * (color - 0.5) / SH_C0  # a colour is 0.5 + SH_C0 · sh[0] + …
    return replace(splats, sh=torch.where(is_selected[:, None, None], sh, splats.sh))


def with_outline(image: Image, corners: Sequence[Point]) -> Image:
    """The image with the outline of a lasso."""
    if not corners:
        return image
    image, pixels = image.copy(), _pixels(image.shape[1::-1], corners)
    cv2.polylines(image, [pixels], False, LINE, 1, cv2.LINE_AA)
    for pixel in pixels:
        cv2.circle(image, pixel.tolist(), DOT_PIXELS, LINE, cv2.FILLED, cv2.LINE_AA)
    return image


def _pixels(size: tuple[int, ...], points: Sequence[Point]) -> np.ndarray:
    """Pixels of positions on the screen."""
    return np.floor(np.array(points) * size).astype(np.int32)
