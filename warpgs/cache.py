"""The user's cache folder."""

import atexit
import os
import shutil
import tempfile
from pathlib import Path

from warpgs.command_line.screen import show_error


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
