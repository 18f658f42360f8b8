"""Checks whether a capture is fit to train on: reads it as training does and measures what makes training fail.

Training runs the cheap part of the same checks before it begins, so that both say the same in the same words.
"""

import time
from collections.abc import Callable
from pathlib import Path

from warpgs.data.capture import Assumption, Capture
from warpgs.data.dynamic_regions import DynamicCounts
from warpgs.data.read_ahead import ReadAhead
from warpgs.data.writer import REPORT
from warpgs.files import read_json

from .agreement_check import check_agreement
from .check_sample import Content, Sample, read_contents
from .depth_check import check_depth
from .findings import Finding, Report, UnfitCaptureError
from .frames_check import check_counts, check_files
from .given import require_given
from .masks_check import are_suspect, check_dynamic_depth, check_empty_masks, check_masks
from .motion_check import Motion, check_motion, motions_of
from .opening import load_capture
from .points_check import check_points
from .tracks_check import check_tracks
from .turning_check import check_turning

READ_SECONDS = 15.0
"""Time after which only frames that are compared are still read [s]: a check takes at most 30 s on two cores."""


def check_capture(
    root: Path, dataset: str | None = None, factor: int | None = None, assume: Assumption = "masks"
) -> Report:
    """Checks a capture; reads every frame of it that it has time for.

    Args:
        root: As for ``load_capture``.
        dataset: As for ``load_capture``.
        factor: As for ``load_capture``.
        assume: What training will take as dynamic, as ``--assume`` says.

    Raises:
        ValueError: If there is no such folder, or built-in capture.
    """
    deadline = time.monotonic() + READ_SECONDS
    require_given(root)
    try:
        capture = load_capture(root, dataset, factor=factor, cache_frames=1).assuming(assume)
    except ValueError as error:
        return Report(root, [Finding("error", "files", str(error))])
    sample = Sample(capture)
    contents = read_contents(capture, sample, deadline)
    findings = [
        Finding("note", "layout", f"read as {capture.layout}"),
        *check_counts(capture),
        *check_files(capture, contents),
    ]
    is_readable = not any(f.level == "error" and f.topic not in ("masks", "evaluation") for f in findings)
    motions = motions_of(sample.capture, sample.pairs) if is_readable else []
    if masks := _masks(capture, contents):
        findings += [*_judge(capture, masks, motions), *check_dynamic_depth([*masks.values()])]
    if is_readable:
        readable = {name for name, content in contents.items() if content.error is None}
        findings += _compare(sample, motions, readable)
    return Report(root, [*findings, *_noted(root)])


def _compare(sample: Sample, motions: list[Motion], readable: set[str]) -> list[Finding]:
    """What frames say of points, cameras and depth; all training frames can be read, but maybe not all others."""
    capture, names = sample.capture, sample.names
    return [
        *check_points(capture, names),
        *check_turning(capture, names),
        *check_depth(capture, names),
        *check_tracks(capture, names),
        *check_motion(motions, capture.conventions.masks),
        *check_agreement(capture, [cameras.of(readable) for cameras in sample.compared]),
    ]


def quick_findings(capture: Capture) -> list[Finding]:
    """Notes of the loader, and the errors and warnings of the checks that are cheap, before training.

    They read a few frames, which training needs anyway. Motion is compared only if the masks give reason to.

    Args:
        capture: The capture; one that is assumed to be static (``Capture.assuming``) may have a single time.

    Raises:
        ValueError: If a frame cannot be read.
    """
    sample = Sample(capture)
    contents = {name: sample.look(name) for name in sample.names}
    findings = [*check_counts(capture)]
    if (masks := _masks(capture, contents)) and are_suspect([*masks.values()]):
        every = ReadAhead(sample.look).each(capture.train)
        masks = _masks(capture, dict(zip(capture.train, every, strict=True)))
        motions = motions_of(sample.capture, sample.pairs)
        findings += [*_judge(capture, masks, motions), *check_motion(motions, capture.conventions.masks)]
    findings += [*check_points(sample.capture, sample.names), *check_depth(sample.capture, sample.names)]
    return [f for f in findings if f.level != "note" or f.topic == "files"]


def require_fit(capture: Capture, log: Callable[[str], None]) -> None:
    """Checks a capture before training; logs warnings and where its times come from.

    Args:
        capture: As for ``quick_findings``.
        log: Receives lines for the user.

    Raises:
        UnfitCaptureError: If it has errors that would make training useless.
        ValueError: If one of three training frames cannot be read; the message names its file.
    """
    findings = quick_findings(capture)
    errors = [finding for finding in findings if finding.level == "error"]
    for finding in findings:
        if finding not in errors:
            log(str(finding))
    if not capture.time_source.problem and not capture.is_builtin:  # problems are among the warnings
        log(capture.time_source.text)
    if errors:
        raise UnfitCaptureError(errors)


def _noted(root: Path) -> list[Finding]:
    """What ``warpgs prepare`` noted of a capture that it made."""
    report = root / REPORT
    try:
        notes = read_json(report).get("notes", []) if report.is_file() else []
    except ValueError as error:
        return [Finding("warning", "preparation", str(error))]
    noted = notes if isinstance(notes, list) else []
    return [Finding("warning", "preparation", f"warpgs prepare noted: {note}") for note in noted]


def _judge(capture: Capture, masks: dict[str, DynamicCounts], motions: list[Motion]) -> list[Finding]:
    """What is to be said of masks by themselves."""
    return [*check_masks([*masks.values()], capture, motions), *check_empty_masks(capture, masks)]


def _masks(capture: Capture, contents: dict[str, Content]) -> dict[str, DynamicCounts]:
    """Counts of the dynamic pixels in the masks of training frames that were read; none if masks are not used."""
    dynamic = {name: contents[name].dynamic for name in capture.train if name in contents}
    used = dynamic if capture.assumption == "masks" else {}
    return {name: counts for name, counts in used.items() if counts is not None}
