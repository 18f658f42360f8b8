"""SPZ of Niantic Spatial (https://github.com/nianticlabs/spz): about 20 bytes per Gaussian before compression.

Positions are fixed-point numbers of 24 bits, rotations their three smaller components in 10 bits each, and all others
8 bits: log-scales in [-10, 6), opacities, colours (coefficients of degree 0 over ±10/3) and coefficients of degree 1
and higher over [-1, 1). Version 4 compresses each attribute by Zstandard, version 3 the whole file by gzip. Positions
have as many fractional bits as their range leaves, because scene units are not metres; the header says how many.

Axes are x right, y up, z towards the viewer.
"""

import gzip
import struct
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from warpgs.files import write_bytes
from warpgs.ops.sh import degree_of

from .cloud import Cloud, sigmoid
from .packages import required
from .packing import without_max_component

MAGIC = 0x5053474E
VERSION, GZIP_VERSION = 4, 3
HEADER = struct.Struct("<IIIBBBB")
"""Magic number, version, number of Gaussians, degree, fractional bits, flags, number of streams."""

ANTIALIAS = 1
"""Flag of a cloud whose opacities compensate for the low-pass filter."""

POSITION_BITS = 24
MAX_FRACTION = 20
"""Maximum number of fractional bits of a position."""

COLOR_SCALE = 0.15
LEVEL = 12
"""Compression level of Zstandard, that of the reference implementation."""


def write_spz(path: Path, cloud: Cloud) -> int:
    """Writes a cloud as SPZ of version 4; returns the size of the file [bytes].

    Raises:
        OSError: If it cannot be written or zstandard is not installed; the message says which.
        ValueError: If a position is too large.
    """
    streams = [stream.tobytes() for stream in _streams(path, cloud)]
    compressor = required(path, "zstandard", "zstandard").ZstdCompressor(level=LEVEL)
    compressed = [compressor.compress(stream) for stream in streams]
    contents = b"".join(struct.pack("<QQ", *map(len, sizes)) for sizes in zip(compressed, streams, strict=True))
    toc_offset = HEADER.size + 16
    header = _header(cloud, VERSION, len(streams)) + struct.pack("<I12x", toc_offset)
    return write_bytes(path, [header, contents, *compressed])


def write_spz_gzip(path: Path, cloud: Cloud) -> int:
    """Writes a cloud as SPZ of version 3; returns the size of the file [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
        ValueError: If a position is too large.
    """
    streams = [stream.tobytes() for stream in _streams(path, cloud)]
    return write_bytes(path, [gzip.compress(b"".join([_header(cloud, GZIP_VERSION, 0), *streams]), mtime=0)])


def _header(cloud: Cloud, version: int, num_streams: int) -> bytes:
    flags = ANTIALIAS if cloud.antialias else 0
    degree = degree_of(cloud.sh.shape[1])
    return HEADER.pack(MAGIC, version, len(cloud), degree, _fraction_bits(cloud), flags, num_streams)


def _fraction_bits(cloud: Cloud) -> int:
    """Number of bits after the point such that every position fits into ``POSITION_BITS`` with a sign."""
    reach = max(1.0, float(np.abs(cloud.means).max(initial=0.0)))
    return min(MAX_FRACTION, POSITION_BITS - 2 - int(np.floor(np.log2(reach))))


def _streams(path: Path, cloud: Cloud) -> list[UInt8[np.ndarray, "..."]]:
    """Positions, opacities, colours, scales, rotations, and coefficients unless the degree is 0."""
    bits = _fraction_bits(cloud)
    if bits < 0:
        raise ValueError(f"{path}: SPZ holds positions up to {1 << (POSITION_BITS - 1):,}, got a larger one")
    limit = (1 << (POSITION_BITS - 1)) - 1
    fixed = np.clip(np.rint(cloud.means.astype(np.float64) * (1 << bits)), -limit, limit).astype("<i4")
    streams = [
        fixed[..., None].view(np.uint8)[..., :3],
        _byte(255 * sigmoid(cloud.logit_opacities.astype(np.float64))),
        _byte(255 * (COLOR_SCALE * cloud.sh[:, 0].astype(np.float64) + 0.5)),
        _byte(16 * (cloud.log_scales.astype(np.float64) + 10)),
        _rotations(cloud.quats).astype("<u4").view(np.uint8),
    ]
    if cloud.sh.shape[1] > 1:
        streams.append(_byte(128 * cloud.sh[:, 1:].astype(np.float64) + 128))
    return streams


def _byte(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _rotations(quats: np.ndarray) -> np.ndarray:
    """[N] words: the index of the largest component in the order x, y, z, w, then a sign and 9 bits for each other."""
    largest, others = without_max_component(np.roll(quats, -1, axis=1))
    size = np.floor(511 * np.abs(others) * np.sqrt(2) + 0.5).clip(0, 511).astype(np.uint32)
    words = largest.astype(np.uint32)
    for k in range(3):
        words = words << np.uint32(10) | (others[:, k] < 0).astype(np.uint32) << np.uint32(9) | size[:, k]
    return words
