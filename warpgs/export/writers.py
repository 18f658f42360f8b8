"""The export formats of ``warpgs export --format``."""

from .compressed import write_compressed
from .fourdgs import FOURDGS
from .gltf import GLB
from .job import Writer
from .page import PAGE
from .per_time import per_time
from .sog import SOG
from .spz import SPZ, SPZ_GZIP
from .standard import write_standard
from .usd import USD

WRITERS: dict[str, Writer] = {
    "ply": per_time(".ply", write_standard),
    "compressed": per_time(".compressed.ply", write_compressed),
    "sog": SOG,
    "spz": SPZ,
    "spz3": SPZ_GZIP,
    "glb": GLB,
    "usd": USD,
    "4dgs": FOURDGS,
    "html": PAGE,
}
"""Formats by name. To add one, write it in a file of its own and add a line here and in the help of ``Export``."""
