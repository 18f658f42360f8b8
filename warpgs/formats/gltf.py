"""Binary glTF 2.0 with the extension KHR_gaussian_splatting: single precision, without loss.

https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting (ratified): the Gaussians
are the vertices of a primitive of points. Scales are linear, opacities in [0, 1], rotations (x, y, z, w), and there is
one attribute per coefficient, as many as the degree has. Other programs see points of the colour of degree 0. glTF has
no place for anti-aliasing. Axes are x right, y up, z towards the viewer.
"""

import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from warpgs.files import write_bytes
from warpgs.model.gaussians import SH_C0
from warpgs.ops.sh import degree_of, num_bases

from .cloud import Cloud, sigmoid

EXTENSION = "KHR_gaussian_splatting"
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
POINTS = 0
ARRAY_BUFFER = 34962
COMPONENTS = {np.dtype("<f4"): 5126, np.dtype("u1"): 5121}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
MAX_BYTES = (1 << 32) - 1
"""Maximum size of a file: its header has 32 bits for it."""


def write_glb(path: Path, cloud: Cloud) -> int:
    """Writes a cloud as binary glTF; returns the size of the file [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
        ValueError: If the cloud is empty, which glTF does not allow, or takes more than 4 GB.
    """
    if not len(cloud):
        raise ValueError(f"{path}: glTF needs at least one Gaussian, got none")
    arrays = _attributes(cloud)
    return write_document(path, _document(arrays), arrays.values(), "--max-gaussians")


def write_document(path: Path, document: dict[str, Any], arrays: Iterable[np.ndarray], remedy: str) -> int:
    """Writes a JSON document and arrays, one after the other in its only buffer; returns the size of the file [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
        ValueError: If it takes more than 4 GB; the message names the remedy.
    """
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = document["buffers"][0]["byteLength"]
    total = 12 + 8 + len(text) + 8 + size
    if total > MAX_BYTES:
        raise ValueError(f"{path}: a binary glTF file has at most 4 GB, got {total / 1e9:.1f} GB; use {remedy}")
    header = struct.pack("<IIIII", MAGIC, 2, total, len(text), JSON_CHUNK)
    buffers = (array.tobytes() for array in arrays)
    return write_bytes(path, [header, text, struct.pack("<II", size, BINARY_CHUNK), *buffers])


def linear(srgb: Float64[np.ndarray, "..."]) -> Float64[np.ndarray, "..."]:
    """Linear colours of sRGB in [0, 1], as glTF stores colours of vertices."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _attributes(cloud: Cloud) -> dict[str, Float32[np.ndarray, "N _"] | UInt8[np.ndarray, "N 4"]]:
    """The vertex attributes by name; rows take a multiple of four bytes."""
    opacities = sigmoid(cloud.logit_opacities.astype(np.float64))[:, None]
    attributes = {
        "POSITION": cloud.means,
        "COLOR_0": _fallback_color(cloud, opacities),
        f"{EXTENSION}:ROTATION": np.roll(cloud.quats, -1, axis=1),
        f"{EXTENSION}:SCALE": np.exp(cloud.log_scales),
        f"{EXTENSION}:OPACITY": opacities.astype(np.float32),
    }
    for degree in range(degree_of(cloud.sh.shape[1]) + 1):
        first = num_bases(degree - 1)
        for k in range(2 * degree + 1):
            attributes[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{k}"] = cloud.sh[:, first + k]
    return {name: np.ascontiguousarray(values) for name, values in attributes.items()}


def _fallback_color(cloud: Cloud, opacities: np.ndarray) -> UInt8[np.ndarray, "N 4"]:
    """Colour and opacity of points for programs without the extension."""
    color = np.clip(0.5 + SH_C0 * cloud.sh[:, 0].astype(np.float64), 0, 1)
    return np.rint(255 * np.concatenate([linear(color), opacities], 1)).astype(np.uint8)


def _document(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """The JSON part of the file."""
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for name, array in arrays.items():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": ARRAY_BUFFER})
        offset += array.nbytes
        accessor = {"bufferView": len(accessors), "componentType": COMPONENTS[array.dtype], "count": len(array)}
        accessors.append({**accessor, "type": TYPES[array.shape[1]]})
        if array.dtype == np.uint8:
            accessors[-1]["normalized"] = True
        if name == "POSITION":
            accessors[-1].update(min=array.min(0).tolist(), max=array.max(0).tolist())
    properties = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {
        "mode": POINTS,
        "attributes": {name: k for k, name in enumerate(arrays)},
        "extensions": {EXTENSION: {**properties, "projection": "perspective", "sortingMethod": "cameraDistance"}},
    }
    return {
        "asset": {"version": "2.0", "generator": "warpgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
