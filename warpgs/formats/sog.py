"""SOG of PlayCanvas, version 2, in one file: 15 to 20 times smaller than PLY.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog: a ZIP file of lossless WebP images, with
one pixel per Gaussian along a Morton curve, and meta.json. Positions have 16 bits over the range of
sign(x) ln(1 + |x|), rotations their three smaller components in 8 bits each. Log-scales and coefficients of degree 0
are indices into a table of 256 values that fits their distribution (Lloyd's algorithm); coefficients of degree 1 and
higher are indices into a palette, whose entries are again indices into such a table.

SOG has the axes of the PLY file: SuperSplat and the PlayCanvas engine turn both upright in the same way.
"""

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float64, Int64, UInt8

from warpgs.files import write_bytes
from warpgs.ops.sh import degree_of

from .cloud import Cloud, sigmoid
from .compressed import morton_order
from .packing import without_max_component

TABLE = 256
"""Number of values in a table."""

TABLE_ITERATIONS = 20
MAX_PALETTE = 1 << 16
"""Maximum number of entries of a palette; scenes with fewer Gaussians have one entry for each."""

CLUSTERS, CLUSTER_ITERATIONS = 1 << 14, 4
"""Number of entries of the palette of larger scenes, and of iterations of Lloyd's algorithm that find them."""

PALETTE_COLUMNS = 64
"""Palette entries per line of their image."""

MAX_SIDE = 16383
"""Maximum width and height of a WebP image [px]."""

LOSSLESS = [cv2.IMWRITE_WEBP_QUALITY, 101]


def write_sog(path: Path, cloud: Cloud) -> int:
    """Writes a cloud as one .sog file; returns its size [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
        ValueError: If the cloud is empty, which WebP does not allow, or too large for it.
    """
    if not len(cloud):
        raise ValueError(f"{path}: SOG needs at least one Gaussian, got none")
    if len(cloud) > MAX_SIDE**2:
        raise ValueError(f"{path}: SOG holds at most {MAX_SIDE**2:,} Gaussians, got {len(cloud):,}")
    cloud = cloud.select(morton_order(cloud.means))
    images, meta = _geometry(cloud)
    scales, scale_table = fit_table(cloud.log_scales)
    colors, color_table = fit_table(cloud.sh[:, 0])
    opacities = np.rint(255 * sigmoid(cloud.logit_opacities.astype(np.float64))).astype(np.uint8)
    images["scales.webp"] = _square(scales)
    images["sh0.webp"] = _square(np.concatenate([colors, opacities[:, None]], 1))
    meta["scales"] = {"codebook": scale_table.tolist(), "files": ["scales.webp"]}
    meta["sh0"] = {"codebook": color_table.tolist(), "files": ["sh0.webp"]}
    if cloud.sh.shape[1] > 1:
        meta["shN"] = _add_palette(images, cloud)
    return write_bytes(path, [_zip(meta, images)])


def fit_table(values: np.ndarray) -> tuple[UInt8[np.ndarray, "..."], Float64[np.ndarray, "256"]]:
    """A table of 256 values with a small mean squared error (Lloyd's algorithm), and the index of every value."""
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # between equal steps, which keep outliers, and quantiles, which follow the distribution
    quantiles = ordered[np.linspace(0, len(ordered) - 1, TABLE).round().astype(int)]
    table = (quantiles + np.linspace(ordered[0], ordered[-1], TABLE)) / 2
    for _ in range(TABLE_ITERATIONS):
        ends = np.concatenate([[0], np.searchsorted(ordered, (table[1:] + table[:-1]) / 2), [len(ordered)]])
        counts = np.diff(ends)
        table = np.where(counts, np.diff(sums[ends]) / np.maximum(counts, 1), table)
    indices = np.searchsorted((table[1:] + table[:-1]) / 2, values.astype(np.float64))
    return indices.astype(np.uint8), table


