"""SIFT features by OpenCV in COLMAP's database.

OpenCV's SIFT takes a quarter of the processor time of the one in COLMAP (VLFeat). The scale space is the same: an image
of twice the size, three levels per octave. Descriptors are normalized as in COLMAP: RootSIFT (Arandjelović and
Zisserman 2012).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from jaxtyping import Float, UInt8

from warpgs.data.images import decode

from .parallel import map_frames

MAX_FEATURES = 4096
"""Maximum number of features per frame, the largest; the time for matching grows with its square."""

PEAK, WEAK_PEAK = 0.005, 0.0015
"""Minimum contrast of features, and of weak ones. OpenCV refuses some that COLMAP accepts: with COLMAP's 0.0067, it
finds an eighth fewer."""

LUMA = np.array([[0.0722, 0.7152, 0.2126]])
"""Weights of blue, green and red in COLMAP's grey levels (BT.709). With OpenCV's, those of BT.601, the cameras of the
sample video are 0.20 instead of 0.15 % off: videos store blue and red at half the size."""

LEVELS, MAX_EDGE_RATIO, SIGMA = 3, 10.0, 1.6
"""Levels per octave, limit of the curvatures' ratio, and blur of the first level [px]: those of COLMAP."""

DESCRIPTOR_UNIT = 512.0
"""Number that stands for 1 in an 8-bit descriptor."""


class Features(NamedTuple):
    """Features of a frame.

    Attributes:
        keypoints: [K, 4] column and row [px, the middle of the first pixel at 0.5], scale [px], orientation [rad].
        descriptors: [K, 128].
    """

    keypoints: Float[np.ndarray, "K 4"]
    descriptors: UInt8[np.ndarray, "K 128"]


def extract_features(grey: UInt8[np.ndarray, "H W"], peak: float = PEAK) -> Features:
    """The features of an image, each with one orientation, the largest ``MAX_FEATURES``.

    Args:
        grey: [H, W] grey levels.
        peak: Minimum contrast.
    """
    # OpenCV divides the threshold by the number of levels. Without precise upscaling, positions are 0.25 px off.
    sift = cv2.SIFT.create(0, LEVELS, LEVELS * peak, MAX_EDGE_RATIO, SIGMA, enable_precise_upscale=True)
    found, raw = sift.detectAndCompute(grey, None)
    if not found:
        return Features(np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    # OpenCV counts from the middle of the first pixel, and its size is twice the scale.
    rows = np.array([(*k.pt, k.size / 2.0, np.radians(k.angle)) for k in found], np.float32)
    rows[:, :2] += 0.5
    _, first = np.unique(rows[:, :3], axis=0, return_index=True)
    first = first[np.argsort(-rows[first, 2], kind="stable")][:MAX_FEATURES]
    shares = raw[first] / np.maximum(raw[first].sum(1, keepdims=True), 1e-6)
    descriptors = np.minimum(DESCRIPTOR_UNIT * np.sqrt(shares), 255.0).round().astype(np.uint8)
    return Features(rows[first], descriptors)


def add_features(database: Path, folder: Path, files: Sequence[str], peak: float) -> None:
    """Adds the features of images that are in the database.

    Args:
        database: COLMAP's database.
        folder: Folder of the images.
        files: Names of the images.
        peak: Minimum contrast.
    """

    def extract(file: str) -> Features:
        grey = cv2.transform(decode(folder / file, cv2.IMREAD_COLOR), LUMA)
        return extract_features(grey, peak)

    found = map_frames(extract, files, "features", quiet=True)
    opened = pycolmap.Database.open(database)
    try:
        for file, features in zip(files, found, strict=True):
            key = opened.read_image_with_name(file).image_id
            opened.write_keypoints(key, features.keypoints)
            kind = pycolmap.FeatureExtractorType.SIFT
            opened.write_descriptors(key, pycolmap.FeatureDescriptors(kind, features.descriptors))
    finally:
        opened.close()
