"""Reads the data of a page back; the page is trusted."""

import base64
import gzip
import json
import re

import numpy as np

from warpgs.export.baking import Baked, Bounds, Branch
from warpgs.export.packing import from_planes

TYPES = {"geometry": np.dtype("<u4"), "colors": np.dtype("u1"), "rest": np.dtype("u1")}


def read_page(path):
    blocks = dict(re.findall(r'<script type="[^"]+" id="([a-z-]+)">([^<]*)</script>', path.read_text("utf-8")))
    metadata = json.loads(blocks["scene"])
    return Baked(
        metadata["keys"], *(branch(blocks, name, metadata["branches"][name]) for name in ("static", "dynamic"))
    )


def branch(blocks, name, metadata):
    bounds = {bound: np.array(metadata[bound], np.float64) for bound in ("means", "log_scales", "colors", "rest")}
    arrays = {}
    for array, dtype in TYPES.items():
        data = gzip.decompress(base64.b64decode(blocks[f"{name}-{array}"]))
        arrays[array] = from_planes(np.frombuffer(data, np.uint8), tuple(metadata["shapes"][array]), dtype)
    return Branch(Bounds(**bounds), **arrays)
