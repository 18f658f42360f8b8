"""A method that finds what moves, and the masks that it finds in the frames of cameras."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from ..cameras.panorama import joined, views_of
from ..cameras.posed_frames import PosedFrames, load_posed_frames
from ..cameras.recovered import Cameras
from ..weights import Network, find_weights

WORKING_SIDE = 512
"""Longest side of the images that motion is found on [px]. Smaller images are enlarged, because superpixels and
outlines have sizes in pixels (hand video at 256×192: intersection over union 0.33, enlarged 0.79)."""

DynamicMasks = Sequence[Bool[np.ndarray, "H W"]]


@dataclass(frozen=True)
class Masker:
    """A method that finds what moves.

    Attributes:
        find: Dynamic masks [H, W] of the frames, from the frames, the folder of the network's weights (None without a
            network), and whether to be quiet.
        network: The network that it needs.
    """

    find: Callable[[PosedFrames, Path | None, bool], DynamicMasks]
    network: Network | None = None


def find_masks(
    images: Path, cameras: Cameras, masker: Masker, weights: Path | None, *, half_size: bool, quiet: bool
) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] the dynamic mask of each frame of the cameras, in the size of the lens.

    Args:
        images: Folder of the frames <name>.png.
        cameras: Cameras of the frames.
        masker: How to find what moves.
        weights: Folder with the networks' weights; None for the Hugging Face cache.
        half_size: Whether to find it on images of half the usual size.
        quiet: Whether to show no progress.
    """
    folder = find_weights(masker.network, weights)
    side = WORKING_SIDE // 2 if half_size else WORKING_SIDE
    size = cameras.lens.width, cameras.lens.height
    if cameras.lens.is_panorama:
        views = [masker.find(view, folder, quiet) for view in views_of(images, cameras, side // 2)]
        planes = [[mask.astype(np.float32) for mask in view] for view in views]
        return [plane > 0.5 for plane in joined(planes, size, cv2.INTER_CUBIC)]
    frames = load_posed_frames(images, cameras, side)
    masks = masker.find(frames, folder, quiet)
    if frames.shown is not None:
        masks = [mask & frames.shown for mask in masks]
    return [cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_CUBIC) > 0.5 for mask in masks]
