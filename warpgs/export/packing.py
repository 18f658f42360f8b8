"""Numbers in a few bits: what the compressed PLY file and the page are made of."""

import math

import numpy as np
from jaxtyping import Float32, UInt8, UInt32

Ends = tuple[float, float] | tuple[np.ndarray, np.ndarray] | np.ndarray

ROTATION_BITS = 10
OTHERS = (-math.sqrt(0.5), math.sqrt(0.5))
"""No component of a unit quaternion beside the largest one is outside."""


def quantise(values: np.ndarray, ends: Ends, bits: int) -> np.ndarray:
    """Whole numbers of so many bits for values between two ends, which become 0 and the largest.

    Args:
        values: Of any shape.
        ends: The lowest and the highest, each of a shape that goes with the values.
        bits: At most 32.
    """
    low, high = np.asarray(ends[0], np.float64), np.asarray(ends[1], np.float64)
    span = np.where(high > low, high - low, 1.0)
    steps = (1 << bits) - 1
    return np.clip(np.rint((values - low) / span * steps), 0, steps).astype(np.uint32)


def restore(numbers: np.ndarray, ends: Ends, bits: int) -> np.ndarray:
    """The values that ``quantise`` was given, to within half a step, in double precision."""
    low, high = np.asarray(ends[0], np.float64), np.asarray(ends[1], np.float64)
    return low + numbers.astype(np.float64) / ((1 << bits) - 1) * (high - low)


def pack(fields: UInt32[np.ndarray, "N F"], widths: tuple[int, ...]) -> UInt32[np.ndarray, " N"]:
    """Fields of so many bits in one word, the first one highest."""
    word = np.zeros(len(fields), np.uint32)
    for k, width in enumerate(widths):
        word = (word << np.uint32(width)) | fields[:, k]
    return word


def unpack(words: UInt32[np.ndarray, " N"], widths: tuple[int, ...]) -> UInt32[np.ndarray, "N F"]:
    """The fields that ``pack`` was given."""
    shifts = [sum(widths[k + 1 :]) for k in range(len(widths))]
    fields = [(words >> np.uint32(s)) & np.uint32((1 << w) - 1) for s, w in zip(shifts, widths, strict=True)]
    return np.stack(fields, 1)


def pack_rotations(quats: Float32[np.ndarray, "N 4"]) -> UInt32[np.ndarray, " N"]:
    """Unit quaternions in 32 bits: which component is the largest, then the three others in 10 bits each."""
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    positive = quats * np.where(quats[rows, largest] < 0, -1.0, 1.0)[:, None]
    others = positive[_others(largest)].reshape(-1, 3)
    numbers = quantise(others, OTHERS, ROTATION_BITS)
    return pack(np.concatenate([largest[:, None].astype(np.uint32), numbers], 1), (2, *[ROTATION_BITS] * 3))


def unpack_rotations(words: UInt32[np.ndarray, " N"]) -> Float32[np.ndarray, "N 4"]:
    """The quaternions that ``pack_rotations`` was given, of length 1 and perhaps of the opposite sign."""
    fields = unpack(words, (2, *[ROTATION_BITS] * 3))
    largest = fields[:, 0].astype(np.int64)
    others = restore(fields[:, 1:], OTHERS, ROTATION_BITS)
    quats = np.empty((len(words), 4))
    quats[_others(largest)] = others.reshape(-1)
    quats[np.arange(len(words)), largest] = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(1)))
    return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def _others(largest: np.ndarray) -> np.ndarray:
    """[N, 4] true for the three components that are not the largest."""
    return np.arange(4) != largest[:, None]


def to_planes(frames: np.ndarray) -> UInt8[np.ndarray, " bytes"]:
    """Frames of whole numbers as differences from frame to frame, all lowest bytes first: gzip finds more in that."""
    changes = frames.copy()
    changes[1:] -= frames[:-1]  # wraps around, as it does on the way back
    return np.ascontiguousarray(changes.reshape(-1, 1).view(np.uint8).T).reshape(-1)


def from_planes(planes: UInt8[np.ndarray, " bytes"], shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """The frames that ``to_planes`` was given."""
    changes = np.ascontiguousarray(planes.reshape(dtype.itemsize, -1).T).view(dtype).reshape(shape)
    return np.add.accumulate(changes, axis=0, dtype=dtype)
