"""Camera paths as the viewer saves them: keyframes in a JSON file, for ``warpgs render --keyframes``."""

import json
import re
from collections.abc import Sequence
from pathlib import Path

from warpgs.cameras import Camera
from warpgs.files import write_text

FOLDER = "paths"
"""Where a run folder keeps the paths that the viewer saves."""

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9 _-]{0,63}")
"""A name comes from a browser: nothing that leads out of the folder."""


def path_of(run: Path, name: str) -> Path:
    """A file in a run folder for a new path; numbered if there is one of this name.

    Raises:
        ValueError: If the name is no plain name.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"a path's name is of letters, digits, spaces, - and _, at most 64 of them, got {name!r}")
    stem = run / FOLDER / name
    return next(
        p for k in range(1, 10_000) if not (p := Path(f"{stem}.json" if k == 1 else f"{stem}-{k}.json")).exists()
    )


def write_path(path: Path, cameras: Sequence[Camera]) -> None:
    """Writes cameras as keyframes, in their order.

    Raises:
        ValueError: If there is none.
        OSError: If the file can't be written; the message names it.
    """
    if not cameras:
        raise ValueError("a path needs at least one keyframe")
    keyframes = [
        {
            "time": camera.time,
            "viewmat": camera.viewmat.tolist(),
            "K": camera.K.tolist(),
            "width": camera.width,
            "height": camera.height,
        }
        for camera in cameras
    ]
    write_text(path, json.dumps({"keyframes": keyframes}, indent=2) + "\n")
