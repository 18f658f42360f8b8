"""Reads binary glTF with KHR_gaussian_splatting: every primitive of Gaussians, placed by the nodes that show it."""

import math
import reprlib
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from warpgs.data.camera_files import is_rotation
from warpgs.files import MAX_NUMBER, read_bounded, read_numbers
from warpgs.ops.sh import MAX_DEGREE, num_bases
from warpgs.parsed import parse_json

from .bounds import require_plausible
from .cloud import ARRAYS, MIN_SCALE, Cloud, logit, unit_quats
from .gltf import BINARY_CHUNK, EXTENSION, JSON_CHUNK, MAGIC, MAX_BYTES, TYPES
from .rotation import rotated

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
"""NumPy types of componentType; integers are normalized."""

ROW_BYTES = 4 * (3 + 4 + 3 + 1 + 3)
"""Size of a Gaussian without directional colours in memory [bytes]."""

READ = (EXTENSION, "KHR_mesh_quantization")
"""Extensions that a file may require."""


def read_glb(path: Path) -> Cloud:
    """Reads the Gaussians of a binary glTF file, with y up.

    Raises:
        ValueError: If it is another file, damaged, or has what is not supported; the message names it.
    """
    document = _Document(path)
    placed = [*document.placed_primitives()]
    claimed = ROW_BYTES * sum(document.count(primitive) for primitive, _ in placed)  # many nodes may show one mesh
    require_plausible(path, claimed, path.stat().st_size)
    clouds = [document.cloud(primitive, matrix) for primitive, matrix in placed]
    if not clouds:
        raise ValueError(f"{path} has no primitive with {EXTENSION}")
    most = max(cloud.sh.shape[1] for cloud in clouds)
    padded = [c.replaced(sh=np.pad(c.sh, ((0, 0), (0, most - c.sh.shape[1]), (0, 0)))) for c in clouds]
    return padded[0].replaced(**{name: np.concatenate([getattr(c, name) for c in padded]) for name in ARRAYS})


