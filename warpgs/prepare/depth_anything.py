"""Depth of every pixel from one picture by Depth Anything V2 (Yang et al. 2024), up to a scale and an offset."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch.nn.functional import interpolate

from warpgs.progress import progress

from .networks import DEPTH_ANYTHING, load, normalised

NEAREST = 1e-3
"""Distance under which metric depth is clamped [m]."""


def network_size(width: int, height: int, side: int, patch: int) -> tuple[int, int]:
    """(width, height) that pictures are resized to: as the network's own processing does.

    The aspect is kept, the side that is nearer to ``side`` gets it, and both are rounded to whole patches.
    """
    scale = min(side / width, side / height, key=lambda s: abs(1.0 - s))
    return max(1, round(scale * width / patch)) * patch, max(1, round(scale * height / patch)) * patch


@torch.inference_mode()
def predict(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], weights: Path, quiet: bool = True
) -> list[Float[np.ndarray, "H W"]]:
    """[H, W] inverse depth of each picture in units of its own.

    Args:
        images: [H, W, 3].
        weights: Folder of the network's weights; those of metric depth serve as well.
        quiet: Whether to show no progress.

    Raises:
        ValueError: If the weights are damaged.
    """
    network = load(DEPTH_ANYTHING, weights)
    config, planes = network.config, []
    for image in progress(images, "Depth Anything", quiet):
        height, width = image.shape[:2]
        size = network_size(width, height, config.backbone_config.image_size, config.patch_size)
        values = network(normalised(image, *size)[None].to(network.device)).predicted_depth
        plane = interpolate(values[None].float(), (height, width), mode="bilinear", align_corners=False)[0, 0]
        if config.depth_estimation_type == "metric":
            plane = 1.0 / plane.clamp(min=NEAREST)
        planes.append(plane.cpu().numpy())
    return planes
