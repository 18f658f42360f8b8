"""Connected regions of what moves, in masks that are scaled down."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.cameras import Camera

from .masks import connected_regions
from .resized import size_within

MAX_SIDE = 512
"""Regions are found in masks that are scaled down to this longer side [px]."""

MIN_AREA = 0.002
"""Minimum size of a region, as a fraction of the image."""

MIN_FRAMES = 12
"""Minimum number of frames that show an object whole, for its size to tell its depth."""

MIN_KNOWN_FRACTION = 0.1
"""Minimum fraction of the dynamic pixels whose depth must be known for it to be used; depth from multi-view stereo is
known only where nothing moves."""


def scaled_size(size: tuple[int, int]) -> tuple[int, int]:
    """(width, height) of the scaled mask of a frame of this size."""
    return size_within(size, MAX_SIDE)


def dynamic_regions(static_mask: Bool[Tensor, "H W"], camera: Camera) -> list[Bool[np.ndarray, "h w"]]:
    """The connected regions of a camera's scaled mask, on the CPU, that are large enough."""
    dynamic = (~static_mask.numpy()).astype(np.uint8)
    dynamic = cv2.resize(dynamic, scaled_size(camera.size), interpolation=cv2.INTER_NEAREST_EXACT)
    return connected_regions(dynamic > 0, math.ceil(MIN_AREA * dynamic.size))


def is_cut(region: Bool[np.ndarray, "h w"]) -> bool:
    """Whether a region touches the image border."""
    return bool(region[[0, -1]].any() or region[:, [0, -1]].any())


class DynamicCounts(NamedTuple):
    """Numbers of dynamic regions, of those that the border cuts off, of dynamic pixels, and of those with depth.

    Attributes:
        fraction: Dynamic pixels as a fraction of all pixels of the frame.
    """

    regions: int
    cut: int
    pixels: int
    fraction: float
    with_depth: int


def dynamic_counts(
    static_mask: Bool[Tensor, "H W"],
    regions: Sequence[Bool[np.ndarray, "h w"]],
    inverse_depth: Float[Tensor, "H W"] | None = None,
) -> DynamicCounts:
    """Counts what the mask of a frame marks as dynamic, with its ``dynamic_regions``; all tensors are on the CPU."""
    is_dynamic = ~static_mask
    with_depth = 0 if inverse_depth is None else int((inverse_depth.isfinite() & is_dynamic).sum())
    pixels = int(is_dynamic.sum())
    return DynamicCounts(len(regions), sum(map(is_cut, regions)), pixels, pixels / is_dynamic.numel(), with_depth)


def unknown_depth(num_cut: int, num_frames: int) -> str:
    """What to say where dynamic objects have neither depth nor a size that tells it.

    Args:
        num_cut: Number of training frames in which the image border cuts one off.
        num_frames: Number of training frames.
    """
    is_cause = num_frames - num_cut < MIN_FRAMES <= num_frames
    border = f", but the image border cuts them off in {num_cut} of {num_frames} training frames" if is_cause else ""
    return (
        "the depth of dynamic objects is unknown, so they may be blurred and partly in the static image: their size "
        f"tells it only if one can be followed and is whole in {MIN_FRAMES} frames{border}; record so that one stays "
        f"whole in at least {MIN_FRAMES} frames, or run warpgs prepare with --depth anything"
    )
