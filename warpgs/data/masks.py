"""Masks: their regions, what is nearest to them, and their perturbation for training (paper, robustness)."""

import hashlib

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from warpgs.config import MaskPerturbation

HOLE_RADIUS = 0.03
"""Radius of a hole as a fraction of the image height."""

MAX_RADIUS = 256
"""Maximum radius of erosion and dilation [px]."""


def connected_regions(mask: Bool[np.ndarray, "H W"], min_area: int) -> list[Bool[np.ndarray, "H W"]]:
    """The connected regions of a mask that have at least ``min_area`` pixels; diagonal neighbours are not connected."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [labels == k for k in range(1, len(stats)) if stats[k, cv2.CC_STAT_AREA] >= min_area]


def nearest_pixels(mask: Bool[np.ndarray, "H W"]) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """For each pixel the flat index of the nearest true pixel of a mask that is not empty, and its distance [px]."""
    distance, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    pixel_of = np.zeros(labels.max() + 1, np.int64)
    pixel_of[labels[mask]] = np.flatnonzero(mask)
    return pixel_of[labels], distance


def check_perturbation(perturbation: MaskPerturbation) -> None:
    """Raises ``ValueError`` if erosion, dilation or the fraction of holes is out of range."""
    for name in ("erode", "dilate"):
        if not 0 <= getattr(perturbation, name) <= MAX_RADIUS:
            raise ValueError(f"masks: {name} must be 0 to {MAX_RADIUS} pixels, got {getattr(perturbation, name)}")
    if not 0.0 <= perturbation.holes < 1.0:
        raise ValueError(f"masks: holes must be a fraction in [0, 1), got {perturbation.holes}")


def perturb(static_mask: Bool[np.ndarray, "H W"], perturbation: MaskPerturbation, name: str) -> Bool[np.ndarray, "H W"]:
    """The mask after its dynamic region is eroded, dilated and then perforated.

    Holes are discs around random pixels of the dynamic region until they cover the fraction ``holes`` of it; they
    depend only on the mask and the name of the frame. For training only: evaluation uses the true masks.

    Args:
        static_mask: [H, W] true where static.
        perturbation: Sizes of the perturbation.
        name: Id of the frame, the seed of the holes.

    Raises:
        ValueError: If the perturbation is out of range.
    """
    check_perturbation(perturbation)
    dynamic = (~static_mask).astype(np.uint8)
    if perturbation.erode:
        # Outside of the image counts as dynamic: objects are not eroded along the border of the image.
        dynamic = cv2.erode(dynamic, _disc(perturbation.erode), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    if perturbation.dilate:
        dynamic = cv2.dilate(dynamic, _disc(perturbation.dilate))
    if perturbation.holes and dynamic.any():
        dynamic = _with_holes(dynamic, perturbation.holes, name)
    return dynamic == 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _with_holes(dynamic: np.ndarray, fraction: float, name: str) -> np.ndarray:
    seed = int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
    rows, columns = dynamic.nonzero()
    radius = max(1, round(HOLE_RADIUS * dynamic.shape[0]))
    remaining = dynamic.copy()
    for index in np.random.default_rng(seed).permutation(len(rows)):
        if remaining.sum() <= (1.0 - fraction) * len(rows):
            break
        cv2.circle(remaining, (int(columns[index]), int(rows[index])), radius, 0, thickness=-1)
    return remaining
