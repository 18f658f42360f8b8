"""What of a capture in the making is done: kept beside it, so that the same command goes on where it stopped."""

import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpgs.files import write_json

REPORT = "prepare.json"
"""Beside the capture: options, results and seconds of every step, notes."""

MADE = (
    "rgb", "resized_mask", "camera", "depth", "points.npy", "scene.json", "metadata.json", "dataset.json",
    "masks.png", "depth.png", REPORT,
)  # fmt: skip
"""All that is made in the capture's folder, beside the work folder."""

STATE = "state.json"
"""In the work folder: options, the steps that are done, and notes."""


class Journal:
    """The steps that are done.

    Attributes:
        root: The capture's folder.
        work: Its folder for what is needed until it is finished.
        notes: What to tell the user at the end.
    """

    def __init__(self, root: Path, options: dict[str, Any], force: bool, quiet: bool) -> None:
        """Starts anew, or takes up what was begun with the same options; nothing is changed yet.

        Raises:
            ValueError: If the folder holds something else, or a capture that was made with other options, and ``force``
                is not given.
        """
        self.root, self.work, self.quiet = root, root / ".prepare", quiet
        self._options = options
        self._done: dict[str, Any] = {}
        self.notes: list[str] = []
        if root.exists() and not root.is_dir():
            raise ValueError(f"{root} is a file: choose another folder")
        if not force and root.exists() and any(root.iterdir()):
            self._done, self.notes = self._begun()

    def _begun(self) -> tuple[dict[str, Any], list[str]]:
        try:
            state = json.loads((self.work / STATE).read_text())
            begun, done, notes = dict(state["options"]), dict(state["done"]), list(state["notes"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            if list(self.root.iterdir()) == [self.work]:  # stopped within the first step
                return {}, []
            raise ValueError(
                f"{self.root} exists and was not begun by prepare: choose another folder, or replace the capture in it "
                "with --force"
            ) from error
        changed = [key for key in self._options if begun.get(key) != self._options[key]]
        if changed and "capture" in done:
            raise ValueError(
                f"{self.root} was made with other options ({', '.join(changed)}): choose another folder, or replace "
                "it with --force"
            )
        return ({}, []) if changed else (done, notes)  # what failed may be tried with other options

    def clear(self, keep: Path) -> None:
        """Removes what prepare makes, and nothing else; ``keep`` within the work folder stays.

        Raises:
            OSError: If something can't be removed or written.
        """
        self._save()  # first: what an interruption leaves must not count as finished
        leftovers = [path for path in self.work.iterdir() if path.name not in (STATE, keep.name)]
        for path in [*(self.root / name for name in MADE), *leftovers]:
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    @property
    def is_finished(self) -> bool:
        """Whether nothing is left to do."""
        return "finished" in self._done

    def step(self, name: str, work: Callable[[], str]) -> None:
        """Does a step unless it is done; ``work`` returns its result in words."""
        if name in self._done:
            text, when = self._done[name]["result"], "done before"
        else:
            start = time.perf_counter()
            text = work()
            seconds = round(time.perf_counter() - start, 1)
            self._done[name] = {"seconds": seconds, "result": text}
            self._save()
            when = f"{seconds:.1f} s"
        if text and not self.quiet:
            print(f"{name}: {text} ({when})", flush=True)

    def finish(self) -> None:
        """Writes the report and removes what is not needed any more."""
        steps = {name: facts["result"] for name, facts in self._done.items()}
        seconds = {name: facts["seconds"] for name, facts in self._done.items()}
        write_json(self.root / REPORT, {**self._options, "steps": steps, "seconds": seconds, "notes": self.notes})
        self._done["finished"] = {"seconds": 0.0, "result": ""}
        self._save()
        for path in self.work.iterdir():
            if path.name != STATE:
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    def _save(self) -> None:
        write_json(self.work / STATE, {"options": self._options, "done": self._done, "notes": self.notes})