def _geometry(cloud: Cloud) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Images of positions and rotations, and the metadata."""
    logs = np.sign(cloud.means) * np.log1p(np.abs(cloud.means.astype(np.float64)))
    low, high = logs.min(0), logs.max(0)
    positions = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    largest, others = without_max_component(cloud.quats)
    components = np.rint(255 * np.clip(others / np.sqrt(2) + 0.5, 0, 1))
    images = {
        "means_l.webp": _square((positions & 255).astype(np.uint8)),
        "means_u.webp": _square((positions >> 8).astype(np.uint8)),
        "quats.webp": _square(np.concatenate([components, 252 + largest[:, None]], 1).astype(np.uint8)),
    }
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": "warpgs"}, "count": len(cloud)}
    if cloud.antialias:
        meta["model"] = "antialiased"
    files = ["means_l.webp", "means_u.webp"]
    meta["means"] = {"mins": low.tolist(), "maxs": high.tolist(), "files": files}
    meta["quats"] = {"files": ["quats.webp"]}
    return images, meta


def _add_palette(images: dict[str, np.ndarray], cloud: Cloud) -> dict[str, Any]:
    """Adds the images of the palette and of its indices; returns their metadata."""
    rest = cloud.sh.shape[1] - 1
    labels, entries = _palette(cloud.sh[:, 1:].reshape(len(cloud), 3 * rest))
    values, table = fit_table(entries.reshape(-1, rest, 3))
    lines = -(-len(values) // PALETTE_COLUMNS)
    palette = np.zeros((lines * PALETTE_COLUMNS, rest, 3), np.uint8)
    palette[: len(values)] = values
    images["shN_centroids.webp"] = palette.reshape(lines, PALETTE_COLUMNS * rest, 3)
    images["shN_labels.webp"] = _square(np.stack([labels & 255, labels >> 8, 0 * labels], 1).astype(np.uint8))
    files = ["shN_centroids.webp", "shN_labels.webp"]
    return {"count": len(values), "bands": degree_of(rest + 1), "codebook": table.tolist(), "files": files}


def _palette(vectors: np.ndarray) -> tuple[Int64[np.ndarray, " N"], np.ndarray]:
    """A palette of vectors, and the index of the closest entry for each vector."""
    if len(vectors) <= MAX_PALETTE:
        return np.arange(len(vectors)), vectors
    points = torch.from_numpy(np.ascontiguousarray(vectors))
    entries = points[torch.linspace(0, len(points) - 1, CLUSTERS, dtype=torch.float32).round().long()].clone()
    for _ in range(CLUSTER_ITERATIONS):
        labels = _closest(points, entries)
        sums = torch.zeros_like(entries).index_add_(0, labels, points)
        counts = torch.bincount(labels, minlength=CLUSTERS)[:, None]
        entries = torch.where(counts > 0, sums / counts.clamp_min(1), entries)
    return _closest(points, entries).numpy(), entries.numpy()


def _closest(points: torch.Tensor, entries: torch.Tensor) -> torch.Tensor:
    """[N] index of the closest entry of each point, in batches of bounded memory."""
    norms = entries.square().sum(1)
    return torch.cat([(norms - 2 * batch @ entries.T).argmin(1) for batch in points.split(4096)])


def _square(values: UInt8[np.ndarray, "N C"]) -> UInt8[np.ndarray, "H W C"]:
    """One pixel per row, line by line, in an image that is about square."""
    width = int(np.ceil(np.sqrt(len(values))))
    height = -(-len(values) // width)
    image = np.zeros((height * width, values.shape[1]), np.uint8)
    image[: len(values)] = values
    return image.reshape(height, width, -1)


def _zip(meta: dict[str, Any], images: dict[str, np.ndarray]) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_STORED) as file:
        for name, image in images.items():
            order = [2, 1, 0, 3][: image.shape[2]]  # OpenCV's
            _, encoded = cv2.imencode(".webp", image[..., order], LOSSLESS)
            file.writestr(_entry(name), encoded.tobytes())
        file.writestr(_entry("meta.json"), json.dumps(meta))
    return data.getvalue()


def _entry(name: str) -> zipfile.ZipInfo:
    """An entry without the time of its writing, so that equal scenes give equal files."""
    return zipfile.ZipInfo(name)
