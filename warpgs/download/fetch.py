"""Archives in the user's cache, downloaded by pooch, which compares hashes; interrupted downloads are continued."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pooch
import requests

from warpgs.command_line.progress import progress_of_steps
from warpgs.data.archive import MAX_BYTES
from warpgs.data.published import Release
from warpgs.errors import one_line
from warpgs.files import partial_path, reworded
from warpgs.locks import lock_folder

CHUNK = 1 << 18
"""Bytes that are written at once; as many are lost when a connection breaks."""

TIMEOUT = 60
"""Time without an answer after which a connection counts as lost [s]."""

BROKEN = (requests.ConnectionError, requests.Timeout, requests.exceptions.ChunkedEncodingError)
"""Errors of a connection that broke."""


def fetch(release: Release, folder: Path, show: Callable[[str], object]) -> Path:
    """The archive of a release: downloaded, unless it is there with the right hash.

    Args:
        release: The release.
        folder: Folder of the user's cache for the archives of the dataset.
        show: Receives what is downloaded, and the hash of an archive of which none is known.

    Raises:
        ValueError: If its hash is wrong, which the message has with the expected one, or another process writes there.
        OSError: If it cannot be downloaded or written; the message says where to put it by hand.
        KeyboardInterrupt: After Ctrl-C, with a message.
    """
    pooch.get_logger().setLevel("ERROR")  # it tells programmers how to call it
    path = folder / urlsplit(release.address).path.rpartition("/")[2]
    downloader = Downloader(partial_path(path), show)
    with lock_folder(folder, "written"):
        try:
            pooch.retrieve(release.address, release.sha256, path.name, folder, downloader=downloader)
        except requests.RequestException as error:
            message = f"{release.address} could not be downloaded: {_reason(error)}"
            raise reworded(error, f"{message}; the same command tries again, or put the file at {path}") from error
        except OSError as error:
            raise reworded(error, f"{path} could not be written: {error.strerror or error}") from error
        except KeyboardInterrupt as stop:
            raise KeyboardInterrupt(f"stopped; the same command continues the download of {path.name}") from stop
        if downloader.is_used and release.sha256 is None:
            show(f"{path} has the SHA-256 {pooch.file_hash(str(path))}, compared with none: the right one is not known")
    return path


class Downloader:
    """Downloads files for pooch, and continues those that an earlier call began.

    Attributes:
        is_used: Whether it was called.
    """

    def __init__(self, partial: Path, show: Callable[[str], object]) -> None:
        self.is_used = False
        self._partial = partial
        self._show = show

    def __call__(self, url: str, output_file: str, pooch: Any, check_only: bool = False) -> None:
        """Downloads a file; the arguments are pooch's."""
        self.is_used = True
        self._show(f"{'continuing' if self._size() else 'downloading'} {url}")
        while True:
            before = self._size()
            try:
                self._continue(url)
                break
            except BROKEN:
                if self._size() <= before:  # as long as each attempt brings something, the next one follows
                    raise
        os.replace(self._partial, output_file)

    def _size(self) -> int:
        return self._partial.stat().st_size if self._partial.exists() else 0

    def _continue(self, url: str) -> None:
        start = self._size()
        headers = {"Accept-Encoding": "identity"} | ({"Range": f"bytes={start}-"} if start else {})
        with requests.get(url, headers=headers, stream=True, timeout=TIMEOUT) as response:
            if start and response.status_code == requests.codes.requested_range_not_satisfiable:
                if response.headers.get("Content-Range") != f"bytes */{start}":  # else it is complete
                    self._partial.unlink()
                    self._continue(url)
                return
            response.raise_for_status()
            if response.status_code != requests.codes.partial_content:
                start = 0
            total = start + int(response.headers.get("Content-Length", 0))
            with open(self._partial, "ab" if start else "wb") as file, progress_of_steps() as progress:
                for part in response.iter_content(CHUNK):
                    start += file.write(part)
                    if start > MAX_BYTES:
                        raise requests.RequestException(f"it has more than the maximum of {MAX_BYTES:,} bytes")
                    progress(self._partial.stem, start, max(start, total))


def _reason(error: requests.RequestException) -> str:
    if isinstance(error, requests.HTTPError):
        return f"the server answers {error.response.status_code} {error.response.reason}"
    if isinstance(error, requests.exceptions.SSLError):
        return "the certificate of the server is not valid"
    if isinstance(error, requests.Timeout):
        return f"no answer within {TIMEOUT} s"
    if isinstance(error, BROKEN):
        return "there is no connection, or it broke"
    return one_line(error)
