"""The export formats of ``warpgs export --format``."""

from warpgs.formats.compressed import write_compressed
from warpgs.formats.gltf import write_glb
from warpgs.formats.sog import write_sog
from warpgs.formats.spz import write_spz, write_spz_gzip
from warpgs.formats.standard import write_standard

from .fourdgs import FOURDGS
from .job import Writer
from .mesh import MESH
from .page import PAGE
from .per_time import per_time
from .usd import USD

WRITERS: dict[str, Writer] = {
    "ply": per_time(".ply", write_standard),
    "compressed": per_time(".compressed.ply", write_compressed),
    "sog": per_time(".sog", write_sog),
    "spz": per_time(".spz", write_spz, y_up=True),
    "spz3": per_time(".v3.spz", write_spz_gzip, y_up=True),
    "glb": per_time(".glb", write_glb, y_up=True),
    "mesh": MESH,
    "usd": USD,
    "4dgs": FOURDGS,
    "html": PAGE,
}
"""Formats by name. To add one, write it in a file of its own and add a line here and in the help of ``Export``."""
