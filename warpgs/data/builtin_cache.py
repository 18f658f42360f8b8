"""Where built-in captures are kept: each is made on its first use, in the user's cache."""

import atexit
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpgs.command_line.screen import show_error
from warpgs.files import complete_or_absent


def cached(folder: Path, write: Callable[[Path], None], quiet: bool) -> Path:
    """The folder, which ``write`` fills on the first call; one line on stderr says so unless ``quiet``.

    Raises:
        OSError: If it cannot be written; the message names the file or folder.
    """
    if not folder.is_dir():
        if not quiet:
            show_error(f"warpgs: making the built-in capture {folder}, once: this can take a minute")
        with complete_or_absent(folder, keep_existing=True) as partial:
            write(partial)
    return folder


def content_folder(cache_dir: Path | None, content: Any) -> Path:
    """The folder for a built-in capture of some content, given as plain values.

    Args:
        cache_dir: Folder of all of them; ``cache_folder`` if None.
        content: What the capture is made from; another content has another folder.
    """
    if cache_dir is None:
        cache_dir = cache_folder("built-in captures")
    return cache_dir / hashlib.blake2b(json.dumps(content).encode(), digest_size=6).hexdigest()


def cache_folder(content: str) -> Path:
    """The user's cache of warpgs; if it cannot be written a folder that is removed at exit, with a warning.

    Args:
        content: What is to be kept there, for the warning.
    """
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warpgs"
        folder.mkdir(parents=True, exist_ok=True)
        reason = "" if os.access(folder, os.W_OK) else f"{folder} cannot be written"
    except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
        reason = str(error)
    if not reason:
        return folder
    folder = Path(tempfile.mkdtemp(prefix="warpgs-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    show_error(
        f"warpgs: no cache for {content} ({reason}): they are kept in {folder} until the program ends; "
        "set XDG_CACHE_HOME to a folder that can be written"
    )
    return folder
