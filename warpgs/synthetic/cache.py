"""Where built-in captures are kept: each is made on its first use, in the user's cache."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpgs.cache import cache_folder
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
