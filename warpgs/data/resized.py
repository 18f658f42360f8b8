"""Images, masks and depth of any resolution, resized to that of the camera; captures of smaller images."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.files import read_array

from .capture import Capture, Frame
from .images import (
    MAX_PIXELS,
    decode,
    exchanged_sides,
    fill_transparent,
    has_shape,
    is_bright,
    to_8_bits,
    turned,
)

WHITE = 255


def read_resized_image(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit RGB image, resized to ``size`` (width, height); transparent pixels are inpainted.

    Args:
        path: PNG or JPEG file.
        size: Width and height of the result; the file may have any size of about the same shape.

    Raises:
        ValueError: If the file is missing, damaged or of another shape.
    """
    return resize(fill_transparent(_read(path, size)), size)


def read_resized_over_white(
    path: Path, size: tuple[int, int]
) -> UInt8[np.ndarray, "H W 3"] | UInt8[np.ndarray, "H W 4"]:
    """8-bit RGB image, resized as by ``read_resized_image``, but composited over white if the file has alpha.

    Then there is a fourth channel: 0 where a pixel is entirely transparent, and 255 elsewhere.
    """
    stored = _read(path, size)
    if stored.ndim == 2 or stored.shape[2] < 4:
        return resize(fill_transparent(stored), size)
    alpha = stored[..., 3:].astype(np.float32) / 255.0
    blended = stored[..., 2::-1] * alpha + WHITE * (1.0 - alpha)
    is_empty = resize_mask(stored[..., 3] == 0, size)
    return np.dstack([resize(blended.round().astype(np.uint8), size), np.where(is_empty, 0, 255).astype(np.uint8)])


def _read(path: Path, size: tuple[int, int]) -> UInt8[np.ndarray, "h w ..."]:
    """The stored image with 8 bits per channel, in OpenCV's order, if it has the shape of ``size``."""
    return _fitting(path, "the image", to_8_bits(decode(path)), size)


def read_resized_mask(path: Path, size: tuple[int, int], image: Path | None = None) -> Bool[np.ndarray, "H W"]:
    """True where a mask file is bright, resized to ``size`` (width, height).

    Masks of 0 and 1, 0 and 255, or 0 and 65535. A pixel of a reduced mask is dark if any part of it is. ``image`` is
    the image that it belongs to, whose EXIF orientation it may share.

    Raises:
        ValueError: If the file is missing, damaged or of another shape.
    """
    return resize_mask(is_bright(path, _fitting(path, "the mask", decode(path), size, image)), size)


def read_metric_depth(
    path: Path, size: tuple[int, int], unit: float, image: Path | None = None
) -> Float[np.ndarray, "H W"]:
    """Inverse depth of a file of depth along the camera's z axis, resized to ``size``; NaN where unknown.

    Args:
        path: A PNG file of 8 or 16 bits, or a .npy file.
        size: Width and height of the result.
        unit: World units per unit of the file.
        image: The image that it belongs to, whose EXIF orientation it may share.

    Raises:
        ValueError: If the file is missing, damaged or of another shape.
    """
    stored = read_array(path, MAX_PIXELS) if path.suffix.lower() == ".npy" else decode(path)
    stored = stored[..., 0] if stored.ndim == 3 and stored.shape[2] == 1 else stored
    if stored.ndim != 2:
        raise ValueError(f"{path}: depth must be one channel, [H, W], got shape {list(stored.shape)}")
    stored = _fitting(path, "the depth", stored, size, image)
    with np.errstate(over="ignore", invalid="ignore"):
        return inverse_of(stored.astype(np.float32) * np.float32(unit), size)


def inverse_of(depth: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "H W"]:
    """1 / depth, resized to ``size`` (width, height) without interpolation; NaN where depth is not positive."""
    with np.errstate(over="ignore"):  # what is not finite then is unknown
        depth = depth.astype(np.float32)
        known = np.isfinite(depth) & (depth > 0)
        inverse = np.full(depth.shape, np.nan, np.float32)
        inverse[known] = 1.0 / depth[known]
    inverse[~np.isfinite(inverse)] = np.nan
    return resize_inverse(inverse, size)


def resize_inverse(inverse_depth: Float[np.ndarray, "h w"], size: tuple[int, int]) -> Float[np.ndarray, "H W"]:
    """The inverse depth in another size, without interpolation, which would invent surfaces along edges."""
    return cv2.resize(inverse_depth, size, interpolation=cv2.INTER_NEAREST_EXACT)


def resize(image: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "H W 3"]:
    """The image in another size, averaged over pixels where it shrinks."""
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def resize_mask(static: Bool[np.ndarray, "h w"], size: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
    """The static mask in another size: dynamic where any part of a pixel is."""
    if static.shape[1::-1] == size:
        return static
    dynamic = cv2.resize(np.where(static, 0, 255).astype(np.uint8), size, interpolation=cv2.INTER_AREA)
    return dynamic == 0


def size_within(size: tuple[int, int], max_side: int) -> tuple[int, int]:
    """A (width, height) scaled down so that the longer side has at most ``max_side`` pixels."""
    factor = min(1.0, max_side / max(size))
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def reduced_capture(capture: Capture, max_side: int) -> Capture:
    """The capture with frames of at most ``max_side`` pixels along the larger side; larger frames are averaged."""
    cameras = {name: c.resized(*size_within(c.size, max_side)) for name, c in capture.cameras.items()}
    return replace(capture, cameras=cameras, read=partial(_read_reduced, capture, cameras))


def _read_reduced(capture: Capture, cameras: Mapping[str, Camera], name: str) -> Frame:
    return reduced_frame(capture.frame(name), cameras[name])


def reduced_frame(frame: Frame, camera: Camera) -> Frame:
    """A frame in the size of a camera; pixels are dynamic where any part of them is, and empty where all of it is."""

    def whole(mask: Tensor | None) -> Tensor | None:
        return None if mask is None else torch.from_numpy(resize_mask(mask.numpy(), camera.size))

    depth = frame.inverse_depth
    if depth is not None:
        depth = torch.from_numpy(resize_inverse(depth.numpy(), camera.size))
    image = torch.from_numpy(resize(frame.image.numpy(), camera.size))
    return Frame(frame.name, camera, image, whole(frame.static_mask), depth, whole(frame.covisible), whole(frame.empty))


def check_shape(path: Path, what: str, stored: tuple[int, int], size: tuple[int, int]) -> None:
    """Checks that a (width, height) is a multiple of ``size``, apart from rounding to whole pixels.

    Raises:
        ValueError: If it is not; the message names the file.
    """
    if not has_shape(stored, size):
        raise ValueError(
            f"{path}: {what} is {stored[0]}×{stored[1]}, but the images of its camera are {size[0]}×{size[1]}"
            f"{exchanged_sides(path, stored, lambda other: has_shape(other, size))}"
        )


def _fitting(
    path: Path, what: str, stored: np.ndarray, size: tuple[int, int], image: Path | None = None
) -> Shaped[np.ndarray, "h w ..."]:
    """Stored pixels with the shape of ``size``, turned if their EXIF orientation, or their image's, says so."""
    pixels = turned(path, stored, lambda other: has_shape(other, size), image)
    check_shape(path, what, (pixels.shape[1], pixels.shape[0]), size)
    return pixels
