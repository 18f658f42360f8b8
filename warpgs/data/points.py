"""The sparse points of a capture."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from warpgs.files import read_array

from .colmap import load_model
from .units import SceneUnits

MAX_POINTS = 50_000_000
"""Maximum number of points, because the header of a file may claim any number."""


def read_points(root: Path, units: SceneUnits) -> tuple[Float[Tensor, "P 3"], UInt8[Tensor, "P 3"] | None]:
    """Points in scene units and their colours, from points.npy and point_colors.npy or else a COLMAP model in sparse/0.

    A capture that has neither has zero points.

    Raises:
        ValueError: If the file is damaged, empty or has points that are not finite.
    """
    path, model = root / "points.npy", root / "sparse" / "0"
    colors = None
    if path.exists():
        points = read_array(path, 3 * MAX_POINTS).astype(np.float64)
        colors = _read_colors(root / "point_colors.npy", points.shape)
    elif model.is_dir():
        path = model
        _, points, stored, _ = load_model(model)
        colors = torch.from_numpy(stored)
    else:
        return torch.zeros(0, 3, dtype=torch.float32), None
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"{path} must hold finite points, [P, 3] with P > 0, got shape {list(points.shape)}")
    try:
        return torch.tensor(units.from_world(points), dtype=torch.float32), colors
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _read_colors(path: Path, shape: tuple[int, ...]) -> UInt8[Tensor, "P 3"] | None:
    if not path.exists():
        return None
    colors = read_array(path, 3 * MAX_POINTS)
    if colors.shape != shape or colors.dtype != np.uint8:
        raise ValueError(f"{path} must hold bytes of shape {list(shape)}, got {colors.dtype} {list(colors.shape)}")
    return torch.from_numpy(colors)
