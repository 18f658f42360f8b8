"""Compares the depth of a capture with its sparse points."""

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from .capture import Capture
from .depth_alignment import (
    DepthProblem,
    PointSamples,
    align_to_points,
    alignment_problem,
    is_unusable,
    relative_errors,
    sample_points,
)
from .findings import Finding

DEPTH_PROBLEMS: dict[DepthProblem, str] = {
    "unknown": "is known nowhere: its files hold no finite positive numbers",
    "few points": "is known at fewer than 16 of the points that they see, which is too few to align it",
    "constant": "is the same at all points",
    "inverted": "cannot be aligned to the points: it grows with distance, but must be inverse depth, larger is closer",
}
"""What is wrong with depth that cannot be aligned."""


def check_depth(capture: Capture, names: Sequence[str]) -> Iterator[Finding]:
    """Aligns the depth of the sampled frames to the points as training does, and measures its error."""
    samples = list(_depth_at_points(capture, names))
    count = len(samples)
    if count == 0:
        return
    pairs = list(zip(samples, align_to_points(samples, capture.metric_depth), strict=True))
    problems = Counter(problem for pair in pairs if (problem := alignment_problem(*pair)))
    for problem, number in problems.items():
        if problem != "few points" or len(capture.points):  # without points, there is a warning already
            yield Finding("warning", "depth", f"the depth of {number} of {count} frames {DEPTH_PROBLEMS[problem]}")
    errors = torch.stack([relative_errors(*pair) for pair in pairs])
    known = errors.isfinite().all(1)
    if bool(known.any()):
        median = float(np.median(errors[known, 0]))
        kind = "metric" if capture.metric_depth else "aligned"
        yield Finding("note", "depth", f"{kind} depth is {median:.1%} off at the points (median)")
    if unusable := int(is_unusable(errors).sum()):
        which = f"the depth of {unusable} of {count} frames is hardly better than a constant"
        yield Finding("warning", "depth", f"{which}: presets other than paper do not use it")


def _depth_at_points(capture: Capture, names: Sequence[str]) -> Iterator[PointSamples]:
    """The depth of the sampled frames that have any, at the points."""
    for name in names:
        frame = capture.frame(name)
        if frame.inverse_depth is not None:
            everywhere = torch.ones(frame.image.shape[:2], dtype=torch.bool)
            static = everywhere if frame.static_mask is None else frame.static_mask
            yield sample_points(frame.inverse_depth, static, frame.camera, capture.points)
