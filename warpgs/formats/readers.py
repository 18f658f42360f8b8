"""Files of Gaussians that can be opened, by their suffixes."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from warpgs.data.ply import MAX_FILE, MAX_HEADER
from warpgs.files import read_start, require_file

from .cloud import MIN_SCALE, Cloud
from .compressed import read_compressed
from .read_gltf import read_glb
from .read_sog import read_sog
from .rotation import Y_DOWN_TO_Y_UP, rotated
from .splat import read_splat
from .spz import read_spz
from .standard import read_standard

MAX_LOGIT = 80.0
"""Maximum magnitude of an opacity's logit: its opacity is 1 in single precision."""


class Reader(NamedTuple):
    """A format that is read.

    Attributes:
        read: Reads a file; raises ValueError, which names it, if it is damaged.
        y_up: Whether y points up in it, instead of down.
    """

    read: Callable[[Path], Cloud]
    y_up: bool = False


def parse_ply(path: Path) -> Cloud:
    """Reads a PLY file of 3DGS or a compressed one; other programs write infinite opacities, and scales of 0."""
    require_file(path, MAX_FILE)
    header = read_start(path, MAX_HEADER).split(b"end_header")[0]
    is_compressed = b"\nelement chunk " in header
    cloud = (read_compressed if is_compressed else read_standard)(path)
    return cloud.replaced(
        logit_opacities=np.clip(cloud.logit_opacities, -MAX_LOGIT, MAX_LOGIT),
        log_scales=np.maximum(cloud.log_scales, np.float32(np.log(MIN_SCALE))),
        antialias=b"SplatRenderMode: mip" in header,
    )


READERS: dict[str, Reader] = {
    ".ply": Reader(parse_ply),
    ".sog": Reader(read_sog),
    ".spz": Reader(read_spz, y_up=True),
    ".glb": Reader(read_glb, y_up=True),
    ".splat": Reader(read_splat),
}
"""Formats by suffix. To add one, write it in a file of its own and add a line here."""


def is_readable(path: Path) -> bool:
    """Whether a file has the suffix of a format that is read."""
    return path.suffix.lower() in READERS


def read_cloud(path: Path) -> Cloud:
    """Reads a file by its suffix, in the axes of the PLY file: y points down.

    Gaussians with values that are not finite, which nothing shows, are omitted.

    Raises:
        ValueError: If it is damaged, or has no Gaussians; the message names it.
        OSError: If it needs a package that is not installed.
    """
    reader = READERS[path.suffix.lower()]
    cloud = reader.read(path)
    if not (finite := cloud.finite).all():
        cloud = cloud.select(finite)
    if not len(cloud):
        raise ValueError(f"{path} has no Gaussians with finite values")
    return rotated(cloud, Y_DOWN_TO_Y_UP) if reader.y_up else cloud
