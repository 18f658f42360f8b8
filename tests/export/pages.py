"""Reads the data of a page back; the page is trusted."""

import gzip
import json
import re

import numpy as np

from warpgs.export.baking import PARTS, Baked, Branch
from warpgs.export.cosines import Levels
from warpgs.export.packing import from_planes
from warpgs.export.text import from_text


def read_page(path):
    blocks = dict(re.findall(r'<script type="[^"]+" id="([a-z_-]+)">([^<]*)</script>', path.read_bytes().decode()))
    metadata = json.loads(blocks["scene"])
    branches = [
        Branch(**{part: levels(blocks[f"{name}-{part}"], part, metadata["branches"][name][part]) for part in PARTS})
        for name in ("static", "dynamic")
    ]
    return Baked(metadata["keys"], *branches)


def levels(block, part, metadata):
    planes = np.frombuffer(gzip.decompress(from_text(block)), np.uint8)
    values = from_planes(planes, tuple(metadata["shape"]))
    if part == "means":
        values[0] = np.cumsum(values[0], 0, np.int32)
    return Levels(values, np.array(metadata["steps"], np.float64))
