"""Which Gaussians of a scene are marked, one bit each: hashable, comparable and small in files."""

import base64
import reprlib
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

MAX_COUNT = 1 << 28
"""Maximum number of Gaussians in a file."""


class Marked(NamedTuple):
    """A mask over the Gaussians of a scene, static ones first.

    Attributes:
        size: Number of Gaussians.
        bits: The mask, eight Gaussians a byte, the first one in the highest bit; the rest of the last byte is 0.
    """

    size: int
    bits: bytes

    @staticmethod
    def of(mask: Bool[np.ndarray, " N"]) -> "Marked":
        """The Gaussians of a mask."""
        return Marked(len(mask), np.packbits(mask).tobytes())

    @property
    def mask(self) -> Bool[np.ndarray, " N"]:
        """[N] whether each Gaussian is marked."""
        return np.unpackbits(np.frombuffer(self.bits, np.uint8), count=self.size).astype(bool)

    @property
    def total(self) -> int:
        """Number of marked Gaussians."""
        return int(np.bitwise_count(np.frombuffer(self.bits, np.uint8)).sum())

    def __repr__(self) -> str:
        return f"<Marked: {self.total:,} of {self.size:,} Gaussians>"

    def for_json(self) -> dict[str, Any]:
        """Values for a JSON file: the bits are compressed (zlib) and in Base64."""
        return {"count": self.size, "bits": base64.b64encode(zlib.compress(self.bits, 9)).decode()}


def parse_marked(path: Path, name: str, values: Any) -> Marked:
    """The mask of a JSON file; decompresses no more than the bits of its Gaussians.

    Raises:
        ValueError: If it is something else, or its bits are damaged or of another number of Gaussians.
    """
    if not isinstance(values, dict) or {*values} != {"count", "bits"} or type(values["bits"]) is not str:
        raise ValueError(f"{path}: {name} must have a count and bits, got {reprlib.repr(values)}")
    count = values["count"]
    if type(count) is not int or not 0 < count <= MAX_COUNT:
        raise ValueError(f"{path}: count of {name} must be in [1, {MAX_COUNT:,}], got {reprlib.repr(count)}")
    size = -(-count // 8)
    try:
        stream = zlib.decompressobj()
        bits = stream.decompress(base64.b64decode(values["bits"], validate=True), size + 1)
    except (ValueError, zlib.error) as error:  # not of Base64, some of it not even ASCII
        raise ValueError(f"{path}: bits of {name} are damaged: {error}") from None
    if len(bits) != size or not stream.eof or bits[-1] & (0xFF >> (count - 1) % 8 + 1):
        raise ValueError(f"{path}: bits of {name} are not those of {count:,} Gaussians")
    return Marked(count, bits)
