"""The focal length that mapping starts from, where none is known.

COLMAP's guess, 1.2 times the longer side, is that of a normal lens. From a guess far off, bundle adjustment ends in a
wrong lens: one of half the width became 0.8 times the width with strong distortion, and nothing but the features fitted
its cameras. View graph calibration (Sweeney et al. 2015) finds the focal length from the fundamental matrices of all
pairs, within 20 % on real clips, but is wrong where all cameras look at one point.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see ``colmap``
import numpy as np
import pycolmap

from .recovered import PLAUSIBLE_FOCAL

FAR = 1.6
"""Factor between the guess and what the pairs agree on from which on mapping starts from the latter."""

CONFIRMED = 1.25
"""Factor by which bundle adjustment may change what the pairs agree on without making it doubtful."""


def calibrated(database: Path) -> Path:
    """A copy of the database with the focal length that its pairs agree on, or the database if that is not far away.

    Args:
        database: COLMAP's database with verified matches.
    """
    copy = database.with_suffix(".calibrated.db")
    shutil.copyfile(database, copy)
    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = 0
    is_far = pycolmap.calibrate_view_graph(copy, options) and not _are_near(
        read_focals(copy), read_focals(database), FAR
    )
    if is_far:
        return copy
    copy.unlink()
    return database


def confirms(model: Any, database: Path) -> bool:
    """Whether a reconstruction's focal lengths are still near those of the database that it started from."""
    found = [model.cameras[key].mean_focal_length() for key in sorted(model.cameras)]
    return _are_near(found, read_focals(database), CONFIRMED)


def is_plausible(model: Any) -> bool:
    """Whether a reconstruction's focal length is plausible for a lens that is not a fisheye."""
    (camera,) = model.cameras.values()
    least, most = PLAUSIBLE_FOCAL
    return bool(least <= focal_of(model) / max(camera.width, camera.height) <= most)


def focal_of(model: Any) -> float:
    """The focal length of a reconstruction's camera [px]."""
    (camera,) = model.cameras.values()
    return float(camera.mean_focal_length())


def _are_near(a: Sequence[float], b: Sequence[float], factor: float) -> bool:
    return bool(np.abs(np.log(np.array(a) / np.array(b))).max() < np.log(factor))


def read_focals(database: Path) -> list[float]:
    """The focal lengths of the cameras in a database [px]."""
    opened = pycolmap.Database.open(database)
    try:
        return [float(camera.mean_focal_length()) for camera in opened.read_all_cameras()]
    finally:
        opened.close()
