"""One channel of OpenEXR images, as depth is stored, by the package OpenEXR (the extra ``exr``)."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from warpgs.formats.packages import required

from .images import MAX_PIXELS, MAX_SIDE

MAX_CHANNELS = 64
"""Maximum number of channels, all of which are decoded."""

MAX_RATIO = 1 << 16
"""Maximum size of decoded relative to stored pixels, so that a small file cannot claim gigabytes; deflate reaches 1032,
wavelets of one value more."""

VALUE_SIZE = 4
"""Size of the largest values of a channel [bytes]."""

DAMAGED = "damaged or truncated OpenEXR data"


def exr_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height of an image without decoding it; raises as ``read_exr_channel``."""
    header = _open(path, data, header_only=True).header()
    start, end = header["dataWindow"]
    width, height = (int(last) - int(first) + 1 for first, last in zip(start, end, strict=True))
    if not 0 < min(width, height) <= max(width, height) <= MAX_SIDE:
        raise ValueError(f"{path}: an OpenEXR image of {width}×{height} pixels")
    channels = len(header["channels"])
    if channels > MAX_CHANNELS:
        raise ValueError(f"{path}: an OpenEXR image of {channels} channels, expected at most {MAX_CHANNELS}")
    if VALUE_SIZE * channels * width * height > MAX_RATIO * len(data):
        raise ValueError(f"{path}: {DAMAGED}")
    return width, height


def read_exr_channel(path: Path, data: bytes, channel: str, max_pixels: int = MAX_PIXELS) -> Float[np.ndarray, "H W"]:
    """A channel of floating-point numbers, as float32, of an image in one part.

    Args:
        path: Names the file in errors.
        data: Its content.
        channel: Name of the channel, such as "Z".
        max_pixels: Maximum number of pixels.

    Raises:
        ValueError: If the data are damaged or truncated, of another kind, too large, or lack the channel; before
            memory is allocated for more than they can hold.
        OSError: If OpenEXR is not installed.
    """
    width, height = exr_size(path, data)
    if width * height > max_pixels:
        raise ValueError(f"{path}: an OpenEXR image of {width}×{height} pixels, more than {max_pixels:,}")
    channels = _open(path, data, header_only=False).channels()
    if channel not in channels:
        raise ValueError(f"{path}: no channel {channel} among the OpenEXR channels {', '.join(channels)}")
    values = channels[channel].pixels
    if values.dtype.kind != "f" or values.shape != (height, width):
        raise ValueError(f"{path}: OpenEXR channel {channel} must hold a floating-point number for each pixel")
    return values.astype(np.float32)


def _open(path: Path, data: bytes, header_only: bool) -> Any:
    openexr = required(path, "OpenEXR", "OpenEXR", "exr")
    try:
        file = openexr.File(io.BytesIO(data), separate_channels=True, header_only=header_only, num_threads=0)
    except (RuntimeError, ValueError, TypeError, OSError) as error:  # TypeError: of attributes that are damaged
        raise ValueError(f"{path}: {DAMAGED}") from error
    if not file.parts:  # OpenEXR leaves out a part that it cannot decode
        raise ValueError(f"{path}: {DAMAGED}")
    kind = file.header().get("type", openexr.scanlineimage)
    if len(file.parts) > 1 or kind not in (openexr.scanlineimage, openexr.tiledimage):
        raise ValueError(f"{path}: not an OpenEXR image in one part, without deep pixels")
    return file
