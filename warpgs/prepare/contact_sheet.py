"""Contact sheets: many frames at a glance, with their masks or depth."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

MAX_TILES = 30
COLUMNS = 6
TILE_WIDTH = 256


def sheet(pictures: Sequence[UInt8[np.ndarray, "H W 3"]], captions: Sequence[str]) -> UInt8[np.ndarray, "A B 3"]:
    """The pictures, scaled down and captioned, in rows of six."""
    tiles = [_tile(picture, caption) for picture, caption in zip(pictures, captions, strict=True)]
    columns = min(COLUMNS, len(tiles))
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])


def spread(count: int) -> list[int]:
    """At most 30 places, evenly spread over ``count``."""
    return np.unique(np.linspace(0, count - 1, min(count, MAX_TILES)).round().astype(int)).tolist()


def with_mask(image: UInt8[np.ndarray, "H W 3"], moving: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """The picture with what moves in red under a bright outline."""
    red = np.array([255, 40, 40])
    painted = np.where(moving[..., None], 0.55 * image + 0.45 * red, image).astype(np.uint8)
    edges = cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    painted[edges > 0] = (255, 230, 80)
    return painted


def of_depth(inverse_depth: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """Inverse depth in colours, near is red; grey where unknown."""
    known = np.isfinite(inverse_depth)
    low, high = np.percentile(inverse_depth[known], [2, 98]) if known.any() else (0.0, 1.0)
    level = np.clip((np.where(known, inverse_depth, low) - low) / max(high - low, 1e-12), 0, 1)
    colors = cv2.cvtColor(cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    colors[~known] = 96
    return colors


def _tile(picture: np.ndarray, caption: str) -> np.ndarray:
    height = max(1, round(picture.shape[0] * TILE_WIDTH / picture.shape[1]))
    tile = cv2.resize(picture, (TILE_WIDTH, height), interpolation=cv2.INTER_AREA)
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(tile, caption, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, thickness, cv2.LINE_AA)
    return tile
