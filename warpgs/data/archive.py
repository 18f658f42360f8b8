"""Members of .zip files, with sizes and methods that are checked before anything is decompressed."""

import struct
import zipfile
import zlib
from pathlib import Path

from warpgs.files import require_file

METHODS = {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}
"""Compression that is read; NumPy and ViPE use no other. LZMA takes as much memory as its header says, up to 4 GiB."""

MAX_SMALL, MAX_RATIO = 64 << 20, 200
"""Size up to which a member may be compressed by any ratio, and the maximum ratio of larger ones: images of a video
rarely reach 10, and 1,000 is the most that deflate can do, of zeros."""

DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, OSError, EOFError, ValueError, OverflowError, RuntimeError)
"""Errors of a damaged archive: RuntimeError if a member is encrypted, OverflowError for offsets beyond 63 bits."""

MAX_BYTES = 64 << 30
"""Maximum size of a .zip file [bytes]."""


class Archive:
    """A .zip file whose members are read one at a time.

    Attributes:
        path: The file.
        sizes: Size of each member by its name, which is checked again when it is read [bytes].

    Raises:
        ValueError: If the file is missing, too large or damaged.
    """

    def __init__(self, path: Path, max_bytes: int = MAX_BYTES) -> None:
        self.path = path
        require_file(path, max_bytes)
        try:
            with zipfile.ZipFile(path) as archive:
                self._members = {info.filename: info for info in archive.infolist()}
        except DAMAGE as error:
            raise ValueError(f"{path} is damaged or not a .zip file: {error}") from error
        self.sizes = {name: info.file_size for name, info in self._members.items()}

    def read(self, name: str, max_bytes: int) -> bytes:
        """The content of a member.

        Raises:
            ValueError: If it is larger than ``max_bytes``, damaged, or neither stored nor deflated.
        """
        info = self._members[name]
        where, size = f"{self.path}: {name}", info.file_size
        if size > max_bytes:
            raise ValueError(f"{where} has {size:,} bytes, more than the maximum of {max_bytes:,}")
        if size > max(MAX_SMALL, MAX_RATIO * info.compress_size):
            raise ValueError(f"{where} claims {size:,} bytes, too many for {info.compress_size:,} compressed ones")
        if info.compress_type not in METHODS:
            raise ValueError(f"{where} is compressed by method {info.compress_type}, expected stored or deflated")
        try:
            with zipfile.ZipFile(self.path) as archive, archive.open(info) as file:
                return file.read(max_bytes)
        except DAMAGE as error:
            raise ValueError(f"{where} is damaged: {error}") from error
