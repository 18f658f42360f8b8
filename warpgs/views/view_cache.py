"""Views that were decoded once, in files: reading them from there takes a tenth of decoding them again."""

import contextlib
import shutil
import tempfile
import threading
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from .pixels import Pixels

NUM_FILES = 16
"""Number of files that the views are divided among, so that as many threads read and write at once."""

SPARE_BYTES = 4 << 30
"""What must stay free on the disk [bytes]."""


def packed_bytes(num_pixels: int) -> int:
    """Size of a mask in the file [bytes]: one bit per pixel, in whole bytes."""
    return -(-num_pixels // 8)


def max_stored_bytes(width: int, height: int) -> int:
    """Maximum size of a view in the file [bytes]: 8-bit RGB, depth in half precision, the mask and its border."""
    return (3 + 2) * width * height + 2 * packed_bytes(width * height)


class ViewCache:
    """The pixels of decoded views, by index.

    The files have no names, so the operating system removes them however training ends. Several threads may store and
    load.

    Args:
        folder: Folder on the disk that is to hold the files.
        sizes: Width and height of all views.

    Attributes:
        folder: The folder.
        nbytes: Maximum size of the files [bytes].
        fits: Whether the disk has space for them; if not, nothing is stored.
    """

    def __init__(self, folder: Path, sizes: Sequence[tuple[int, int]]) -> None:
        self.folder, self._sizes = folder, sizes
        nbytes = [max_stored_bytes(*size) for size in sizes]
        self.nbytes, ends = sum(nbytes), [0] * NUM_FILES
        self._starts = []
        for index, size in enumerate(nbytes):
            self._starts.append(ends[index % NUM_FILES])
            ends[index % NUM_FILES] += size
        self.fits = shutil.disk_usage(folder).free > self.nbytes + SPARE_BYTES
        self._files = []
        for _ in range(NUM_FILES):
            file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115  # open as long as this lives
            weakref.finalize(self, file.close)
            self._files.append(file)
        self._locks = [threading.Lock() for _ in self._files]
        self._stored: dict[int, tuple[bool, bool, int]] = {}

    def store(self, index: int, pixels: Pixels, version: int = 0, replace: bool = False) -> bool:
        """Writes the pixels of a view, unless the disk is full.

        Args:
            index: Index of the view.
            pixels: Its pixels, in host memory.
            version: Number of changes that they have. A stored view of as many stays: a thread that decoded the view
                before its depth changed may store it after the change.
            replace: Whether to overwrite a stored view whatever its version.

        Returns:
            Whether the view is stored.
        """
        if not self.fits:
            return False
        has_depth = not bool(pixels.inverse_depth.isnan().all())
        masks = [mask for mask in (pixels.static_mask, pixels.mask_border) if mask is not None]
        parts = [pixels.image.numpy(), *(np.packbits(mask.numpy()) for mask in masks)]
        parts += [pixels.inverse_depth.numpy()] * has_depth
        parts = [np.ascontiguousarray(part) for part in parts]
        file = self._files[index % NUM_FILES]
        with self._locks[index % NUM_FILES]:
            if index in self._stored and not replace and self._stored[index][2] >= version:
                return True
            # Others write there, too.
            if shutil.disk_usage(self.folder).free < sum(part.nbytes for part in parts) + SPARE_BYTES:
                return False
            self._stored.pop(index, None)
            file.seek(self._starts[index])
            with contextlib.suppress(OSError):  # a full disk: the view is decoded again
                if all(file.write(part.data) == part.nbytes for part in parts):
                    self._stored[index] = len(masks) > 1, has_depth, version
            return index in self._stored

    def load(self, index: int, pinned: bool) -> tuple[Pixels, int] | None:
        """The pixels of a view, and their version; None if they are not stored.

        Args:
            index: Index of the view.
            pinned: Whether to read into pinned memory, from which CUDA copies without waiting.
        """
        (width, height), file = self._sizes[index], self._files[index % NUM_FILES]
        with self._locks[index % NUM_FILES]:
            if index not in self._stored:
                return None
            has_border, has_depth, version = self._stored[index]
            image = torch.empty(height, width, 3, dtype=torch.uint8, pin_memory=pinned)
            depth = torch.empty(height, width, dtype=torch.half, pin_memory=pinned)
            bits = np.empty((1 + has_border, packed_bytes(width * height)), np.uint8)
            parts = [image.numpy(), bits, *[depth.numpy()] * has_depth]
            file.seek(self._starts[index])
            for part in parts:
                if file.readinto(part.data) != part.nbytes:
                    raise OSError(f"decoded views in {self.folder} cannot be read")
        if not has_depth:
            depth.fill_(torch.nan)
        masks = torch.from_numpy(np.unpackbits(bits, axis=1, count=height * width)).view(torch.bool)
        static, *border = (masks.pin_memory() if pinned else masks).view(-1, height, width).unbind()
        return Pixels(image, static, depth, border[0] if border else None), version
