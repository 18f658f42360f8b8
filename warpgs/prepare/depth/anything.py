"""Depth of every pixel of an image by Depth Anything V2 (Yang et al. 2024), up to a scale and an offset."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch.nn.functional import interpolate

from warpgs.command_line.progress import progress

from ..networks import load, normalized
from ..weights import DEPTH_ANYTHING

MIN_DEPTH = 1e-3
"""Minimum of metric depth [m]; smaller values are clamped."""


def network_size(width: int, height: int, side: int, patch: int) -> tuple[int, int]:
    """(width, height) that images are resized to, as in the network's own preprocessing.

    The aspect ratio is kept, the side closer to ``side`` becomes ``side``, and both are rounded to whole patches.
    """
    scale = min(side / width, side / height, key=lambda s: abs(1.0 - s))
    return max(1, round(scale * width / patch)) * patch, max(1, round(scale * height / patch)) * patch


@torch.inference_mode()
def predict(
    images: Sequence[UInt8[np.ndarray, "H W 3"]], weights: Path, quiet: bool = True
) -> list[Float[np.ndarray, "H W"]]:
    """[H, W] inverse depth of each image, each with its own scale and offset.

    ``weights`` is a folder of the network; those of metric depth can be used as well.

    Raises:
        ValueError: If the weights are damaged.
    """
    network = load(DEPTH_ANYTHING, weights)
    config, planes = network.config, []
    for image in progress(images, "Depth Anything", quiet):
        height, width = image.shape[:2]
        size = network_size(width, height, config.backbone_config.image_size, config.patch_size)
        values = network(normalized(image, *size)[None].to(network.device)).predicted_depth
        plane = interpolate(values[None].float(), (height, width), mode="bilinear", align_corners=False)[0, 0]
        if config.depth_estimation_type == "metric":
            plane = 1.0 / plane.clamp(min=MIN_DEPTH)
        planes.append(plane.cpu().numpy())
    return planes
