"""From a video or a folder of frames to a capture."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from warpgs.errors import command
from warpgs.files import kept_if_used, read_json
from warpgs.locks import lock_folder

from .cameras.recovered import MISLED, Cameras, NoCamerasError
from .checks import check_options, find_videos
from .doubts import DOUBTFUL_FRACTION
from .journal import Journal, first_lost
from .masks.files import Masks
from .masks.methods import MASKERS
from .options import Options
from .scene import capture_files
from .steps import Steps, names_of, take

MAX_DYNAMIC_FRACTION = 0.6
"""Fraction of dynamic pixels above which the cameras must be wrong."""


def prepare(
    source: Path | Sequence[Path],
    root: Path,
    options: Options | None = None,
    *,
    force: bool = False,
    log: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Makes a capture from videos or a folder of frames; continues after the last finished step if interrupted.

    Args:
        source: Video, or folder of PNG or JPEG frames; or several videos of one event.
        root: Folder of the capture.
        options: How to make it; the defaults if None.
        force: Whether to replace a capture in the folder.
        log: Receives the result of each step as a line of text; None shows nothing, progress bars included.

    Returns:
        The content of prepare.json: options, results and seconds of all steps, notes.

    Raises:
        ValueError: If an option is invalid, the folder holds something else, or the source is not suitable; the message
            says why and what to try. If another process prepares the same folder.
        ImportError: If a network's package is missing.
        OSError: If a file cannot be written, or the disk is full.
    """
    options = options or Options()
    sources = [source] if isinstance(source, Path) else [*source]
    check_options(sources, root, options)
    with lock_folder(root, "prepared"):
        return _prepare(sources, root, options, force, log)


def _prepare(
    sources: list[Path], root: Path, options: Options, force: bool, log: Callable[[str], None] | None
) -> dict[str, Any]:
    """``prepare`` in a folder that is locked."""
    chosen = {"source": sources if len(sources) > 1 else sources[0], **asdict(options), "depth": options.depth_method}
    journal = Journal(root, json.loads(json.dumps(chosen, default=lambda p: str(p.resolve()))), force, log)
    if was_finished := journal.is_finished:
        _require_whole(root)
    else:
        with journal.explain_full_disk(), kept_if_used(journal.work):
            _run_steps(sources, options, journal)
    report = journal.report()
    for note in report["notes"] if was_finished else []:  # the steps have logged them otherwise
        journal.log(f"note: {note}")
    sheets = "masks.png and depth.png" if (root / "depth.png").exists() else "masks.png"
    done = f"{root} is finished: look at {sheets} in it, then run {command('check', root)}"
    journal.log(f"{root} was finished before; --force makes it again" if was_finished else done)
    return report


def _require_whole(root: Path) -> None:
    """Raises ValueError if a finished capture lacks a file: the frames that it was made from are removed."""
    index = root / "dataset.json"
    lost = first_lost([index]) or first_lost(capture_files(root, list(map(str, read_json(index).get("ids", [])))))
    if lost is not None:
        raise ValueError(f"{root} was finished before, but {lost} is missing: make the capture again with --force")


def _run_steps(sources: list[Path], options: Options, journal: Journal) -> None:
    """The algorithm of docs/prepare.md. Finished steps are skipped and their results read from the work folder."""
    held_out = find_videos([*map(str, sources)], options.holdout_camera)
    steps, masks = Steps(take(sources, options, journal), options, journal, held_out), Masks()
    if MASKERS.get(options.masks) is not None:
        first = steps.recover_background("cameras, first pass")
        masks = steps.find_masks("masks", first)
        if masks.dynamic_fraction > DOUBTFUL_FRACTION:  # dynamic objects have misled the cameras
            first, masks = _repair(first, masks, steps)
        cameras = steps.refine("cameras", first, masks)
        if cameras[0].error < MISLED * first[0].error or masks.dynamic_fraction > DOUBTFUL_FRACTION:
            masks = steps.find_masks("masks, second pass", cameras)
    else:
        if options.masks not in MASKERS:  # a folder
            masks = steps.copy_masks("masks")
        cameras = steps.recover("cameras", steps.names, masks)
    steps.write_capture("capture", cameras, masks)
    steps.add_depth("depth", cameras)
    journal.finish()


def _repair(first: list[Cameras], masks: Masks, steps: Steps) -> tuple[list[Cameras], Masks]:
    """Cameras of the first pass, and masks, without the dynamic objects that have misled the cameras.

    At half size, errors of the cameras are half as large in pixels, so that only the worst objects look dynamic.

    Raises:
        ValueError: If nearly everything still looks dynamic.
    """
    if steps.options.camera != "moving":
        if masks.dynamic_fraction > MAX_DYNAMIC_FRACTION:
            raise ValueError(
                f"{masks.dynamic_fraction:.0%} of the pixels seem to move: the camera is not {steps.options.camera}; "
                "try another --camera"
            )
        return first, masks
    worst = steps.find_masks("masks, worst only", first, half_size=True)
    try:
        first = steps.recover("cameras, without the worst", names_of(first), worst, thorough=False)
        masks = steps.find_masks("masks, without the worst", first)
    except NoCamerasError:  # the masks leave too little
        pass
    if masks.dynamic_fraction > DOUBTFUL_FRACTION:
        first = steps.recover("cameras, weak features", steps.names, thorough=False, weak_features=True)
        masks = steps.find_masks("masks, weak features", first)
    if masks.dynamic_fraction > MAX_DYNAMIC_FRACTION:
        raise ValueError(
            f"{masks.dynamic_fraction:.0%} of the pixels seem to move: the cameras that were found fit only a small "
            "part of the frames; take more frames (--fps, --count), record more static and textured surfaces, or give "
            "masks of what moves (--masks FOLDER)"
        )
    return first, masks
