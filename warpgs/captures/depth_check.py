"""Compares the depth of a capture with its sparse points, or with its cameras where the points are made of it."""

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from warpgs.data.capture import Capture, Frame
from warpgs.data.depth_alignment import (
    MAX_ERROR,
    MAX_ERROR_OF_CONSTANT,
    DepthProblem,
    PointSamples,
    align_to_points,
    alignment_problem,
    is_unusable,
    relative_errors,
    sample_points,
)
from warpgs.data.depth_unit import fit_unit

from .findings import Finding

DEPTH_PROBLEMS: dict[DepthProblem, str] = {
    "unknown": "is known nowhere: its files hold no finite positive numbers",
    "few points": "is known at fewer than 16 of the points that they see, which is too few to align it",
    "constant": "is the same at all points",
    "flat": "cannot be aligned to the points, which are all equally far from the camera",
    "inverted": "cannot be aligned to the points: it grows with distance, but must be inverse depth, larger is closer",
}
"""What is wrong with depth that cannot be aligned."""

INVERSE_FOR_DEPTH = (
    "cannot be aligned to the points: it shrinks with distance, as inverse depth and disparities do, but must be "
    "depth, larger is farther"
)
"""The same as "inverted" for files that must hold depth."""

MAX_FACTOR = 1.2
"""Median ratio of metric depth and the depth of points, above which its unit is wrong."""

MAX_POINTS = 50_000
"""Maximum number of points that depth is compared with."""


def check_depth(capture: Capture, names: Sequence[str]) -> Iterator[Finding]:
    """Compares the depth of some frames with their cameras, or with the points as training does."""
    frames = [frame for name in names if (frame := capture.frame(name)).inverse_depth is not None]
    if not frames:
        return
    of = f"the depth of {{}} of {len(frames)} frames"
    if (unit := capture.conventions.depth_unit) is not None and (wrong := _wrong_unit(frames, unit)):
        yield Finding("warning", "depth", f"{of.format(len(frames))} {wrong}")
        return
    samples = _depth_at_points(frames, capture.points)
    if not len(capture.points) and any(bool(part.is_known) for part in samples) and not capture.metric_depth:
        text = f"{of.format(len(frames))} is not used, because it is aligned to sparse points and there are none"
        yield Finding("warning", "depth", text)
        return
    yield from _compare_with_points(samples, capture, of)


def _wrong_unit(frames: Sequence[Frame], unit: str) -> str | None:
    """What is wrong with the unit of depth that must be that of the cameras; None if nothing shows that it is."""
    fit = fit_unit(frames)
    if fit.is_beaten_by(fit_unit(frames, is_inverted=True)):
        return "does not fit the cameras: it seems to be inverse depth or disparities, but must be depth"
    if not fit.is_wrong:
        return None
    times = f"{float(f'{fit.factor:.1g}'):,g}"
    return f"does not fit the cameras: its unit, {unit}, must be about {times} times as large"


def _compare_with_points(samples: Sequence[PointSamples], capture: Capture, of: str) -> Iterator[Finding]:
    """Aligns depth to the points as training does, and measures its error."""
    pairs = list(zip(samples, align_to_points(samples, capture.metric_depth), strict=True))
    # Metric depth needs no alignment, but whether one is possible tells its errors apart.
    fitted = list(zip(samples, align_to_points(samples), strict=True)) if capture.metric_depth else pairs
    problems = Counter(problem for pair in pairs if (problem := alignment_problem(*pair)))
    problems.update(p for pair in fitted if capture.metric_depth and (p := alignment_problem(*pair)) == "inverted")
    holds_depth = capture.metric_depth or capture.conventions.depth == "depth"
    for problem, number in problems.items():
        if problem != "few points" or len(capture.points):  # without points, there is a warning already
            text = INVERSE_FOR_DEPTH if problem == "inverted" and holds_depth else DEPTH_PROBLEMS[problem]
            yield Finding("warning", "depth", f"{of.format(number)} {text}")
    errors = torch.stack([relative_errors(*pair) for pair in pairs])
    known = errors.isfinite().all(1)
    if bool(known.any()):
        median = float(np.median(errors[known, 0]))
        kind = "metric" if capture.metric_depth else "aligned"
        text, constant = f"{kind} depth is {median:.1%} off at the points (median)", float(np.median(errors[known, 1]))
        if median <= MAX_ERROR and median >= MAX_ERROR_OF_CONSTANT * constant:
            text += f", but a constant is {constant:.1%} off: the points do not tell whether depth is right"
        yield Finding("note", "depth", text)
        if capture.metric_depth and "inverted" not in problems:
            yield from _metric_factor([s for s, is_known in zip(samples, known.tolist(), strict=True) if is_known])
    if unusable := int(is_unusable(errors).sum()):
        which = f"{of.format(unusable)} is hardly better than a constant"
        yield Finding("warning", "depth", f"{which}: presets other than paper do not use it")


def _metric_factor(samples: Sequence[PointSamples]) -> Iterator[Finding]:
    factor = float(np.median([float((1.0 / (part.values * part.depth)).median()) for part in samples]))
    if max(factor, 1.0 / factor) > MAX_FACTOR:
        text = f"depth is about {float(f'{factor:.2g}'):,g} times as large as the depth of the points"
        remedy = "it must be in metres, and scene.json's scale must be per metre"
        yield Finding("warning", "depth", f"{text}: {remedy}")


def _depth_at_points(frames: Sequence[Frame], points: torch.Tensor) -> list[PointSamples]:
    """The depth of frames at the points."""
    points, samples = points[:: max(1, len(points) // MAX_POINTS)], []
    for frame in frames:
        assert frame.inverse_depth is not None
        everywhere = torch.ones(frame.image.shape[:2], dtype=torch.bool)
        static = everywhere if frame.static_mask is None else frame.static_mask
        samples.append(sample_points(frame.inverse_depth, static, frame.camera, points))
    return samples
