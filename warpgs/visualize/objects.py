"""Objects in colours, with their numbers."""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Int64, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.rendering import render

from .images import to_bytes

NONE = 0.35
"""Grey of what belongs to no object."""

COLORS = (
    (0.90, 0.24, 0.24),
    (0.24, 0.78, 0.24),
    (0.27, 0.43, 1.00),
    (0.94, 0.78, 0.16),
    (0.78, 0.24, 0.86),
    (0.20, 0.86, 0.86),
    (1.00, 0.55, 0.16),
    (0.63, 0.86, 0.43),
    (1.00, 0.59, 0.75),
    (0.55, 0.43, 0.24),
)
"""Of the objects 1, 2, …; then again from the first."""

HEIGHT = 0.045
"""Height of a number, relative to the height of the image."""

MIN_WEIGHT = 1e-3
"""Smallest part of an image that is seen of an object whose number is shown."""


def objects_image(splats: Splats, camera: Camera, settings: RenderSettings) -> UInt8[np.ndarray, "H W 3"]:
    """Which object is seen where, with its number at the middle of it; grey where there is none."""
    ids = splats.objects
    if ids is None:
        ids = torch.zeros(len(splats.means), dtype=torch.int64, device=splats.means.device)
    colors = torch.tensor(COLORS, dtype=torch.float32, device=ids.device)[(ids - 1) % len(COLORS)]
    colors = torch.where(ids[:, None] > 0, colors, NONE)
    plain = replace(splats, colors=colors, sh=None, sh_degree=None, reflections=None, background=None)
    rendering = render(plain, camera, settings=replace(settings, statistics=True))
    image = to_bytes(rendering.joint.image)
    assert rendering.weights is not None
    _write_numbers(image, splats, camera, ids, rendering.weights)
    return image


def _write_numbers(
    image: UInt8[np.ndarray, "H W 3"], splats: Splats, camera: Camera, ids: Int64[Tensor, " N"], weights: Tensor
) -> None:
    """Writes the number of each object that is seen at the mean of where it is seen."""
    row, column, _, inside = camera.project(splats.means)
    scale = HEIGHT * camera.height / 22.0  # the font's height at scale 1 [px]
    for number in ids[ids > 0].unique().tolist():
        shown = torch.where((ids == number) & inside, weights, 0.0)
        if shown.sum() < MIN_WEIGHT * camera.width * camera.height:
            continue
        x, y = ((shown * at).sum() / shown.sum() for at in (column, row))
        text = str(number)
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
        origin = (round(float(x) - width / 2), round(float(y) + height / 2))
        for thickness, color in ((4.0, (0, 0, 0)), (1.5, (255, 255, 255))):
            line = max(1, round(thickness * scale))
            cv2.putText(image, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, color, line, cv2.LINE_AA)
