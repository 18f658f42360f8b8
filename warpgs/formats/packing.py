"""Quantisation and bit packing, for the compressed PLY file and the page."""

import math

import numpy as np
from jaxtyping import Float, Float32, Float64, Int32, Int64, UInt8, UInt32

Range = tuple[float, float] | tuple[np.ndarray, np.ndarray] | np.ndarray
"""A minimum and a maximum, each of a shape that broadcasts with the values."""

ROTATION_BITS = 10
COMPONENT_RANGE = (-math.sqrt(0.5), math.sqrt(0.5))
"""Range of the three smaller components of a unit quaternion."""


def quantise(values: np.ndarray, bounds: Range, bits: int) -> np.ndarray:
    """Maps values linearly to integers of ``bits`` bits: the minimum to 0, the maximum to the largest integer.

    Args:
        values: Array of any shape; values out of bounds are clipped.
        bounds: Minimum and maximum.
        bits: At most 32.
    """
    low, high = np.asarray(bounds[0], np.float64), np.asarray(bounds[1], np.float64)
    span = np.where(high > low, high - low, 1.0)
    steps = (1 << bits) - 1
    return np.clip(np.rint((values - low) / span * steps), 0, steps).astype(np.uint32)


def dequantise(integers: np.ndarray, bounds: Range, bits: int) -> np.ndarray:
    """The values that were quantised, to within half a step, in double precision."""
    low, high = np.asarray(bounds[0], np.float64), np.asarray(bounds[1], np.float64)
    return low + integers.astype(np.float64) / ((1 << bits) - 1) * (high - low)


def pack(fields: UInt32[np.ndarray, "N F"], widths: tuple[int, ...]) -> UInt32[np.ndarray, " N"]:
    """Packs fields of ``widths`` bits into one word, the first field in the highest bits."""
    word = np.zeros(len(fields), np.uint32)
    for k, width in enumerate(widths):
        word = (word << np.uint32(width)) | fields[:, k]
    return word


def unpack(words: UInt32[np.ndarray, " N"], widths: tuple[int, ...]) -> UInt32[np.ndarray, "N F"]:
    """The fields that ``pack`` packed."""
    shifts = [sum(widths[k + 1 :]) for k in range(len(widths))]
    fields = [(words >> np.uint32(s)) & np.uint32((1 << w) - 1) for s, w in zip(shifts, widths, strict=True)]
    return np.stack(fields, 1)


def pack_rotations(quats: Float32[np.ndarray, "N 4"]) -> UInt32[np.ndarray, " N"]:
    """Packs unit quaternions into 32 bits: the index of the largest component, then the others in 10 bits each."""
    largest, others = without_max_component(quats)
    integers = quantise(others, COMPONENT_RANGE, ROTATION_BITS)
    return pack(np.concatenate([largest[:, None].astype(np.uint32), integers], 1), (2, *[ROTATION_BITS] * 3))


def unpack_rotations(words: UInt32[np.ndarray, " N"]) -> Float32[np.ndarray, "N 4"]:
    """The unit quaternions that ``pack_rotations`` packed, up to their sign."""
    fields = unpack(words, (2, *[ROTATION_BITS] * 3))
    largest = fields[:, 0].astype(np.int64)
    quats = with_max_component(largest, dequantise(fields[:, 1:], COMPONENT_RANGE, ROTATION_BITS))
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def without_max_component(
    quats: Float[np.ndarray, "N 4"],
) -> tuple[Int64[np.ndarray, " N"], Float64[np.ndarray, "N 3"]]:
    """[N] index of the component of maximum magnitude, and [N, 3] the others, with signs that make it positive."""
    largest = np.abs(quats).argmax(1)
    positive = quats * np.where(quats[np.arange(len(quats)), largest] < 0, -1.0, 1.0)[:, None]
    return largest, positive[_smaller(largest)].reshape(-1, 3)


def with_max_component(
    largest: Int64[np.ndarray, " N"], others: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 4"]:
    """The quaternions of ``without_max_component``; longer than 1 if the others are."""
    quats = np.empty((len(largest), 4))
    quats[_smaller(largest)] = others.reshape(-1)
    quats[np.arange(len(largest)), largest] = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(1)))
    return quats


def _smaller(largest: np.ndarray) -> np.ndarray:
    """[N, 4] mask of the three components that are not the largest."""
    return np.arange(4) != largest[:, None]


def to_planes(levels: Int32[np.ndarray, "K N C"]) -> UInt8[np.ndarray, " bytes"]:
    """Integers around zero as bytes, all lowest bytes first, without the highest ones that are zero.

    A sign becomes the lowest bit: 0, −1, 1, −2 … are 0, 1, 2, 3 … Values of one key and channel are next to each other.
    """
    values = np.ascontiguousarray(levels.transpose(0, 2, 1)).reshape(-1)
    unsigned = ((values << 1) ^ (values >> 31)).view(np.uint32)
    used = -(-int(unsigned.max(initial=1)).bit_length() // 8)
    return np.ascontiguousarray(unsigned.astype("<u4").view(np.uint8).reshape(-1, 4).T[:used]).reshape(-1)
