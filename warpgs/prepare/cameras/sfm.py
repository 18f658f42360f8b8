"""Structure from motion with COLMAP: cameras and sparse points of a video's frames.

SIFT features, matching, global or incremental mapping with bundle adjustment; one lens for all frames of a camera.
COLMAP runs in a process of its own (``colmap``): a crash, a full disk or Ctrl-C there is one line here.
"""

import errno
import json
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpgs.command_line.progress import progress_of_steps
from warpgs.data.colmap import parameters_of_lens
from warpgs.data.lens import Lens

from ..options import LensModel
from .recovered import Cameras, NoCamerasError, load_all

MIN_FREE = 5_000_000
"""Free disk space below which a failure of COLMAP is attributed to a full disk [bytes]."""

LOG = "colmap.log"
"""File in the work folder with what COLMAP writes to stderr."""


@dataclass(frozen=True)
class Settings:
    """How to recover cameras.

    Attributes:
        lens: COLMAP's lens model.
        masks: Folder of masks <name>.png.png; matches are used where they are not 0.
        thorough: Whether to match frames far apart in time that see the same points, and to refine with them.
        weak_features: Whether to use features of low contrast too: more on plain surfaces, but less exact.
        focal: Known focal length [px]; None to find it.
        refine: Whether to refine the cameras that were recovered last in the work folder instead of starting anew.
        known: The lens of the frames, which is kept; None to find it.
        turns: Whether the camera only turns.
    """

    lens: LensModel = "SIMPLE_RADIAL"
    masks: Path | None = None
    thorough: bool = True
    weak_features: bool = False
    focal: float | None = None
    refine: bool = False
    known: Lens | None = None
    turns: bool = False


def recover_cameras(folder: Path, names: list[str], work: Path, settings: Settings, quiet: bool = True) -> Cameras:
    """The cameras of the frames <folder>/<name>.png of one video.

    ``work`` is for COLMAP's files; features and matches in it are used again.

    Raises:
        NoCamerasError: If the frames are not suitable; the message says why and what to try.
        ValueError: If COLMAP itself failed.
        OSError: If the disk is full.
    """
    return _recover(_job(folder, names, work, settings), 1, quiet)[0]


@dataclass(frozen=True)
class Shots:
    """Frames of one of several cameras.

    Attributes:
        source: Its video, for messages.
        names: Names of the frames; a single one if it stands still.
        times: Their times on the clock of all cameras [ms].
    """

    source: str
    names: list[str]
    times: list[int]


def recover_several(
    folder: Path, cameras: Sequence[Shots], work: Path, settings: Settings, quiet: bool = True
) -> list[Cameras]:
    """The cameras of the frames of several videos in one world, in the order of ``cameras``.

    Other arguments and errors as for ``recover_cameras``.
    """
    several = {
        "cameras": [k for k, camera in enumerate(cameras) for _ in camera.names],
        "times": [time for camera in cameras for time in camera.times],
        "sources": [camera.source for camera in cameras],
    }
    job = _job(folder, [name for camera in cameras for name in camera.names], work, settings)
    return _recover({**job, **several}, len(cameras), quiet)


def _job(folder: Path, names: list[str], work: Path, settings: Settings) -> dict[str, Any]:
    """The fields of ``features.Job``."""
    model, params = (settings.lens, None) if settings.known is None else parameters_of_lens(settings.known)
    return {
        "folder": str(folder.resolve()),
        "names": names,
        "work": str(work.resolve()),
        "lens": model,
        "params": params,
        "turns": settings.turns,
        "masks": None if settings.masks is None else str(settings.masks.resolve()),
        "thorough": settings.thorough,
        "weak_features": settings.weak_features,
        "focal": settings.focal,
        "refine": settings.refine and (work / "model").is_dir(),
    }


def _recover(job: dict[str, Any], num_cameras: int, quiet: bool) -> list[Cameras]:
    """The cameras that COLMAP's process finds."""
    folder, work = job["folder"], Path(job["work"])
    work.mkdir(parents=True, exist_ok=True)
    code, answer = _run(job, work / LOG, quiet)
    if answer.get("result") and code == 0:
        return load_all(work / str(answer["result"]), num_cameras)
    if shutil.disk_usage(work).free < MIN_FREE:
        raise OSError(errno.ENOSPC, "No space left on device", str(work))
    if answer.get("unsuitable"):
        raise NoCamerasError(str(answer["error"]))
    raise ValueError(f"COLMAP failed on {folder}: {answer.get('error') or _ending(code, work / LOG)}")


def _run(job: dict[str, Any], log: Path, quiet: bool) -> tuple[int, dict[str, Any]]:
    """Runs a job; returns the exit code of COLMAP's process and its last line."""
    command = [sys.executable, "-m", "warpgs.prepare.cameras.colmap"]
    answer: dict[str, Any] = {}
    with log.open("wb") as errors, progress_of_steps(quiet) as show:
        # In a session of its own, Ctrl-C reaches this process only.
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True, start_new_session=True
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with process.stdin, process.stdout:
                process.stdin.write(json.dumps(job) + "\n")
                process.stdin.flush()  # it stays open: when this process ends, COLMAP's does
                for line in process.stdout:
                    answer = json.loads(line)
                    if "label" in answer:
                        show(answer["label"], answer["done"], answer["total"])
                return process.wait(), answer
        except BrokenPipeError:
            return process.wait(), answer
        finally:
            process.kill()
            process.wait()


def _ending(code: int, log: Path) -> str:
    """How COLMAP's process ended without an answer, in words."""
    name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    lines = log.read_text("utf-8", errors="replace").strip().splitlines()
    advice = "; out of memory? try --longest-side 640 or fewer frames" if name == "SIGKILL" else ""
    return f"its process ended with {name}{advice}" + (f" ({lines[-1][:200]})" if lines else "")
