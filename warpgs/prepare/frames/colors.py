"""Converts decoded frames of a video to 8-bit sRGB, whatever their range, colour matrix and dynamic range.

HDR videos of phones (HLG, PQ) have BT.2020 primaries. They are converted to linear light in units of the reference
white, 203 cd/m² (ITU-R BT.2408), by the EOTF of BT.2100; the primaries by the matrix of BT.2087; and bright light is
compressed by

    y = x  for x ≤ k,    y = k + (1 − k) (1 − exp(−(x − k) / (1 − k)))  above,

applied to the largest of the three channels, so that hues stay. The same curve for all frames: no flicker.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8, UInt16

from .images import resize_to_side

PQ, HLG = 16, 18
"""Transfer characteristics of SMPTE ST 2084 and ARIB STD-B67 (ITU-T H.273)."""

UNSPECIFIED = (0, 2)
"""Values of a colour matrix that is not stated (ITU-T H.273)."""

ITU601, ITU709, FULL_RANGE = 5, 1, 2
"""FFmpeg's numbers of the matrices, and of the range 0 to 255."""

MIN_HD_SIDE = 700
"""Shorter side from which on a video without a stated matrix has that of BT.709, as players assume [px]."""

REFERENCE_WHITE = 203.0
"""Luminance of white paper in HDR [cd/m²]."""

HLG_PEAK, HLG_GAMMA = 1000.0, 1.2
"""Peak luminance of the nominal HLG display [cd/m²], and its system gamma."""

KNEE = 0.6
"""Linear light above which HDR is compressed."""

BT709_FROM_BT2020 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]], np.float32
)
"""Linear RGB with the primaries of BT.709 from those of BT.2020 (ITU-R BT.2087)."""

BT2020_LUMINANCE = np.array([0.2627, 0.6780, 0.0593], np.float32)


def to_rgb(frame: Any, transfer: int, longest_side: int) -> UInt8[np.ndarray, "H W 3"]:
    """[H, W, 3] a decoded frame in sRGB, rotated as its display matrix says.

    Args:
        frame: PyAV's ``VideoFrame``.
        transfer: Transfer characteristics of the stream (ITU-T H.273).
        longest_side: HDR frames may be scaled down to it before they are converted [px].
    """
    matrix = int(frame.colorspace)
    if matrix in UNSPECIFIED:
        matrix = ITU709 if min(frame.width, frame.height) >= MIN_HD_SIDE else ITU601
    deep = transfer in (PQ, HLG)
    converted = frame.reformat(
        format="rgb48le" if deep else "rgb24", src_colorspace=matrix, dst_color_range=FULL_RANGE
    ).to_ndarray()
    rgb = srgb_from_hdr(resize_to_side(converted, longest_side, 1.0), transfer) if deep else converted
    return np.ascontiguousarray(np.rot90(rgb, quarter_turns(frame)))


def quarter_turns(frame: Any) -> int:
    """By how many quarter turns to the left the display matrix of PyAV's frame rotates it."""
    return round(frame.rotation / 90)


def srgb_from_hdr(encoded: UInt16[np.ndarray, "H W 3"], transfer: int) -> UInt8[np.ndarray, "H W 3"]:
    """[H, W, 3] sRGB of an HDR image with BT.2020 primaries, encoded with the transfer characteristics PQ or HLG."""
    linear = (_pq_light if transfer == PQ else _hlg_light)(encoded.astype(np.float32) / 65535.0)
    linear = np.maximum(linear @ BT709_FROM_BT2020.T, 0.0)
    largest = np.maximum(linear.max(-1, keepdims=True), 1e-6)  # no division by black
    over = np.maximum(largest - KNEE, 0.0)
    linear *= (np.minimum(largest, KNEE) + (1.0 - KNEE) * (1.0 - np.exp(-over / (1.0 - KNEE)))) / largest
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)
    return (255.0 * srgb).round().astype(np.uint8)


def _pq_light(x: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Light in units of the reference white, by the EOTF of SMPTE ST 2084."""
    m1, m2 = 2610 / 16384, 2523 / 4096 * 128
    c1, c2, c3 = 3424 / 4096, 2413 / 4096 * 32, 2392 / 4096 * 32
    power = x ** (1 / m2)
    return (10_000.0 / REFERENCE_WHITE * (np.maximum(power - c1, 0.0) / (c2 - c3 * power)) ** (1 / m1)).astype(x.dtype)


def _hlg_light(x: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    """Light in units of the reference white, by the inverse OETF and the OOTF of HLG (ITU-R BT.2100)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    scene = np.where(x <= 0.5, x * x / 3.0, (np.exp((x - c) / a) + b) / 12.0).astype(x.dtype)
    luminance = np.maximum(scene @ BT2020_LUMINANCE, 1e-6)[..., None]  # no negative power of black
    return HLG_PEAK / REFERENCE_WHITE * luminance ** (HLG_GAMMA - 1.0) * scene
