"""Coloured triangles, and PLY files of them."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from warpgs.files import write_bytes

HEADER = """ply
format binary_little_endian 1.0
comment written by warpgs
element vertex {vertices}
property float x
property float y
property float z
property uchar red
property uchar green
property uchar blue
element face {faces}
property list uchar int vertex_indices
end_header
"""

VERTEX = np.dtype([("position", "<f4", (3,)), ("color", "u1", (3,))])
FACE = np.dtype([("count", "u1"), ("vertices", "<i4", (3,))])
"""Rows of the file."""


class Mesh(NamedTuple):
    """Coloured triangles.

    Attributes:
        vertices: [V, 3] positions.
        faces: [F, 3] vertices, counter-clockwise as seen from outside.
        colors: [V, 3] sRGB.
    """

    vertices: Float32[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    colors: UInt8[np.ndarray, "V 3"]

    def rotated(self, rotation: Float64[np.ndarray, "3 3"]) -> "Mesh":
        """The mesh after a rotation."""
        return self._replace(vertices=(self.vertices @ rotation.T).astype(np.float32))


def write_mesh_ply(path: Path, mesh: Mesh) -> int:
    """Writes a mesh with the colours of its vertices; returns the size of the file [bytes].

    Raises:
        OSError: If it cannot be written; the message names the file.
    """
    vertices, faces = np.zeros(len(mesh.vertices), VERTEX), np.zeros(len(mesh.faces), FACE)
    vertices["position"], vertices["color"] = mesh.vertices, mesh.colors
    faces["count"], faces["vertices"] = 3, mesh.faces
    header = HEADER.format(vertices=len(vertices), faces=len(faces)).encode("ascii")
    return write_bytes(path, [header, vertices.tobytes(), faces.tobytes()])
