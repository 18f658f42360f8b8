"""What an export format is, and what it gets to write."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from warpgs.data.capture import Capture
from warpgs.editing.edited_scene import with_edits
from warpgs.model.segmented_deformation import SegmentedDeformation
from warpgs.runs.run import Run
from warpgs.runs.scene_file import SceneFile
from warpgs.video import orientation
from warpgs.video.camera_paths import UP

from .clouds import Clouds
from .options import Export


@dataclass
class Job:
    """One export.

    Attributes:
        run: The run to export.
        options: Options of the command.
        has_objects: Whether its files have the objects that Gaussians belong to.
        notes: Lines to print after the summary.
    """

    run: Run
    options: Export
    has_objects: bool = False
    notes: list[str] = field(default_factory=list)

    @cached_property
    def clouds(self) -> Clouds:
        """The Gaussians to write: those that edits leave."""
        run, editing, quiet = self.run, self.options.editing, self.options.quiet
        scene, notes = with_edits(
            run.trained_scene(), run.folder, editing, lambda: self.capture, quiet, self.has_objects
        )
        self.notes += notes
        if isinstance(scene.scene.deformation, SegmentedDeformation):
            scene.scene.deformation.is_complete = True
        return Clouds(scene)

    @property
    def folder(self) -> Path:
        """The output folder."""
        return self.options.out or self.run.folder / "export"

    def file(self, name: str) -> Path:
        """Where a file of this name is written: ``--out`` if that ends as it does, else in the output folder."""
        return self.folder if self.options.is_out_file(Path(name).suffix) else self.folder / name

    @property
    def capture(self) -> Capture | None:
        """The capture of the run, opened on first use, because that can take a minute; None if it cannot be opened."""
        return self._capture[0]

    @property
    def capture_note(self) -> str:
        """A line about where the cameras come from."""
        capture, error = self._capture
        return f"default cameras, because {error}" if capture is None else f"cameras of {capture.name}"

    def rotation(self, y_up: bool | None) -> Float64[np.ndarray, "3 3"]:
        """From the scene's coordinates to those of the files.

        Args:
            y_up: As of ``Writer``.
        """
        up = self._up[0]
        if up is None or y_up is None:
            return np.eye(3)
        return orientation.upright(up, y_up)

    @property
    def up_note(self) -> str:
        """A line about the orientation of the files."""
        return self._up[1]

    @cached_property
    def _up(self) -> tuple[tuple[float, ...] | None, str]:
        """The upward direction in scene coordinates, None to keep them, and a line about it."""
        option = self.options.up
        if option == "scene":
            return None, "in the coordinates of the scene"
        if option in orientation.AXES:
            return orientation.AXES[option], f"turned upright: {option} of the scene is up"
        if self.capture is None:
            return UP, f"-y is taken as up (otherwise give --up), because {self._capture[1]}"
        up = tuple(orientation.vertical(self.capture).tolist())
        shown = ", ".join(f"{value:.2f}" for value in up)
        return up, f"turned upright: ({shown}) in scene coordinates is up, from the training cameras"

    @cached_property
    def _capture(self) -> tuple[Capture | None, str]:
        """The capture, or None and why."""
        if isinstance(self.run, SceneFile) and not self.run.has_capture:
            return None, f"{self.run.files[0].name} has no capture, which --data gives"
        try:
            return self.run.open_corrected_capture(self.options.quiet), ""
        except (ValueError, OSError) as error:
            return None, f"the capture cannot be opened: {error}"


class Writer(NamedTuple):
    """An export format.

    Attributes:
        write: Writes the files and returns a summary to print.
        options: Names of those options of ``Export`` that apply to this format but not to every other.
        suffix: End of its file names, with the dot; ``--out`` may be such a file. Empty if it has to be a folder.
        has_background: Whether its files have the colour behind the Gaussians; the summary names it otherwise.
        has_sky: Whether its files have the sky; the summary says that they lack it otherwise.
        has_objects: Whether its files have the objects that Gaussians belong to.
        y_up: Whether readers assume that y points up instead of down; None if files keep the scene's coordinates.
    """

    write: Callable[[Job], str]
    options: tuple[str, ...]
    suffix: str = ""
    has_background: bool = False
    has_sky: bool = False
    has_objects: bool = False
    y_up: bool | None = False
