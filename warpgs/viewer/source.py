"""The scene to show: the newest checkpoint of a run folder."""

import shutil
import threading
import time
from pathlib import Path

import torch

from warpgs.data.capture import Capture
from warpgs.editing import objects
from warpgs.editing.edited_scene import edited, with_edits, with_ids
from warpgs.editing.edits_file import edits_in_use, save_edits
from warpgs.editing.object_scene import ObjectScene, with_boxes
from warpgs.editing.options import Editing, Edits
from warpgs.errors import one_line
from warpgs.files import complete_or_absent
from warpgs.runs import checkpoint, config_file, preview
from warpgs.runs.opening import open_scene
from warpgs.runs.run import Device, Run
from warpgs.runs.trained import TrainedScene
from warpgs.video import keyframes

MAX_EDITED = 3
"""Maximum number of edits whose scenes are kept."""

POLL_SECONDS = 2.0
"""Interval between checks for a newer checkpoint while a browser is connected [s]."""


class Source:
    """The scene of a run, reloaded when there is a newer checkpoint.

    Args:
        run: The run, opened on the device to render on.
        follow: Whether to follow newer checkpoints. They are read only in calls of ``current``, so that a viewer
            without browsers does not slow down training.

    Attributes:
        run: The run.
        note: Why there is no (newer) scene; empty if there is one.
        edits: Edits that browsers begin with.
        progress: How far the training is that is followed; empty if unknown.

    Raises:
        ValueError: Without ``follow``, if the run has no valid checkpoint.
    """

    def __init__(self, run: Run, follow: bool = False) -> None:
        self.run, self.follow = run, follow
        self.note = self.progress = ""
        self._reading, self._asking, self._finding, self._copying = (threading.Lock() for _ in range(4))
        self._loaded: tuple[Path, int] | None = None
        self._checked = -POLL_SECONDS
        self._scene: TrainedScene | None = None if follow else run.trained_scene()
        self.edits, self._editing = Edits(), Editing()
        self._capture: Capture | None = None
        self._edited: dict[Edits, TrainedScene] = {}

    def edit(self, editing: Editing, capture: Capture | None) -> list[str]:
        """Begins with the edits of the options; returns lines about them. Raises as ``with_edits``."""
        assert self._scene is not None
        self._editing, self._capture = editing, capture
        self.edits = edits_in_use(self.run.folder, editing, self._scene)
        is_known = not self._scene.varies and objects.known_objects(self._scene, self.run.folder) is not None
        notes = self.find_objects() if is_known or self.edits.about_objects else []
        scene, more = with_edits(self._scene, self.run.folder, editing, lambda: capture)
        self._edited[self.edits] = scene
        return [*dict.fromkeys(notes + more)]

    @property
    def can_find_objects(self) -> bool:
        """Whether objects can be found and were not yet: not of a training that is followed, nor of a sequence."""
        scene = self._scene
        return not (self.follow or scene is None or scene.varies or isinstance(scene, ObjectScene))

    def find_objects(self) -> list[str]:
        """Finds objects unless they are known; returns lines about them. Raises as ``with_ids``."""
        with self._finding:
            if not self.can_find_objects:
                return []
            assert self._scene is not None
            self._scene, notes = with_ids(self._scene, self.run.folder, self.edits)
            self._edited = {}
            return notes

    def edited(self, edits: Edits) -> TrainedScene:
        """The scene with other edits, which is kept for all browsers; raises as ``edited_scene.edited``."""
        assert self._scene is not None
        if edits not in self._edited:
            self._edited = dict([*self._edited.items()][1 - MAX_EDITED :])
            self._edited[edits] = edited(self._scene, edits, self._capture)
        return self._edited[edits]

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects that were found, dynamic ones first, then those in boxes of the edits to begin with."""
        scene = self._scene
        if not isinstance(scene, ObjectScene):
            return ()
        return with_boxes(scene.of_dynamic, scene, self.edits.box).names

    def save(self, edits: Edits) -> Path:
        """Writes edits to the file of edits; raises as ``save_edits``, and as ``edited`` if they cannot be made."""
        self.edited(edits)
        assert self._scene is not None
        return save_edits(self.run.folder, self._editing, edits, self._scene)

    @property
    def can_copy(self) -> bool:
        """Whether it is of a run folder, not of files of other programs."""
        return (self.run.folder / config_file.NAME).exists()

    def copy(self, name: str, edits: Edits) -> Path:
        """Saves the plan and the checkpoint that is shown as another run beside this one, with edits of its own.

        Those have been made by ``edited``, which refuses some; this renders nothing, and one copy is written at a time.

        Raises:
            ValueError: If the name is none for a folder or taken, or the run was trained further since it was opened.
            OSError: If it cannot be written.
        """
        with self._copying:
            return self._copy(name, edits)

    def _copy(self, name: str, edits: Edits) -> Path:
        assert self._scene is not None
        folder, newest = self.run.folder.resolve().parent / name, self.run.newest_checkpoint()
        if not keyframes.NAME.fullmatch(name):
            raise ValueError(f"the name of a run must have 1 to 64 letters, digits, spaces, - and _, got {name!r}")
        if folder.exists():
            raise ValueError(f"{folder} exists already: choose another name")
        iteration = self._scene.metadata.iteration
        if newest is None or newest.name != checkpoint.path_of(folder, iteration).name:
            raise ValueError(f"the run was trained beyond iteration {iteration:,}, which is shown: open it again")
        with complete_or_absent(folder) as partial:
            copied = checkpoint.path_of(partial, iteration)
            copied.parent.mkdir()
            shutil.copyfile(newest, copied)
            for file in (config_file.NAME, objects.NAME):
                if (self.run.folder / file).exists():
                    shutil.copyfile(self.run.folder / file, partial / file)
            save_edits(partial, Editing(), edits, self._scene)
        return folder

    @property
    def device(self) -> torch.device:
        return self.run.device

    def current(self) -> TrainedScene | None:
        """The newest scene; the one before it if the newest cannot be read; None before the first checkpoint.

        A training that is followed is asked for what it has between its checkpoints. While one thread reads a newer
        scene, others get the one before it.
        """
        if self.follow and self._reading.acquire(blocking=False):
            try:
                if time.monotonic() - self._checked >= POLL_SECONDS:
                    self._checked = time.monotonic()
                    self._reload()
            finally:
                self._reading.release()
        return self._scene

    def stop(self) -> None:
        """Follows the run no longer; nothing of the viewer remains in its folder. A scene being read is not awaited."""
        with self._asking:
            if self.follow:
                self.follow = False
                preview.withdraw(self.run.folder)

    def _reload(self) -> None:
        with self._asking:
            if not self.follow:
                return
            preview.request(self.run.folder)
        try:
            newest = self._newest()
            if newest is None:
                self.note = "waiting for the first checkpoint"
                return
            file = (newest, newest.stat().st_mtime_ns)
            if file != self._loaded:
                self._scene = self.run.trained_scene(newest)
                self._loaded, self.note = file, ""
        except FileNotFoundError:
            return  # the trainer has replaced it by a newer one, which the next check finds
        except (ValueError, OSError) as error:
            self.note = one_line(error)

    def _newest(self) -> Path | None:
        """The newest checkpoint, or the preview that the trainer has written since; None without any."""
        newest, between = self.run.newest_checkpoint(), self.run.folder / preview.SCENE
        state = preview.read_state(self.run.folder)
        self.progress = "" if state is None else _described(state)
        if between.is_file() and (newest is None or between.stat().st_mtime_ns > newest.stat().st_mtime_ns):
            return between
        return newest


def _described(state: preview.State) -> str:
    """The state of a training in one line."""
    rate = "" if state.rate is None else f", {state.rate:.1f} it/s"
    return f"training: {state.iteration:,} of {state.num_iterations:,} iterations, {state.psnr:.1f} dB{rate}"


def open_source(folder: Path, device: Device | None, follow: bool) -> Source:
    """The source of a run folder, or of files as of ``open_scene``; on CUDA if ``device`` is None and there is a GPU.

    Raises:
        ValueError: If the folder is not a run folder, is damaged, has no checkpoint, or there is no such device.
    """
    return Source(Run.open(folder, device) if follow else open_scene(folder, device), follow)
