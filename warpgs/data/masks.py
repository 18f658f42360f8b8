"""Damage to masks on purpose (paper, robustness under mask perturbations)."""

import hashlib

import cv2
import numpy as np
from jaxtyping import Bool

from warpgs.config import MaskPerturbation

HOLE_RADIUS = 0.03
"""Radius of a hole, as a share of the picture's height."""

WIDEST = 256
"""Pixels of erosion and dilation, at most."""


def check_perturbation(perturbation: MaskPerturbation) -> None:
    """Raises ``ValueError`` if erosion, dilation or the share of holes is out of range."""
    for name in ("erode", "dilate"):
        if not 0 <= getattr(perturbation, name) <= WIDEST:
            raise ValueError(f"masks: {name} must be 0 to {WIDEST} pixels, got {getattr(perturbation, name)}")
    if not 0.0 <= perturbation.holes < 1.0:
        raise ValueError(f"masks: holes must be a share in [0, 1), got {perturbation.holes}")


def perturb(static_mask: Bool[np.ndarray, "H W"], perturbation: MaskPerturbation, name: str) -> Bool[np.ndarray, "H W"]:
    """A static mask whose dynamic region is eroded, dilated and then holed.

    Holes are discs around random pixels of the dynamic region, until they cover ``holes`` of it; which ones depends on
    the frame's name and region only. For training only: evaluation tells regions by the true masks.

    Args:
        static_mask: [H, W] true where static.
        perturbation: What to do.
        name: Of the frame, the seed of the holes.

    Raises:
        ValueError: If the perturbation is out of range.
    """
    check_perturbation(perturbation)
    moving = (~static_mask).astype(np.uint8)
    if perturbation.erode:
        # What lies outside the picture counts as moving: an object that it cuts is not eroded along the cut.
        moving = cv2.erode(moving, _disc(perturbation.erode), borderType=cv2.BORDER_CONSTANT, borderValue=1)
    if perturbation.dilate:
        moving = cv2.dilate(moving, _disc(perturbation.dilate))
    if perturbation.holes and moving.any():
        moving = _pierce(moving, perturbation.holes, name)
    return moving == 0


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))


def _pierce(moving: np.ndarray, share: float, name: str) -> np.ndarray:
    seed = int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "big")
    rows, columns = moving.nonzero()
    radius = max(1, round(HOLE_RADIUS * moving.shape[0]))
    pierced = moving.copy()
    for place in np.random.default_rng(seed).permutation(len(rows)):
        if pierced.sum() <= (1.0 - share) * len(rows):
            break
        cv2.circle(pierced, (int(columns[place]), int(rows[place])), radius, 0, thickness=-1)
    return pierced
