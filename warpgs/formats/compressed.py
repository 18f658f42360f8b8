"""Compressed PLY as SuperSplat and PlayCanvas write and read it: 16 bytes per Gaussian and one byte per coefficient.

Gaussians are grouped into chunks of 256 neighbours. A chunk stores the range of its positions, of its log-scales and
of its colours; a Gaussian stores its values relative to these ranges: positions and scales in 11, 10 and 11 bits,
colours and opacity in 8 bits each. Rotations store their three smaller components in 10 bits each. Coefficients of
degree 1 and higher have 8 bits over [-4, 4], all of red first.
"""

from pathlib import Path

import numpy as np

from warpgs.data.ply import read_ply
from warpgs.model.gaussians import SH_C0

from .cloud import Cloud, logit, sigmoid
from .packing import dequantise, pack, pack_rotations, quantise, unpack, unpack_rotations
from .ply import column, write_ply
from .standard import num_rest, render_mode

CHUNK = 256
VECTOR_BITS = (11, 10, 11)
COLOR_BITS = (8, 8, 8, 8)
REST = (-4.0, 4.0)
"""Range of the coefficients of degree 1 and higher."""

SCALE_RANGE = 20.0
"""Maximum magnitude of a log-scale, as in other programs."""

RANGES = [
    *(f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"),
    *(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
]
WORDS = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]


def write_compressed(path: Path, cloud: Cloud) -> int:
    """Writes the Gaussians of a cloud in Morton order; returns the size of the file [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
    """
    cloud = cloud.select(morton_order(cloud.means))
    N = len(cloud)
    first = np.arange(0, N, CHUNK)
    log_scales = np.clip(cloud.log_scales, -SCALE_RANGE, SCALE_RANGE)
    parts = (cloud.means, log_scales, 0.5 + SH_C0 * cloud.sh[:, 0])
    bounds = [(_per_chunk(np.minimum, part, first), _per_chunk(np.maximum, part, first)) for part in parts]
    chunk = np.concatenate([end for pair in bounds for end in pair], 1).astype("<f4")
    position, scale = (
        pack(_quantise_in_chunk(part, chunk, k, VECTOR_BITS), VECTOR_BITS)
        for k, part in enumerate((cloud.means, log_scales))
    )
    opacity = quantise(sigmoid(cloud.logit_opacities.astype(np.float64)), (0.0, 1.0), 8)
    rgb = _quantise_in_chunk(parts[2], chunk, 2, COLOR_BITS[:3])
    color = pack(np.concatenate([rgb, opacity[:, None]], 1), COLOR_BITS)
    words = np.stack([position, pack_rotations(cloud.quats), scale, color], 1).astype("<u4")
    tables = {"chunk": _table(chunk, RANGES), "vertex": _table(words, WORDS)}
    if rest := cloud.sh.shape[1] - 1:
        values = cloud.sh[:, 1:].transpose(0, 2, 1).reshape(N, 3 * rest)
        integers = quantise(values, REST, 8).astype(np.uint8)
        tables["sh"] = _table(integers, [f"f_rest_{k}" for k in range(3 * rest)])
    return write_ply(path, tables, render_mode(cloud))


def read_compressed(path: Path) -> Cloud:
    """Reads the Gaussians of a compressed PLY file.

    Raises:
        ValueError: If it is another file, damaged, or has values that are not finite; the message names it.
    """
    tables = read_ply(path)
    if not {"chunk", "vertex"} <= tables.keys():
        raise ValueError(f"{path} is not a compressed PLY file: it has no element chunk or vertex")
    vertex = tables["vertex"]
    N = len(vertex)
    chunk = _ranges(path, tables["chunk"], N)
    if not np.isfinite(chunk).all():
        raise ValueError(f"{path} has ranges that are not finite")
    words = np.stack([column(path, vertex, name, "u").astype(np.uint32) for name in WORDS], 1)
    color = unpack(words[:, 3], COLOR_BITS)
    rows = np.repeat(chunk, CHUNK, 0)[:N].reshape(N, 3, 2, 3)
    rgb = dequantise(color[:, :3], (rows[:, 2, 0], rows[:, 2, 1]), 8)
    constant = ((rgb - 0.5) / SH_C0)[:, None]
    return Cloud(
        means=_dequantise_vectors(words[:, 0], rows[:, 0]),
        quats=unpack_rotations(words[:, 1]),
        log_scales=_dequantise_vectors(words[:, 2], rows[:, 1]),
        logit_opacities=logit(color[:, 3] / 255.0).astype(np.float32),
        sh=np.concatenate([constant, _read_rest(path, tables.get("sh"), N)], 1).astype(np.float32),
        is_dynamic=np.zeros(N, bool),
    )


def _per_chunk(reduction: np.ufunc, values: np.ndarray, first: np.ndarray) -> np.ndarray:
    return reduction.reduceat(values, first, axis=0) if len(values) else values


def _quantise_in_chunk(values: np.ndarray, chunk: np.ndarray, part: int, widths: tuple[int, ...]) -> np.ndarray:
    """Quantises each axis of [N, 3] values over its range in the chunk, with ``widths`` bits."""
    ranges = chunk.reshape(len(chunk), 3, 2, 3)[np.arange(len(values)) // CHUNK, part]
    axes = [quantise(values[:, a], (ranges[:, 0, a], ranges[:, 1, a]), width) for a, width in enumerate(widths)]
    return np.stack(axes, 1)


def _dequantise_vectors(words: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    fields = unpack(words, VECTOR_BITS)
    axes = [dequantise(fields[:, a], (ranges[:, 0, a], ranges[:, 1, a]), width) for a, width in enumerate(VECTOR_BITS)]
    return np.stack(axes, 1).astype(np.float32)


def _ranges(path: Path, table: np.ndarray, num_vertices: int) -> np.ndarray:
    """[chunks, 18] ranges; older files have no ranges of colours, which are then [0, 1]."""
    expected = -(-num_vertices // CHUNK)
    if len(table) != expected:
        raise ValueError(f"{path} has {len(table):,} chunks, expected {expected:,} for {num_vertices:,} Gaussians")
    names = table.dtype.names or ()
    has_colors = "min_r" in names
    columns = [column(path, table, name).astype(np.float32) for name in (RANGES if has_colors else RANGES[:12])]
    if not has_colors:
        columns += [np.full(len(table), float(k >= 3), np.float32) for k in range(6)]
    return np.stack(columns, 1)


def _read_rest(path: Path, table: np.ndarray | None, num_vertices: int) -> np.ndarray:
    """[N, R, 3] coefficients of degree 1 and higher."""
    if table is not None and len(table) != num_vertices:
        raise ValueError(f"{path} has {len(table):,} rows of sh for {num_vertices:,} Gaussians")
    rest = 0 if table is None else num_rest(path, table)
    if table is None or rest == 0:
        return np.zeros((num_vertices, 0, 3), np.float32)
    integers = np.stack([column(path, table, f"f_rest_{k}", "u") for k in range(3 * rest)], 1).astype(np.uint32)
    values = dequantise(integers, REST, 8)
    return values.reshape(-1, 3, rest).transpose(0, 2, 1)


def morton_order(means: np.ndarray) -> np.ndarray:
    """Row indices along a Morton curve, so that the Gaussians of a chunk are close together."""
    if not len(means):
        return np.zeros(0, np.int64)
    cells = quantise(means, (means.min(0), means.max(0)), 10).astype(np.uint64)
    code = np.zeros(len(means), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def _table(values: np.ndarray, names: list[str]) -> np.ndarray:
    """Columns of one type as a structured array."""
    return np.ascontiguousarray(values).view([(name, values.dtype.str) for name in names]).reshape(len(values))
