"""Reads the data of a page back; the page is trusted."""

import gzip
import json
import re

import numpy as np

from warpgs.export.baking import PARTS, Baked, Branch
from warpgs.export.page import REPLACED
from warpgs.export.transform import Levels


def read_page(path):
    blocks = dict(re.findall(r'<script type="[^"]+" id="([a-z_-]+)">([^<]*)</script>', path.read_bytes().decode()))
    metadata = json.loads(blocks["scene"])
    branches = [branch(blocks, name, metadata["branches"][name]) for name in ("static", "dynamic")]
    return Baked(metadata["keys"], *branches)


def branch(blocks, name, metadata):
    num = metadata["means"]["shape"][1]
    octaves = integers(blocks[f"{name}-octaves"], (1, num, 1))[0, :, 0]
    return Branch(**{part: levels(blocks, name, part, metadata[part], octaves) for part in PARTS})


def levels(blocks, name, part, metadata, octaves):
    shape = tuple(metadata["shape"])
    values = integers(blocks[f"{name}-{part}"], shape)
    if part == "means":
        values[0] = np.cumsum(values[0], 0, np.int32)
    basis = integers(blocks[f"{name}-{part}-basis"], (shape[0], shape[0], 1))[:, :, 0]
    octaves = octaves if part in ("colors", "rest") else np.zeros_like(octaves)
    return Levels(values, np.array(metadata["steps"], np.float64), octaves, basis)


def integers(block, shape):
    return from_planes(np.frombuffer(gzip.decompress(from_text(block)), np.uint8), shape)


def from_planes(planes, shape):
    """The integers of shape [K, N, C] that ``to_planes`` encoded, as the player restores them."""
    keys, num, channels = shape
    count = keys * num * channels
    unsigned = np.zeros(count, np.uint32)
    for k, plane in enumerate(planes.reshape(-1, count) if count else ()):
        unsigned |= plane.astype(np.uint32) << np.uint32(8 * k)
    values = (unsigned >> np.uint32(1)).astype(np.int32) ^ -(unsigned & np.uint32(1)).astype(np.int32)
    return np.ascontiguousarray(values.reshape(keys, channels, num).transpose(0, 2, 1))


def from_text(text):
    """Decodes the bytes that ``to_text`` encoded, as the player does."""
    values = []
    for code in map(ord, text):
        if 128 <= code < 512:
            values.append(ord(REPLACED[code // 128 - 1]))
        values.append(code % 128)
    bits = np.unpackbits(np.array(values, np.uint8)[:, None], axis=1)[:, 1:].reshape(-1)
    return np.packbits(bits[: len(bits) // 8 * 8]).tobytes()
