"""SPZ of Niantic Spatial (https://github.com/nianticlabs/spz): about 20 bytes per Gaussian before compression.

Positions are fixed-point numbers of 24 bits, rotations their three smaller components in 10 bits each, and all others
8 bits: log-scales in [-10, 6), opacities, colours (coefficients of degree 0 over ±10/3) and coefficients of degree 1
and higher over [-1, 1). Version 4 compresses each attribute by Zstandard, version 3 the whole file by gzip. Positions
have as many fractional bits as their range leaves, because scene units are not metres; the header says how many.

Axes are x right, y up, z towards the viewer.
"""

import gzip
import struct
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8, UInt32

from warpgs.files import read_start, require_file, write_bytes
from warpgs.ops.sh import MAX_DEGREE, degree_of, num_bases

from .bounds import MAX_BYTES, require_plausible
from .cloud import Cloud, logit, sigmoid, unit_quats
from .packages import required
from .packing import unpack, with_max_component, without_max_component

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
GZIP = b"\x1f\x8b"
MAX_SPZ_DEGREE, MAX_BITS = 4, 24
"""Maximum degree of spherical harmonics, and number of fractional bits, of a file."""

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


def read_spz(path: Path) -> Cloud:
    """Reads SPZ of versions 1 to 4; coefficients of degree 4, which only SPZ has, are dropped.

    Raises:
        ValueError: If it is another file, damaged, or too large for its size; the message names it.
        OSError: If it is of version 4 and zstandard is not installed.
    """
    size = require_file(path, MAX_BYTES)
    data = read_start(path, size)
    if len(data) < HEADER.size:
        raise ValueError(f"{path} is not an SPZ file: it has {len(data)} bytes")
    is_zipped = data[:2] == GZIP
    magic, version, count, degree, bits, flags, streams = HEADER.unpack(
        _inflated(path, data, HEADER.size) if is_zipped else data[: HEADER.size]
    )
    if magic != MAGIC or version not in ((1, 2, 3) if is_zipped else (VERSION,)):
        raise ValueError(f"{path} is not an SPZ file of version 1 to 4")
    if degree > MAX_SPZ_DEGREE or bits > MAX_BITS:
        raise ValueError(f"{path} is damaged: degree {degree}, {bits} fractional bits")
    widths = (6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * ((degree + 1) ** 2 - 1))
    sizes = [width * count for width in widths]
    require_plausible(path, sum(sizes), size)
    if is_zipped:
        content = _inflated(path, data, HEADER.size + sum(sizes))[HEADER.size :]
        ends = np.cumsum(sizes)
        parts = [content[end - size : end] for end, size in zip(ends, sizes, strict=True)]
    else:
        parts = _decompressed(path, data, streams, sizes)
    return _cloud(version, bits, bool(flags & ANTIALIAS), [np.frombuffer(part, np.uint8) for part in parts])


def _inflated(path: Path, data: bytes, size: int) -> bytes:
    """The first bytes of what gzip has compressed."""
    try:
        content = zlib.decompressobj(16 + zlib.MAX_WBITS).decompress(data, size)
    except zlib.error as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if len(content) < size:
        raise ValueError(f"{path} is truncated: its header claims {size:,} bytes, it has {len(content):,}")
    return content


def _decompressed(path: Path, data: bytes, count: int, sizes: list[int]) -> list[bytes]:
    """The streams of a file of version 4, of given sizes, empty ones of which are omitted."""
    zstandard = required(path, "zstandard", "zstandard")
    expected = [size for size in sizes if size]
    parts: list[bytes] = []
    try:
        (start,) = struct.unpack_from("<I", data, HEADER.size)
        contents = [struct.unpack_from("<QQ", data, start + 16 * k) for k in range(count)]
        offset = start + 16 * count
        if [size for _, size in contents] not in (expected, sizes):
            raise ValueError(f"its streams have {[size for _, size in contents]} bytes, expected {expected}")
        for length, size in contents:
            stream = zstandard.ZstdDecompressor().stream_reader(data[offset : offset + length])
            part = stream.read(size)
            if len(part) < size or offset + length > len(data):
                raise ValueError("a stream is truncated")
            parts, offset = [*parts, part], offset + length
    except (struct.error, ValueError, OverflowError, zstandard.ZstdError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    missing = iter([part for part in parts if part])
    return [next(missing) if size else b"" for size in sizes]


def _cloud(version: int, bits: int, antialias: bool, parts: list[UInt8[np.ndarray, "..."]]) -> Cloud:
    """The cloud of the streams of a file."""
    positions, opacities, colors, scales, rotations, rest = parts
    N = len(opacities)
    if version == 1:
        means = positions.view("<f2").reshape(N, 3).astype(np.float32)
    else:
        low, middle, high = np.moveaxis(positions.reshape(N, 3, 3).astype(np.int32), 2, 0)
        fixed = low | middle << 8 | high << 16
        means = ((fixed ^ 0x800000) - 0x800000) / np.float32(1 << bits)
    constant = (colors.reshape(N, 1, 3) / 255 - 0.5) / COLOR_SCALE
    others = (rest.reshape(N, -1, 3) / 128 - 1)[:, : num_bases(MAX_DEGREE) - 1] if len(rest) else np.zeros((N, 0, 3))
    return Cloud(
        means=means.astype(np.float32),
        quats=_first_three(rotations.reshape(N, 3)) if version < 3 else _smallest_three(rotations.view("<u4")),
        log_scales=(scales.reshape(N, 3) / 16 - 10).astype(np.float32),
        logit_opacities=logit(opacities / 255).astype(np.float32),
        sh=np.concatenate([constant, others], 1).astype(np.float32),
        is_dynamic=np.zeros(N, bool),
        antialias=antialias,
    )


def _first_three(values: UInt8[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 4"]:
    """Quaternions of versions 1 and 2: x, y, z, and w ≥ 0."""
    others = values / 127.5 - 1
    w = np.sqrt(np.maximum(0.0, 1 - (others**2).sum(1, keepdims=True)))
    return unit_quats(np.concatenate([w, others], 1))


def _smallest_three(words: UInt32[np.ndarray, " N"]) -> Float32[np.ndarray, "N 4"]:
    """Quaternions of versions 3 and 4: the inverse of ``_rotations``."""
    fields = unpack(words, (2, 1, 9, 1, 9, 1, 9)).astype(np.int64)
    others = np.where(fields[:, 1::2] == 1, -1, 1) * fields[:, 2::2] / (511 * np.sqrt(2))
    return unit_quats(np.roll(with_max_component(fields[:, 0], others), 1, axis=1))
