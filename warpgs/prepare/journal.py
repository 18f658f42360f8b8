"""The journal of a capture's preparation: which steps are finished, kept in the capture's folder until all are."""

import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from errno import ENOSPC
from pathlib import Path
from typing import Any, TypeVar

from warpgs.data.writer import FINISHED, REPORT, STATE, WORK
from warpgs.files import read_json, write_json
from warpgs.locks import LOCK

OUTPUTS = (
    "rgb", "resized_mask", "camera", "depth", "points.npy", "point_colors.npy", "scene.json", "metadata.json",
    "dataset.json", "masks.png", "depth.png", REPORT,
)  # fmt: skip
"""Everything that prepare writes into the capture's folder, apart from the work folder."""

FRAME = re.compile(r"(frame|\d+)_\d{6}\.(png|png\.png|npy|json)(\.partial)?")
"""Names of the files in these folders, also of those that were being written at an interruption."""

VERSION = 7
"""Version of the intermediate files; an unfinished preparation of another version starts afresh."""

ADVICE = "free some disk space and run the same command again"

Result = TypeVar("Result")


class Journal:
    """Runs the steps of a preparation, each once, even if the preparation is interrupted and started again.

    Attributes:
        root: Folder of the capture.
        work: Folder inside it for the steps' intermediate files.
        notes: Messages for the user, reported at the end.
        log: Receives a line of text after each step.
        quiet: Whether to show no progress bars.
    """

    def __init__(self, root: Path, options: dict[str, Any], force: bool, log: Callable[[str], None] | None) -> None:
        """Starts afresh, or resumes what was started with the same options. Changes nothing on disk.

        Args:
            root: Folder of the capture.
            options: All options, as JSON types.
            force: Whether to replace what is in the folder.
            log: Receives a line of text after each step; None for no output at all.

        Raises:
            ValueError: If the folder holds something else, or a capture made with other options, and not ``force``;
                with ``force``, if it holds a capture that prepare did not make.
        """
        self.root, self.work = root, root / WORK
        self.quiet, self.log = log is None, log or (lambda text: None)
        self._options = options
        self._done: dict[str, Any] = {}
        self.notes: list[str] = []
        if force:
            self._require_own_outputs()
        elif self._contents():
            self._done, self.notes = self._read_state()

    def _contents(self) -> set[str]:
        """Names of everything in the folder of the capture but the lock that this process holds."""
        return {path.name for path in self.root.iterdir()} - {LOCK} if self.root.exists() else set()

    def _require_own_outputs(self) -> None:
        if (self.work / STATE).exists() or (self.root / REPORT).exists():
            return
        paths = (self.root / name for name in OUTPUTS)
        foreign = [
            path.name
            for path in paths
            if path.is_symlink() or path.is_file() or (path.is_dir() and any(path.iterdir()))
        ]
        if foreign:
            raise ValueError(
                f"{self.root} was not made by prepare, which would replace its {', '.join(foreign)}: choose another "
                "folder"
            )

    def _read_state(self) -> tuple[dict[str, Any], list[str]]:
        try:
            state = read_json(self.work / STATE)
            begun, done, notes = dict(state["options"]), dict(state["done"]), list(map(str, state["notes"]))
            done = {name: {"result": str(e["result"]), "seconds": float(e["seconds"])} for name, e in done.items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            if self._contents() == {WORK}:  # interrupted during the first step
                return {}, []
            self._require_own_outputs()
            raise ValueError(
                f"{self.root} exists and was not made by prepare: choose another folder, or add the capture to what "
                "is there with --force"
            ) from error
        if state.get("version") != VERSION and FINISHED not in done:
            return {}, []  # the intermediate files of an earlier version differ
        begun = {"camera": "moving", "holdout_camera": [], **begun}  # as it was before there were these options
        before, now = _flat(begun), _flat(self._options)
        changed = [f"{key} {before.get(key)}, now {now[key]}" for key in now if before.get(key) != now[key]]
        if changed and "capture" in done:
            raise ValueError(
                f"{self.root} was made with other options ({'; '.join(changed)}): choose another folder, or replace "
                "it with --force"
            )
        return ({}, []) if changed else (done, notes)  # an unfinished capture starts afresh with the new options

    @property
    def is_finished(self) -> bool:
        """Whether all steps are finished."""
        return FINISHED in self._done

    def step(self, name: str, work: Callable[[], str], files: Callable[[], Iterable[Path]]) -> None:
        """Runs ``work``, which returns a summary of its result, unless the step of this name is finished.

        A finished step of whose ``files`` one is missing or empty is done again, and so are all that came after it. The
        summary is logged, and so are the notes that ``work`` appended.
        """
        if name in self._done and (lost := first_lost(files())) is not None:
            self.log(f"note: {lost}, which an earlier call wrote, is missing: {name} is done again")
            finished = [*self._done]
            for later in finished[finished.index(name) :]:
                del self._done[later]
            self._save()
        if name in self._done:
            summary, when, noted = self._done[name]["result"], "finished before", len(self.notes)
        else:
            start, noted = time.perf_counter(), len(self.notes)
            summary = work()
            self.notes[:] = dict.fromkeys(self.notes)  # a step that is done again notes the same
            seconds = round(time.perf_counter() - start, 1)
            self._done[name] = {"seconds": seconds, "result": summary}
            self._save()
            when = f"{seconds:.1f} s"
        self.log(f"{name}: {summary} ({when})")
        for note in self.notes[noted:]:
            self.log(f"note: {note}")

    def result(
        self,
        name: str,
        load: Callable[[Path], Result],
        make: Callable[[Path], str],
        files: Callable[[Path], Iterable[Path]],
    ) -> Result:
        """The result of a step.

        Args:
            name: Name of the step; its path in the work folder follows from it.
            load: Reads the result from this path.
            make: Writes the result to this path and returns a summary; not called if the step is finished.
            files: The files of the result at this path, which must be there if the step is to count as finished.

        Raises:
            ValueError: If the result was damaged since it was written.
        """
        path = self.work / name.replace(", ", "-").replace(" ", "-")
        self.step(name, lambda: make(path), lambda: files(path))
        try:
            return load(path)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"{path}, a result of an earlier call, is damaged ({error}): use --force") from error

    def require_space(self, megabytes: int) -> None:
        """Checks the free disk space before something large is written: COLMAP aborts the process on a full disk.

        Raises:
            OSError: If there is too little.
        """
        self.work.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self.work).free // 1_000_000
        if free < megabytes:
            raise OSError(f"{self.root}: {megabytes} MB of disk are needed, {free} MB are free; {ADVICE}")

    @contextmanager
    def explain_full_disk(self) -> Iterator[None]:
        """Turns the errors of a full disk into an error that explains how to continue."""
        try:
            yield
        except OSError as error:
            if error.errno == ENOSPC:
                raise OSError(f"{self.root}: the disk is full; {ADVICE}") from error
            raise

    def clear(self, keep: Path) -> None:
        """Removes the outputs of prepare and nothing else, not even other files in its folders.

        ``keep`` in the work folder stays.

        Raises:
            OSError: If something cannot be removed or written.
        """
        self._save()  # first: what is left after an interruption must not count as finished
        for path in self.work.iterdir():
            if path.name not in (STATE, keep.name):
                _remove(path)
        for path in (self.root / name for name in OUTPUTS):
            if path.is_dir() and not path.is_symlink():
                _remove_frames(path)
            else:
                path.unlink(missing_ok=True)

    def finish(self) -> None:
        """Writes the report and removes the intermediate files."""
        steps = {name: entry["result"] for name, entry in self._done.items()}
        seconds = {name: entry["seconds"] for name, entry in self._done.items()}
        write_json(self.root / REPORT, {**self._options, "steps": steps, "seconds": seconds, "notes": self.notes})
        self._done[FINISHED] = {"seconds": 0.0, "result": ""}
        self._save()
        for path in self.work.iterdir():
            if path.name != STATE:
                _remove(path)

    def report(self) -> dict[str, Any]:
        """The report of a finished preparation."""
        return read_json(self.root / REPORT)

    def _save(self) -> None:
        write_json(
            self.work / STATE, {"version": VERSION, "options": self._options, "done": self._done, "notes": self.notes}
        )


def first_lost(paths: Iterable[Path]) -> Path | None:
    """The first of some paths at which there is nothing, or an empty file, as after a power failure."""
    return next((path for path in paths if not path.exists() or (path.is_file() and not path.stat().st_size)), None)


def _remove(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()


def _remove_frames(folder: Path) -> None:
    """Removes the files of frames below a folder, and the folders that are empty then."""
    for path in [*sorted(folder.rglob("*"), reverse=True), folder]:  # what a folder holds comes before the folder
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()):
                path.rmdir()
        elif path.is_dir() or FRAME.fullmatch(path.name):  # through a link, the new capture would read old frames
            path.unlink()


def _flat(options: dict[str, Any]) -> dict[str, Any]:
    """Options by name, also those in groups."""
    groups = {key: value if isinstance(value, dict) else {key: value} for key, value in options.items()}
    return {key: value for group in groups.values() for key, value in group.items()}
