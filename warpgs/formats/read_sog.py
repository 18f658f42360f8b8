"""Reads SOG of PlayCanvas, version 2: the inverse of ``sog``."""

import reprlib
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from warpgs.data.archive import MAX_RATIO, Archive
from warpgs.files import read_numbers
from warpgs.ops.sh import MAX_DEGREE, num_bases
from warpgs.parsed import parse_json

from .bounds import MAX_BYTES
from .cloud import Cloud, logit, unit_quats
from .packing import with_max_component
from .sog import MAX_PALETTE, PALETTE_COLUMNS, TABLE

META = "meta.json"
MAX_META = 1 << 20
"""Maximum size of the metadata [bytes]."""

SLACK = 1 << 16
"""Pixels that an image may have beyond four times those that it needs."""


def read_sog(path: Path) -> Cloud:
    """Reads the Gaussians of a .sog file.

    Raises:
        ValueError: If it is another file, of another version, or damaged; the message names it.
    """
    file = _SogFile(path)
    count = file.count
    logs = file.pixels("means", 0, count)[:, :3] + 256.0 * file.pixels("means", 1, count)[:, :3]
    low, high = (file.numbers("means", key, (3,)) for key in ("mins", "maxs"))
    logs = low + (high - low) * logs / 65535
    base, packed = file.pixels("sh0", 0, count), file.pixels("quats", 0, count)
    largest = packed[:, 3].astype(np.int64) - 252
    if count and not 0 <= largest.min() <= largest.max() <= 3:
        raise ValueError(f"{path} is damaged: its rotations have other modes than 252 to 255")
    others = (packed[:, :3] / 255 * 2 - 1) / np.sqrt(2)
    constant = file.table("sh0")[base[:, :3]][:, None]
    with np.errstate(over="ignore"):
        means = np.sign(logs) * np.expm1(np.abs(logs))
    return Cloud(
        means=means.astype(np.float32),
        quats=unit_quats(with_max_component(largest, others)),
        log_scales=file.table("scales")[file.pixels("scales", 0, count)[:, :3]].astype(np.float32),
        logit_opacities=logit(base[:, 3] / 255).astype(np.float32),
        sh=np.concatenate([constant, file.rest()], 1).astype(np.float32),
        is_dynamic=np.zeros(count, bool),
        antialias=file.meta.get("model") == "antialiased" or file.meta.get("antialias") is True,
    )


class _SogFile:
    """The metadata and the images of a file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._archive = Archive(path, MAX_BYTES)
        if META not in self._archive.sizes:
            raise ValueError(f"{path} is not a SOG file: it has no {META}")
        self.meta = parse_json(f"{path}: {META}", self._archive.read(META, MAX_META))
        if self.meta.get("version") != 2:
            raise ValueError(f"{path} has version {reprlib.repr(self.meta.get('version'))} of SOG, only 2 is read")
        self.count = self._count(self.meta, "count", MAX_RATIO * path.stat().st_size)

    def rest(self) -> Float64[np.ndarray, "N R 3"]:
        """Coefficients of degree 1 and higher."""
        if "shN" not in self.meta:
            return np.zeros((self.count, 0, 3))
        part = self._part("shN")
        count, bands = self._count(part, "count", MAX_PALETTE), self._count(part, "bands", MAX_DEGREE)
        rest = num_bases(bands) - 1
        lines = -(-count // PALETTE_COLUMNS)
        image = self._image("shN", 0, lines * PALETTE_COLUMNS * rest)
        if image.shape[1] != PALETTE_COLUMNS * rest:
            raise ValueError(f"{self.path} is damaged: its palette is {image.shape[1]} px wide, not {64 * rest}")
        palette = image[..., :3].reshape(-1, rest, 3)[:count]
        low, high = self.pixels("shN", 1, self.count)[:, :2].astype(np.int64).T
        labels = low + 256 * high
        if len(labels) and labels.max() >= count:
            raise ValueError(f"{self.path} is damaged: its labels are beyond the {count:,} entries of its palette")
        return self.table("shN")[palette[labels]]

    def pixels(self, part: str, index: int, count: int) -> UInt8[np.ndarray, "N 4"]:
        """The first pixels of an image."""
        return self._image(part, index, count).reshape(-1, 4)[:count]

    def table(self, part: str) -> Float64[np.ndarray, "256"]:
        """The table that an image of indices refers to."""
        return self.numbers(part, "codebook", (TABLE,))

    def numbers(self, part: str, key: str, shape: tuple[int, ...]) -> Float64[np.ndarray, "..."]:
        """Numbers of the metadata."""
        return read_numbers(self.path, self._part(part), key, shape)

    def _part(self, name: str) -> dict[str, Any]:
        part = self.meta.get(name)
        if not isinstance(part, dict):
            raise ValueError(f"{self.path} is damaged: {META} has no object {name}")
        return part

    def _count(self, values: dict[str, Any], key: str, maximum: int) -> int:
        value = values.get(key)
        if type(value) is not int or not 0 <= value <= maximum:
            raise ValueError(f"{self.path} is damaged: {key} cannot be {reprlib.repr(value)}, of at most {maximum:,}")
        return value

    def _image(self, part: str, index: int, count: int) -> UInt8[np.ndarray, "H W 4"]:
        """An image of RGBA, whose size is checked before it is decoded."""
        files = self._part(part).get("files")
        name = files[index] if isinstance(files, list) and len(files) > index else None
        if not isinstance(name, str) or name not in self._archive.sizes:
            raise ValueError(f"{self.path} is damaged: it has no file {reprlib.repr(name)} of {part}")
        where, data = f"{self.path}: {name}", self._archive.read(name, MAX_BYTES)
        width, height = _webp_size(data)
        if not count <= width * height <= 4 * count + SLACK:
            raise ValueError(f"{where} has {width} × {height} pixels for {count:,} values, or is no WebP image")
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.shape[:2] != (height, width) or image.ndim != 3 or image.dtype != np.uint8:
            raise ValueError(f"{where} cannot be decoded as an image")
        alpha = image[..., 3:] if image.shape[2] == 4 else np.full((height, width, 1), 255, np.uint8)
        return np.concatenate([image[..., 2::-1], alpha], 2)


def _webp_size(data: bytes) -> tuple[int, int]:
    """Width and height of a lossless WebP image, or of one with more parts; 0 for anything else.

    https://developers.google.com/speed/webp/docs/riff_container
    """
    kind = data[12:16] if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30 else b""
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8X":
        return int.from_bytes(data[24:27], "little") + 1, int.from_bytes(data[27:30], "little") + 1
    return 0, 0
