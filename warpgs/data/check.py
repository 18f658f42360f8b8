"""Checks whether a capture is fit to train on: reads it as training does and measures what makes training fail."""

from pathlib import Path

from .builtin import is_builtin
from .capture import Capture
from .depth_check import check_depth
from .findings import Finding, Report
from .frames_check import check_counts, check_files
from .loaders import describe_layout, load_capture, missing_capture
from .motion_check import check_motion
from .points_check import check_points
from .turning_check import check_turning

SAMPLES = 12
"""Frames whose content is checked, evenly spread over the capture; all frames are read."""

QUICK_SAMPLES = 3
"""Frames that ``quick_findings`` checks."""


def check_capture(root: Path, dataset: str | None = None, factor: int | None = None) -> Report:
    """Reads every frame of a capture and checks it; arguments as for ``load_capture``.

    Raises:
        ValueError: If there is no such folder.
    """
    if not is_builtin(root) and not root.exists():
        raise ValueError(missing_capture(root))
    try:
        capture = load_capture(root, dataset, factor=factor, cache_frames=2 * SAMPLES)
    except ValueError as error:
        return Report(root, [Finding("error", "files", str(error))])
    findings = [
        Finding("note", "layout", f"read as {describe_layout(root, dataset)}"),
        *check_counts(capture),
        *check_files(capture),
    ]
    if not any(f.level == "error" and f.topic not in ("masks", "evaluation") for f in findings):
        for check in (check_points, check_turning, check_depth, check_motion):
            findings += check(capture, SAMPLES)
    return Report(root, findings)


def quick_findings(capture: Capture) -> list[Finding]:
    """Notes of the loader, and errors and warnings from the cameras, the points and three frames of a capture.

    It takes less than a second. A capture that is assumed to be static (``Capture.assuming``) may have a single time.

    Raises:
        ValueError: If one of the three frames cannot be read.
    """
    findings = [*check_counts(capture), *check_points(capture.assuming("masks"), QUICK_SAMPLES)]
    return [f for f in findings if f.level != "note" or f.topic == "files"]