class _Document:
    """The JSON document and the binary buffer of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        data = read_bounded(path, MAX_BYTES)
        try:
            magic, version, _, length, kind = struct.unpack_from("<IIIII", data)
            if magic != MAGIC or version != 2 or kind != JSON_CHUNK or 20 + length > len(data):
                raise ValueError("it does not begin with a JSON chunk of glTF 2.0")
            self.fields = parse_json(path, data[20 : 20 + length])
            size, kind = struct.unpack_from("<II", data, 20 + length)
            self.buffer = data[28 + length : 28 + length + size]
            if kind != BINARY_CHUNK or len(self.buffer) < size:
                raise ValueError("its binary chunk is truncated")
        except struct.error as error:
            raise ValueError(f"{path} is truncated or not a binary glTF file") from error
        except ValueError as error:
            raise ValueError(f"{path} is not a binary glTF file: {error}") from error
        needed = [name for name in self._get(self.fields, "extensionsRequired", []) if name not in READ]
        if needed:
            raise ValueError(f"{path} needs the extension {reprlib.repr(needed[0])}, which is not supported")

    def placed_primitives(self) -> Iterator[tuple[dict[str, Any], Float64[np.ndarray, "4 4"]]]:
        """The primitives of Gaussians, each with the matrix to the world of a node that shows it."""
        nodes, meshes, scenes = (self._get(self.fields, name, []) for name in ("nodes", "meshes", "scenes"))
        shown: Sequence[Any] = range(len(nodes))
        if scenes:
            shown = self._get(self._item(scenes, self.fields.get("scene", 0)), "nodes", [])
        ahead = [(index, np.eye(4)) for index in shown]
        reached: set[int] = set()
        while ahead:
            index, parent = ahead.pop()
            node = self._item(nodes, index)
            if index in reached:
                raise ValueError(f"{self.path} is damaged: node {index} has two parents")
            reached.add(index)
            matrix = parent @ self._matrix(node)
            ahead += [(child, matrix) for child in self._get(node, "children", [])]
            if "mesh" in node:
                primitives = self._get(self._item(meshes, node["mesh"]), "primitives", [])
                for k in range(len(primitives)):
                    if EXTENSION in self._get(self._item(primitives, k), "extensions", {}):
                        yield primitives[k], matrix

    def count(self, primitive: dict[str, Any]) -> int:
        """Number of Gaussians of a primitive."""
        return self._accessor(self._get(primitive, "attributes", {}), "POSITION", 3).shape[0]

    def cloud(self, primitive: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]) -> Cloud:
        """The Gaussians of a primitive in the world."""
        extension = self._get(primitive["extensions"], EXTENSION, {})
        if unsupported := self._get(extension, "extensions", {}):
            raise ValueError(f"{self.path} is compressed by {reprlib.repr(next(iter(unsupported)))}, which is not read")
        if (space := extension.get("colorSpace", "srgb_rec709_display")) != "srgb_rec709_display":
            raise ValueError(f"{self.path} has colours in {reprlib.repr(space)}, only srgb_rec709_display is read")
        attributes = self._get(primitive, "attributes", {})
        N = self.count(primitive)

        def values(name: str, width: int) -> np.ndarray:
            found = self._accessor(attributes, name, width)
            if len(found) != N:
                raise ValueError(f"{self.path} is damaged: {name} has {len(found):,} rows, POSITION {N:,}")
            return found

        names = [f"{EXTENSION}:SH_DEGREE_{d}_COEF_{k}" for d in range(MAX_DEGREE + 1) for k in range(2 * d + 1)]
        degree = max((d for d in range(MAX_DEGREE + 1) if names[num_bases(d) - 1] in attributes), default=0)
        log_scales = np.log(np.maximum(values(f"{EXTENSION}:SCALE", 3), MIN_SCALE))
        opacities = values(f"{EXTENSION}:OPACITY", 1)[:, 0].astype(np.float64)
        cloud = Cloud(
            means=values("POSITION", 3).astype(np.float32),
            quats=unit_quats(np.roll(values(f"{EXTENSION}:ROTATION", 4), 1, axis=1)),
            log_scales=log_scales.astype(np.float32),
            logit_opacities=logit(opacities).astype(np.float32),
            sh=np.stack([values(name, 3) for name in names[: num_bases(degree)]], 1).astype(np.float32),
            is_dynamic=np.zeros(N, bool),
        )
        return _placed(self.path, cloud, matrix)

    def _accessor(self, attributes: dict[str, Any], name: str, width: int) -> np.ndarray:
        """[N, width] the values of an attribute, normalized if they are integers."""
        if name not in attributes:
            raise ValueError(f"{self.path} is damaged: a primitive has no {name}")
        accessor = self._item(self._get(self.fields, "accessors", []), attributes[name])
        view = self._item(self._get(self.fields, "bufferViews", []), accessor.get("bufferView"))
        kind, count = (self._get(accessor, key, 0) for key in ("componentType", "count"))
        if kind not in COMPONENTS or self._get(accessor, "type", "") != TYPES[width] or "sparse" in accessor:
            raise ValueError(f"{self.path}: {name} is of a type that is not supported")
        keys = ("buffer", "byteOffset", "byteLength", "byteStride")
        buffer, start, size, stride = (self._get(view, key, 0) for key in keys)
        offset, dtype = self._get(accessor, "byteOffset", 0), np.dtype(COMPONENTS[kind])
        row = width * dtype.itemsize
        end = offset + max(count - 1, 0) * (stride or row) + row
        if (
            min(count, start, size, stride, offset) < 0
            or 0 < stride < row
            or buffer
            or start + size > len(self.buffer)
            or end > size
        ):
            raise ValueError(f"{self.path} is damaged: {name} is beyond the end of its buffer")
        strides = (stride or row, dtype.itemsize)
        values = np.ndarray((count, width), dtype, self.buffer, start + offset, strides)
        if dtype.kind == "f":
            return values
        return np.maximum(values / np.float32(np.iinfo(dtype).max), np.float32(-1.0))

    def _matrix(self, node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
        """To the node's parent."""
        if "matrix" in node:
            return read_numbers(self.path, node, "matrix", (16,)).reshape(4, 4).T
        given = {"translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1], **node}
        move, scale = (read_numbers(self.path, given, key, (3,)) for key in ("translation", "scale"))
        turn = read_numbers(self.path, given, "rotation", (4,))
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(turn if turn.any() else (0, 0, 0, 1)).as_matrix() * scale
        matrix[:3, 3] = move
        return matrix

    def _get(self, fields: dict[str, Any], key: str, default: Any) -> Any:
        """A value of an object, which has the type of the default."""
        value = fields.get(key, default)
        if type(value) is not type(default):
            raise ValueError(f"{self.path} is damaged: {key} cannot be {reprlib.repr(value)}")
        return value

    def _item(self, values: list[Any], index: Any) -> dict[str, Any]:
        if type(index) is not int or not 0 <= index < len(values) or not isinstance(values[index], dict):
            raise ValueError(f"{self.path} is damaged: it refers to {reprlib.repr(index)} of {len(values)} objects")
        return values[index]


def _placed(path: Path, cloud: Cloud, matrix: Float64[np.ndarray, "4 4"]) -> Cloud:
    """A cloud turned, scaled and moved."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not 1 / MAX_NUMBER < scale < MAX_NUMBER or not is_rotation(matrix[:3, :3] / scale):
        raise ValueError(f"{path}: a node is mirrored or scaled unequally, which Gaussians cannot be")
    turned = rotated(cloud, matrix[:3, :3] / scale)
    means = (scale * turned.means + matrix[:3, 3]).astype(np.float32)
    return turned.replaced(means=means, log_scales=turned.log_scales + np.float32(math.log(scale)))
