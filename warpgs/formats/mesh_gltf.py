"""Binary glTF 2.0 of coloured meshes: one that stays, and one per frame of an animation.

glTF has no meshes whose triangles change over time, and morph targets need the same triangles in all frames. So every
frame is a node of its own, and one animation sets its scale to 1 while it is shown, else to 0, without interpolation:
what programs that know core glTF alone play, three.js and Blender among them. Without playing it they show the first
frame. KHR_node_visibility would say the same, but few programs animate it. Colours have the light of the capture in
them: the material is unlit, where a program knows KHR_materials_unlit, and shows both sides of open surfaces.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .gltf import ARRAY_BUFFER, linear, write_document
from .mesh import Mesh

UNLIT = "KHR_materials_unlit"
ELEMENT_ARRAY_BUFFER = 34963
COMPONENTS = {"<f4": 5126, "<u2": 5123, "<u4": 5125}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def write_mesh_glb(path: Path, static: Mesh | None, frames: Sequence[Mesh], seconds: float) -> int:
    """Writes meshes as binary glTF; returns the size of the file [bytes].

    Args:
        path: The file.
        static: What stays, as node ``static``; None or without triangles for nothing.
        frames: What is shown one after the other, as children ``dynamic_00000`` … of the node ``dynamic``; those
            without triangles show nothing.
        seconds: Duration of all frames together [s].

    Raises:
        OSError: If it cannot be written; the message names the file.
        ValueError: If no mesh has triangles, or it takes more than 4 GB.
    """
    builder = _Builder()
    if static is not None and len(static.faces):
        builder.root.append(builder.add_node("static", static))
    shown = [(k, builder.add_node(f"dynamic_{k:05d}", mesh)) for k, mesh in enumerate(frames) if len(mesh.faces)]
    if shown:
        builder.nodes.append({"name": "dynamic", "children": [node for _, node in shown]})
        builder.root.append(len(builder.nodes) - 1)
    if not builder.root:
        raise ValueError(f"{path}: the meshes have no triangles: use a smaller --voxel")
    if len(frames) > 1:
        for k, node in shown:
            builder.animate(node, k, np.arange(len(frames) + 1) * seconds / len(frames))
    return write_document(path, builder.document(), builder.arrays, "a larger --voxel")


class _Builder:
    """A document in the making."""

    def __init__(self) -> None:
        self.arrays: list[np.ndarray] = []
        self.nodes: list[dict[str, Any]] = []
        self.root: list[int] = []
        self._meshes: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._views: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        self._channels: list[dict[str, Any]] = []
        self._size = 0

    def add_node(self, name: str, mesh: Mesh) -> int:
        """Adds a node with a mesh; returns its index."""
        alpha = np.ones((len(mesh.colors), 1))
        colors = np.rint(65535.0 * np.concatenate([linear(mesh.colors / 255.0), alpha], 1))
        attributes = {
            "POSITION": self._add(mesh.vertices.astype("<f4"), ARRAY_BUFFER, with_range=True),
            "COLOR_0": self._add(colors.astype("<u2"), ARRAY_BUFFER, normalized=True),
        }
        indices = self._add(mesh.faces.reshape(-1, 1).astype("<u4"), ELEMENT_ARRAY_BUFFER)
        self._meshes.append(
            {"name": name, "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}
        )
        self.nodes.append({"name": name, "mesh": len(self._meshes) - 1})
        return len(self.nodes) - 1

    def animate(self, node: int, frame: int, times: np.ndarray) -> None:
        """Shows a node from the time of a frame to that of the next one only [s]; at rest, only the first frame is."""
        changes = {0.0: 0.0, float(times[frame]): 1.0, float(times[frame + 1]): 0.0, float(times[-1]): 0.0}
        if frame + 1 == len(times) - 1:
            changes[float(times[-1])] = 1.0  # the end shows the last frame
        keys = np.array([*changes], "<f4")[:, None]
        scales = np.repeat(np.array([*changes.values()], "<f4")[:, None], 3, axis=1)
        sampler = {"input": self._add(keys, None, with_range=True), "output": self._add(scales, None)}
        self._samplers.append({**sampler, "interpolation": "STEP"})
        self._channels.append({"sampler": len(self._samplers) - 1, "target": {"node": node, "path": "scale"}})
        if frame:
            self.nodes[node]["scale"] = [0.0, 0.0, 0.0]

    def document(self) -> dict[str, Any]:
        """The JSON part of the file."""
        material = {"name": "colors", "doubleSided": True, "extensions": {UNLIT: {}}}
        surface = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
        animation = {"name": "frames", "samplers": self._samplers, "channels": self._channels}
        return {
            "asset": {"version": "2.0", "generator": "warpgs"},
            "extensionsUsed": [UNLIT],
            "scene": 0,
            "scenes": [{"nodes": self.root}],
            "nodes": self.nodes,
            "meshes": self._meshes,
            "materials": [{**material, "pbrMetallicRoughness": surface}],
            **({"animations": [animation]} if self._channels else {}),
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }

    def _add(self, array: np.ndarray, target: int | None, *, with_range: bool = False, normalized: bool = False) -> int:
        """Adds an array of rows; returns the index of its accessor."""
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": array.nbytes}
        self._views.append(view if target is None else {**view, "target": target})
        self.arrays.append(array)
        self._size += array.nbytes  # rows take a multiple of four bytes
        accessor: dict[str, Any] = {"bufferView": len(self._views) - 1, "componentType": COMPONENTS[array.dtype.str]}
        accessor |= {"count": len(array), "type": TYPES[array.shape[1]]}
        if with_range:
            accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        if normalized:
            accessor["normalized"] = True
        self._accessors.append(accessor)
        return len(self._accessors) - 1
