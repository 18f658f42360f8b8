"""What an export format is, and what it gets to write."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from warpgs.data.capture import Capture
from warpgs.runs.run import Run

from .clouds import Clouds
from .command import Export


@dataclass
class Job:
    """One export.

    Attributes:
        run: The run to export.
        options: Options of the command.
        clouds: The Gaussians to write.
    """

    run: Run
    options: Export
    clouds: Clouds

    @property
    def folder(self) -> Path:
        """The output folder."""
        return self.options.out or self.options.run_folder / "export"

    @property
    def capture(self) -> Capture | None:
        """The capture of the run, opened on first use, because that can take a minute; None if it cannot be opened."""
        return self._capture[0]

    @property
    def capture_note(self) -> str:
        """A line about where the cameras come from."""
        return self._capture[1]

    @cached_property
    def _capture(self) -> tuple[Capture | None, str]:
        try:
            capture = self.run.open_capture(self.options.quiet)
        except (ValueError, OSError) as error:
            return None, f"default cameras, because the capture cannot be opened: {error}"
        return capture, f"cameras of {capture.name}"


class Writer(NamedTuple):
    """An export format.

    Attributes:
        write: Writes the files and returns a summary to print.
        options: Names of those options of ``Export`` that apply to this format but not to every other.
    """

    write: Callable[[Job], str]
    options: tuple[str, ...]
