"""Members of .zip files, with sizes and methods that are checked before anything is decompressed."""

import re
import reprlib
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator
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


class DamagedError(ValueError):
    """An archive that is damaged, or not a .zip file."""


class Archive:
    """A .zip file whose members are read one at a time.

    Attributes:
        path: The file.
        sizes: Size of each member by its name, which is checked again when it is read [bytes].

    Raises:
        ValueError: If the file is missing or too large.
        DamagedError: If it is damaged, or not a .zip file.
    """

    def __init__(self, path: Path, max_bytes: int = MAX_BYTES) -> None:
        self.path = path
        require_file(path, max_bytes)
        with self._opened() as archive:
            self._members = {info.filename: info for info in archive.infolist()}
        self.sizes = {name: info.file_size for name, info in self._members.items()}

    def read(self, name: str, max_bytes: int) -> bytes:
        """The content of a member.

        Raises:
            ValueError: If it is larger than ``max_bytes``, or neither stored nor deflated.
            DamagedError: If it is damaged.
        """
        return next(content for _, content in self.read_all([name], max_bytes))

    def read_all(self, names: Iterable[str], max_bytes: int) -> Iterator[tuple[str, bytes]]:
        """Members, one after the other, as name and content; errors as for ``read``, of the file as in the class."""
        with self._opened() as archive:
            for name in names:
                yield name, self._content(archive, name, max_bytes)

    def require_plain(self) -> None:
        """Refuses names that lead out of the folder that the archive is unpacked into, links and devices.

        Raises:
            ValueError: If there is one; the message names it.
        """
        for name, info in self._members.items():
            where = f"{self.path}: {reprlib.repr(name)}"
            if re.match(r"/|[a-zA-Z]:", name) or "\\" in name or {"..", "."} & set(name.split("/")):
                raise ValueError(f"{where} is not a path below the folder that it would be unpacked into")
            if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG, stat.S_IFDIR):  # 0: made on Windows
                raise ValueError(f"{where} is a link or a device, expected a file or a folder")

    def _opened(self) -> zipfile.ZipFile:
        try:
            return zipfile.ZipFile(self.path)
        except DAMAGE as error:
            raise DamagedError(f"{self.path} is damaged or not a .zip file: {error}") from error

    def _content(self, archive: zipfile.ZipFile, name: str, max_bytes: int) -> bytes:
        info = self._members[name]
        where, size = f"{self.path}: {name}", info.file_size
        if size > max_bytes:
            raise ValueError(f"{where} has {size:,} bytes, more than the maximum of {max_bytes:,}")
        if size > max(MAX_SMALL, MAX_RATIO * info.compress_size):
            raise ValueError(f"{where} claims {size:,} bytes, too many for {info.compress_size:,} compressed ones")
        if info.compress_type not in METHODS:
            raise ValueError(f"{where} is compressed by method {info.compress_type}, expected stored or deflated")
        try:
            with archive.open(info) as file:
                return file.read(max_bytes)
        except DAMAGE as error:
            raise DamagedError(f"{where} is damaged: {error}") from error
