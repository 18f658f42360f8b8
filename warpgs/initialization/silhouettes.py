"""The regions of what moves in images with transparent surroundings."""

import math
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from warpgs.data.capture import Frame
from warpgs.data.masks import connected_regions
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.views.part import SomeViews

MIN_PIXELS = 12
"""Minimum size of a region."""

MAX_PIXELS = 1_000
"""Maximum number of a region's pixels that are kept."""


class Region(NamedTuple):
    """A connected region of what moves, as one frame sees it.

    Attributes:
        time: Of the frame, in [0, 1].
        origin: [3] camera centre.
        center: [3] unit vector from there through the centre of the region.
        radius: Angle of a disc of the region's area [rad].
        lab: [3] mean colour in 8-bit Lab.
        rays: [P, 3] unit vectors through its pixels, at most ``MAX_PIXELS`` of them.
        colors: [P, 3] of these pixels in [0, 1].
    """

    time: float
    origin: Float[np.ndarray, "3"]
    center: Float[np.ndarray, "3"]
    radius: float
    lab: Float[np.ndarray, "3"]
    rays: Float[np.ndarray, "P 3"]
    colors: Float[np.ndarray, "P 3"]

    def part(self, chosen: Bool[np.ndarray, " P"]) -> "Region":
        """The region of some of the pixels."""
        rays = self.rays[chosen]
        return self._replace(
            center=_unit(rays.mean(0)),
            radius=self.radius * float(np.sqrt(chosen.mean())),
            rays=rays,
            colors=self.colors[chosen],
        )


def find_regions(views: SomeViews) -> list[list[Region]]:
    """The regions of each training view."""
    return [_regions(frame) for frame in views.frames(range(len(views)))]


def _regions(frame: Frame) -> list[Region]:
    assert frame.static_mask is not None
    camera, image = frame.camera, frame.image.numpy()
    origin, rotation = camera.position.double().numpy(), camera.viewmat[:3, :3].double().numpy()
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB).astype(float)
    regions = []
    for region in connected_regions(~frame.static_mask.numpy(), MIN_PIXELS):
        y, x = np.nonzero(region)
        positions = torch.from_numpy(np.stack([x, y], 1) + 0.5)
        rays = _unit(camera.rays(positions).numpy() @ rotation)
        radius = math.sqrt(float(camera.pixel_areas(positions).nansum()) / math.pi)
        kept = evenly_spaced_indices(len(x), MAX_PIXELS)
        colors = image[y[kept], x[kept]] / 255.0
        regions.append(Region(camera.time, origin, _unit(rays.mean(0)), radius, lab[y, x].mean(0), rays[kept], colors))
    return regions


def _unit(vectors: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
