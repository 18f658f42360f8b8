"""The video of a camera path: rendered by the command in a process of its own, shown as it proceeds, and downloaded."""

import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

from warpgs.command_line.progress import AS_LINES
from warpgs.errors import one_line
from warpgs.posix import interrupt
from warpgs.runs.run import Run

from .panel import set_value
from .path_controls import CANCEL, RENDER, PathControls
from .video_options import VideoOptions

PROGRESS = re.compile(r"^rendering (\d+)/(\d+)$")
"""A line of the command about its progress."""


class PathVideo:
    """Renders the video of a path, one at a time.

    Args:
        controls: Controls of the browser.
        run: The run, on whose device the video is rendered.
        note: Shows a text.
        download: Lets the browser download a file by a name.
    """

    def __init__(
        self,
        controls: PathControls,
        run: Run,
        note: Callable[[str], None],
        download: Callable[[str, bytes], None],
    ) -> None:
        self._controls, self._run, self._note, self._send = controls, run, note, download
        self._lock = threading.Lock()
        self._child: subprocess.Popen[str] | None = None
        self._is_cancelled = self._is_stopped = False
        self._video: Path | None = None
        controls.download.on_click(lambda _: self._download())

    def cancel(self) -> bool:
        """Ends a video that is being rendered, as Ctrl-C does: nothing is left of it; whether there was one."""
        with self._lock:
            if self._child is None or self._child.poll() is not None:
                return False
            self._is_cancelled = True
            interrupt(self._child)
        return True

    def stop(self) -> None:
        """Ends a video that is being rendered, and shows nothing any more."""
        self._is_stopped = True
        self.cancel()

    def render(self, path: Path, options: VideoOptions) -> None:
        """Renders a path that was saved; returns when its video is complete."""
        folder, size = self._run.folder, "{}x{}".format(*options.size)
        with self._lock:
            if self._is_stopped or (self._child is not None and self._child.poll() is None):
                return
            command = [sys.executable, "-m", "warpgs", "render", str(self._run.path), "--keyframes", str(path)]
            command += [
                "--write",
                "mp4",
                "--frames",
                str(options.frames),
                "--rate",
                f"{options.rate:g}",
                "--size",
                size,
            ]
            self._is_cancelled = False
            self._child = child = subprocess.Popen(
                [*command, "--device", self._run.device.type],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, AS_LINES: "1"},
            )
        self._show(f"rendering {path.stem}, {options.frames} frames …", rendering=True)
        errors = self._follow(child)
        output = child.stdout.read() if child.stdout is not None else ""
        done = child.wait() == 0
        lines = (output if done else errors).strip().splitlines()
        text = one_line(ValueError(lines[-1])) if lines else f"the video ended with {child.returncode}"
        if done:
            self._video = folder / "render" / path.stem / "video.mp4"
        self._show("the video was cancelled" if self._is_cancelled and not done else text, rendering=False)

    def _follow(self, child: "subprocess.Popen[str]") -> str:
        """Shows the progress of a process until it ends; returns what else it writes."""
        others = []
        for line in child.stderr or ():
            match = PROGRESS.match(line.strip())
            if match is None:
                others.append(line)
            elif not self._is_stopped:
                set_value(self._controls.progress, 100.0 * int(match[1]) / max(1, int(match[2])))
        return "".join(others)

    def _show(self, text: str, rendering: bool) -> None:
        if self._is_stopped:
            return
        self._note(text)
        self._controls.render.label = CANCEL if rendering else RENDER
        self._controls.download.disabled = rendering or self._video is None
        if rendering or self._is_cancelled:
            set_value(self._controls.progress, 0.0)
        self._controls.progress.visible = rendering or not self._is_cancelled

    def _download(self) -> None:
        video = self._video
        if video is None:
            return
        try:
            content = video.read_bytes()
        except OSError as error:
            self._note(one_line(error))
            return
        self._send(f"{video.parent.name}.mp4", content)
