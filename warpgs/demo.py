"""``warpgs demo``: from a video to a page, by the commands that a user gives."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from .command_line.screen import show
from .errors import command, ending_at_once


@dataclass(frozen=True)
class Demo:
    """Goes all the way once: ray-traces a short video, prepares it, trains, and exports a page.

    It shows every command before it runs; the same command continues after an interruption. About five minutes on two
    CPU cores.
    """

    folder: Annotated[Path, tyro.conf.Positional] = Path("warpgs-demo")
    """Folder for the video, the capture and the run; made if there is none."""


def run(options: Demo) -> int:
    """Runs all steps; returns the exit code of the first that fails, else 0.

    Raises:
        OSError: If the folder or the video cannot be written.
    """
    with ending_at_once():
        from .prepare.frames.sample import write_sample  # imports torch and Warp
        from .runs.config_file import NAME
        from .runtime.devices import choose_device
    folder = options.folder
    video, capture, trained = folder / "video.mp4", folder / "capture", folder / "run"
    folder.mkdir(parents=True, exist_ok=True)
    if not video.exists():
        write_sample(video, log=show)
    preset = "best" if choose_device(None) == "cuda" else "quick"
    training = ["--data", capture, "--preset", preset, "--out", trained]
    for arguments in (
        ["prepare", video, capture, "--holdout", 8],
        ["train", *(["--resume", trained] if (trained / NAME).exists() else training)],
        ["export", trained, "--format", "html"],
    ):
        show(f"$ {command(*arguments)}")
        if code := _run([sys.executable, "-m", "warpgs", *map(str, arguments)]):
            return code
    show(f"open {trained / 'export/scene.html'}, or run {command('view', trained)}")
    return 0


def _run(arguments: list[str]) -> int:
    """Runs a command to its end, and returns its exit code."""
    with subprocess.Popen(arguments) as process:
        while True:
            try:
                return process.wait()
            except KeyboardInterrupt:  # which the command got, too: it writes a checkpoint and ends
                continue
