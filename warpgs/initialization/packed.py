"""Arrays of every frame of a video, packed: those of thousands of frames would take gigabytes."""

from collections.abc import Callable, Iterator, MutableMapping
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

Array = TypeVar("Array")
Packed = TypeVar("Packed")


class PackedArrays(MutableMapping[int, Array], Generic[Array, Packed]):
    """Arrays by index of the frame; each is packed when it is set, and unpacked when it is read.

    Args:
        pack: Packs an array.
        unpack: Returns a new array that is equal to the one that was packed.
    """

    def __init__(self, pack: Callable[[Array], Packed], unpack: Callable[[Packed], Array]) -> None:
        self._pack, self._unpack = pack, unpack
        self._packed: dict[int, Packed] = {}

    def __getitem__(self, index: int) -> Array:
        return self._unpack(self._packed[index])

    def __setitem__(self, index: int, array: Array) -> None:
        self._packed[index] = self._pack(array)

    def __delitem__(self, index: int) -> None:
        del self._packed[index]

    def __iter__(self) -> Iterator[int]:
        return iter(self._packed)

    def __len__(self) -> int:
        return len(self._packed)

    def __contains__(self, index: object) -> bool:
        return index in self._packed


def packed_pixels() -> MutableMapping[int, Int[np.ndarray, " P"]]:
    """Flat indices of pixels as 32-bit integers, such as those of an object: kept as runs along rows."""
    return PackedArrays(_runs_of, _pixels_of)


def packed_images() -> MutableMapping[int, Float[Tensor, "h w"]]:
    """Images of 32-bit numbers, NaN where unknown, on the CPU: kept where they are known."""
    return PackedArrays(_known_of, _image_of)


def _runs_of(pixels: Int[np.ndarray, " P"]) -> Int[np.ndarray, "2 R"]:
    """First pixels and lengths of runs of successive ones."""
    ends = np.flatnonzero(np.diff(pixels) != 1)
    first, last = np.append(pixels[:1], pixels[ends + 1]), np.append(pixels[ends], pixels[-1:])
    return np.stack([first, last - first + 1]).astype(np.int32)


def _pixels_of(runs: Int[np.ndarray, "2 R"]) -> Int[np.ndarray, " P"]:
    first, lengths = runs
    before = np.cumsum(lengths) - lengths
    return (np.repeat(first - before, lengths) + np.arange(lengths.sum())).astype(np.int32)


class _Known(NamedTuple):
    """The known numbers of an image, in the order of its pixels, a bit for each pixel, and its height and width."""

    values: Float[np.ndarray, " P"]
    bits: UInt8[np.ndarray, " B"]
    shape: tuple[int, ...]


def _known_of(image: Float[Tensor, "h w"]) -> _Known:
    numbers = image.numpy()
    is_known = ~np.isnan(numbers)
    return _Known(numbers[is_known], np.packbits(is_known), numbers.shape)


def _image_of(known: _Known) -> Float[Tensor, "h w"]:
    image = torch.full(known.shape, torch.nan, dtype=torch.float32)
    is_known = np.unpackbits(known.bits, count=image.numel()).view(bool).reshape(known.shape)
    image.numpy()[is_known] = known.values
    return image
