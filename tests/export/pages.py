"""The numbers of a page that was just written, to look at; it is taken at its word."""

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
    facts = json.loads(blocks["scene"])
    return Baked(facts["keys"], *(branch(blocks, name, facts["branches"][name]) for name in ("static", "dynamic")))


def branch(blocks, name, facts):
    bounds = {bound: np.array(facts[bound], np.float64) for bound in ("means", "log_scales", "colors", "rest")}
    arrays = {}
    for array, dtype in TYPES.items():
        data = gzip.decompress(base64.b64decode(blocks[f"{name}-{array}"]))
        arrays[array] = from_planes(np.frombuffer(data, np.uint8), tuple(facts["shapes"][array]), dtype)
    return Branch(Bounds(**bounds), **arrays)
