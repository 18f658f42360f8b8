"""Contact sheets: thumbnails of many frames with their masks or depth."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from warpgs.data.sampling import evenly_spaced_indices
from warpgs.files import write_png
from warpgs.visualize.depth import depth_image

MAX_THUMBNAILS = 30
COLUMNS = 6
THUMBNAIL_WIDTH = 256


def write_contact_sheet(path: Path, cameras: Sequence[Mapping[str, UInt8[np.ndarray, "H W 3"]]]) -> None:
    """Writes images as thumbnails, captioned by their names, six in a row; each camera begins a row.

    Args:
        path: File to write.
        cameras: [H, W, 3] images of each camera, by name.

    Raises:
        OSError: If the file cannot be written; the message names it.
    """
    columns, rows = min(COLUMNS, max(map(len, cameras))), []
    for images in cameras:
        thumbnails = [_thumbnail(image, name) for name, image in images.items()]
        thumbnails += [np.zeros_like(thumbnails[0])] * (-len(thumbnails) % columns)
        rows += [np.hstack(thumbnails[k : k + columns]) for k in range(0, len(thumbnails), columns)]
    write_png(path, np.vstack(rows))


def choose_evenly(count: int, num_cameras: int = 1) -> list[int]:
    """Indices of one camera's thumbnails, evenly spaced over ``count``: 30 of all cameras, but at least one row."""
    rows = max(1, MAX_THUMBNAILS // (COLUMNS * num_cameras))
    return evenly_spaced_indices(count, rows * COLUMNS)


def overlay_mask(image: UInt8[np.ndarray, "H W 3"], dynamic: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """[H, W, 3] the image with a bright outline around the dynamic region, and dark grey where it is static."""
    grey = 0.6 * cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)[..., None]
    painted = np.where(dynamic[..., None], image, grey).astype(np.uint8)
    edges = cv2.morphologyEx(dynamic.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    painted[edges > 0] = (255, 230, 80)
    return painted


def colored_depth(inverse_depth: Float[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """[H, W, 3] inverse depth as colours: near is red, unknown is grey."""
    return depth_image(inverse_depth, unknown=96)


def _thumbnail(image: np.ndarray, caption: str) -> np.ndarray:
    height = max(1, round(image.shape[0] * THUMBNAIL_WIDTH / image.shape[1]))
    thumbnail = cv2.resize(image, (THUMBNAIL_WIDTH, height), interpolation=cv2.INTER_AREA)
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(thumbnail, caption, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, color, thickness, cv2.LINE_AA)
    return thumbnail
