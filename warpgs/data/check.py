"""Checks whether a capture is fit to train on: reads it as training does and measures what makes training fail."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from warpgs.cameras import Camera
from warpgs.errors import visible

from .builtin import is_builtin
from .capture import MASKS_REMEDY, MIN_EXTENT, Capture, Frame
from .depth_alignment import (
    DepthProblem,
    PointSamples,
    align_to_points,
    alignment_problem,
    is_unusable,
    relative_errors,
    sample_points,
)
from .dynamic_regions import MIN_FRAMES, MIN_KNOWN_FRACTION, dynamic_regions, is_cut, unknown_depth
from .loaders import describe_layout, load_capture, missing_capture
from .motion_check import are_comparable, motion_between
from .sampling import evenly_spaced_indices
from .turning_check import turning_of

Level = Literal["error", "warning", "note"]

MIN_VISIBLE_FRACTION = 0.2
"""Median fraction of the points that a training camera should see."""

MIN_POINT_CONTRAST = 0.8
"""Contrast at the points over that of the image: 2 to 4 for COLMAP's points, about 1 for those of a depth sensor."""

MIN_POINT_DISTANCE = 0.01
"""Points closer to a camera than this fraction of the capture's extent are not on surfaces."""

MAX_FRACTION_AT_CAMERAS = 0.01
"""Maximum fraction of such points."""

MAX_DYNAMIC_FRACTION = 0.4
"""Mean fraction of dynamic pixels; masks with more are rarely correct."""

MAX_EPIPOLAR_DISTANCE = 3.0
"""Maximum median distance of static pixels from their epipolar lines [px]; more means that cameras and images do not
match."""

DEPTH_PROBLEMS: dict[DepthProblem, str] = {
    "unknown": "is known nowhere: its files hold no finite positive numbers",
    "few points": "is known at fewer than 16 of the points that they see, which is too few to align it",
    "constant": "is the same at all points",
    "inverted": "cannot be aligned to the points: it grows with distance, but must be inverse depth, larger is closer",
}
"""What is wrong with depth that cannot be aligned."""

SAMPLES = 12
"""Frames whose content is checked, evenly spread over the capture; all frames are read."""

QUICK_SAMPLES = 3
"""Frames that ``quick_findings`` checks."""


@dataclass(frozen=True)
class Finding:
    """One result of the check.

    Attributes:
        level: "error" if training would fail, "warning" if quality would suffer, "note" otherwise.
        topic: The part of the capture that it concerns, in one word.
        text: One sentence.
    """

    level: Level
    topic: str
    text: str

    def __str__(self) -> str:
        return f"{self.level}: {visible(self.text)}"


@dataclass(frozen=True)
class Report:
    """All findings of a capture."""

    root: Path
    findings: list[Finding]

    @property
    def is_fit(self) -> bool:
        """Whether there are no errors."""
        return not any(f.level == "error" for f in self.findings)

    def plain(self) -> dict[str, Any]:
        """The report as a JSON object."""
        return {"capture": str(self.root), "fit": self.is_fit, "findings": [asdict(f) for f in self.findings]}

    def __str__(self) -> str:
        order = {"note": 0, "warning": 1, "error": 2}
        lines = [str(f) for f in sorted(self.findings, key=lambda f: order[f.level])]
        verdict = "fit to train on" if self.is_fit else "not fit to train on"
        return "\n".join([*lines, f"{visible(str(self.root))}: {verdict}"])


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
        *_counts(capture),
        *_files(capture),
    ]
    if not any(f.level == "error" and f.topic not in ("masks", "evaluation") for f in findings):
        findings += [*_geometry(capture, SAMPLES), *_turning(capture), *_depth(capture), *_motion(capture)]
    return Report(root, findings)


def quick_findings(capture: Capture) -> list[Finding]:
    """Notes of the loader, and errors and warnings from the cameras, the points and three frames of a capture.

    It takes less than a second.

    A capture that is assumed to be static (``Capture.assuming``) may have a single time.

    Raises:
        ValueError: If one of the three frames cannot be read.
    """
    findings = [*_counts(capture), *_geometry(capture.assuming("masks"), QUICK_SAMPLES)]
    return [f for f in findings if f.level != "note" or f.topic == "files"]


def _sampled(names: Sequence[str], count: int) -> list[str]:
    return [names[k] for k in evenly_spaced_indices(len(names), count)]


def _counts(capture: Capture) -> Iterator[Finding]:
    """Notes of the loader, numbers of frames and their times."""
    yield from (Finding("note", "files", text) for text in capture.notes)
    sizes = sorted({camera.size for camera in capture.cameras.values()})
    shown = ", ".join(f"{w}×{h}" for w, h in sizes[:4])
    yield Finding("note", "counts", f"{len(capture.train)} frames to train on, {len(capture.val)} to evaluate, {shown}")
    times = sorted(capture.cameras[name].time for name in capture.train)
    distinct = len(set(times))
    yield Finding("note", "time", f"times from {times[0]:.3f} to {times[-1]:.3f}, {distinct} distinct")
    if distinct == 1 and len(times) > 1:
        text = "all training frames have one time: time_id in metadata.json, or what the layout has for it, is wrong"
        if capture.assumption == "static":
            yield Finding("warning", "time", text)
        else:
            yield Finding("error", "time", f"{text}; train a scene without motion with --assume static")
    elif times[-1] - times[0] < 0.5:
        yield Finding("warning", "time", "training frames cover less than half of the time range")
    late = [n for n in capture.val if not times[0] <= capture.cameras[n].time <= times[-1]]
    if late:
        yield Finding("warning", "time", f"{len(late)} evaluation frames lie before or after all training frames")
    if len(capture.train) < 10:
        yield Finding("warning", "counts", f"{len(capture.train)} training frames are very few")


def _files(capture: Capture) -> Iterator[Finding]:
    """Reads every frame; counts masks and depth, and checks the masks of the training frames."""
    trained, unmasked, num_read, num_masks, num_depths = [], [], 0, 0, 0
    for name in (*capture.train, *capture.val):
        is_trained = name in capture.train
        try:
            frame = capture.frame(name)
        except ValueError as error:
            # The other checks read training frames only.
            yield Finding("error", "files" if is_trained else "evaluation", str(error))
            continue
        num_read += 1
        num_depths += frame.inverse_depth is not None
        has_mask = frame.static_mask is not None and capture.assumption == "masks"
        num_masks += has_mask
        if is_trained and has_mask:
            trained.append(_dynamic_counts(frame))
        elif is_trained:
            unmasked.append(name)
    frames = "frames" if num_read == len(capture.train) + len(capture.val) else "readable frames"
    yield Finding("note", "files", f"{num_masks} of {num_read} {frames} have masks, {num_depths} have depth")
    if capture.assumption == "dynamic":
        yield Finding("note", "masks", "there are no masks, as this layout has none: everything is taken as dynamic")
        return
    if unmasked:
        some = f"{len(unmasked)} of {len(unmasked) + len(trained)} training frames, such as {unmasked[0]},"
        which = some if trained else "the training frames"
        yield Finding("error", "masks", f"{which} have no masks: make them {MASKS_REMEDY}")
    if trained:
        yield from _masks(trained)


def _masks(frames: list[_DynamicCounts]) -> Iterator[Finding]:
    """Checks the masks of training frames."""
    dynamic = [frame.fraction for frame in frames]
    if max(dynamic) == 0.0:
        yield Finding("warning", "masks", "the masks mark nothing as dynamic")
    elif min(dynamic) == 1.0:
        yield Finding("error", "masks", "the masks mark everything as dynamic: 0 must mean dynamic, 255 static")
    else:
        mean = float(np.mean(dynamic))
        text = f"the masks mark {mean:.1%} of the pixels as dynamic on average, {max(dynamic):.1%} at most"
        yield Finding("warning" if mean > MAX_DYNAMIC_FRACTION else "note", "masks", text)
        yield from _dynamic_depth(frames)


class _DynamicCounts(NamedTuple):
    """Numbers of dynamic regions, of those that the border cuts off, of dynamic pixels, and of those with depth.

    Attributes:
        fraction: Dynamic pixels as a fraction of all pixels of the frame.
    """

    regions: int
    cut: int
    pixels: int
    fraction: float
    with_depth: int


def _dynamic_counts(frame: Frame) -> _DynamicCounts:
    assert frame.static_mask is not None
    regions, is_dynamic = dynamic_regions(frame), ~frame.static_mask
    with_depth = 0 if frame.inverse_depth is None else int((frame.inverse_depth.isfinite() & is_dynamic).sum())
    pixels = int(is_dynamic.sum())
    return _DynamicCounts(len(regions), sum(map(is_cut, regions)), pixels, pixels / is_dynamic.numel(), with_depth)


def _dynamic_depth(frames: list[_DynamicCounts]) -> Iterator[Finding]:
    """Whether something tells the depth of what moves in the training frames."""
    is_known = sum(f.with_depth for f in frames) >= MIN_KNOWN_FRACTION * sum(f.pixels for f in frames)
    num_whole = sum(f.cut < f.regions for f in frames)
    if any(f.regions for f in frames) and num_whole < MIN_FRAMES and not is_known:
        yield Finding("warning", "depth", unknown_depth(sum(f.cut > 0 for f in frames), len(frames)))


def _geometry(capture: Capture, samples: int) -> Iterator[Finding]:
    """Compares cameras, points and images with each other."""
    cameras = [capture.cameras[name] for name in capture.train]
    if capture.extent <= MIN_EXTENT:
        yield Finding("warning", "cameras", "the camera hardly moves: depth cannot be learned from it")
    if len(capture.points) == 0:
        remedy = "warpgs prepare CAPTURE --add points adds some (after warpgs import, if the layout needs it)"
        text = f"there are no sparse points: Gaussians are randomly initialized; {remedy}"
        yield Finding("warning", "points", text)
        return
    names = _sampled(capture.train, samples)
    visible = [float(capture.cameras[n].project(capture.points)[3].float().mean()) for n in names]
    median = float(np.median(visible))
    yield Finding("note", "points", f"{len(capture.points)} points, a camera sees {median:.0%} of them (median)")
    if median == 0.0:
        text = "the cameras do not see the points: orientation, position or scene.json's center and scale are wrong"
        yield Finding("error", "points", text)
        return
    if median < MIN_VISIBLE_FRACTION:
        yield Finding("warning", "points", f"a camera sees only {median:.0%} of the points (median)")
    yield from _points_at_cameras(capture, cameras)
    contrasts = [c for n in names if (c := _contrast_at_points(capture.frame(n), capture.points)) is not None]
    if contrasts:
        ratio = float(np.median(contrasts))
        low = ratio < MIN_POINT_CONTRAST
        text = f"contrast at the points is {ratio:.2f} times that of the images"
        hint = ": points and cameras may not match the images" if low else ""
        yield Finding("warning" if low else "note", "points", text + hint)


def _turning(capture: Capture) -> Iterator[Finding]:
    """Whether the images show parallax at all."""
    names = sorted(capture.train, key=lambda name: capture.cameras[name].time)
    found = turning_of([capture.frame(name) for name in _sampled(names, SAMPLES)])
    if found is None or not any(turning.only_turns for turning in found):
        return
    searched, known = (f"{turning.explained:.0%}" for turning in found)
    if all(turning.only_turns for turning in found):
        text = (
            f"the camera only turns: a rotation explains {searched} of the matches between frames, so depth and "
            "positions are undetermined; move the camera sideways"
        )
        # Cameras that all stand at one place say so themselves, as those of warpgs prepare --camera turning do.
        yield Finding("error" if capture.extent > MIN_EXTENT else "warning", "cameras", text)
    else:
        text = (
            f"a rotation explains {searched} of the matches between frames with the best focal length, {known} with "
            "that of the cameras: the camera only turns and its focal length is wrong, or it moves before a plane"
        )
        yield Finding("warning", "cameras", text)


def _points_at_cameras(capture: Capture, cameras: list[Camera]) -> Iterator[Finding]:
    positions = torch.stack([camera.position for camera in cameras[:: max(1, len(cameras) // 200)]])
    points = capture.points[:: max(1, len(capture.points) // 20_000)]
    nearest = torch.cat([torch.cdist(part, positions).amin(1) for part in points.split(2000)])
    fraction = float((nearest < MIN_POINT_DISTANCE * capture.extent).float().mean())
    if fraction > MAX_FRACTION_AT_CAMERAS:
        text = f"{fraction:.1%} of the points lie at camera positions, not on surfaces"
        yield Finding("warning", "points", text)


def _contrast_at_points(frame: Frame, points: torch.Tensor) -> float | None:
    """Mean image gradient at static points over that of all static pixels; None if there are too few points."""
    row, column, _, inside = frame.camera.project(points)
    grey = frame.image.float().mean(2)
    gradient = torch.zeros_like(grey)
    gradient[:-1, :-1] = (grey[1:, :-1] - grey[:-1, :-1]).abs() + (grey[:-1, 1:] - grey[:-1, :-1]).abs()
    gradient = torch.nn.functional.max_pool2d(gradient[None], 3, 1, 1)[0]  # points may be off by a pixel
    static = torch.ones_like(grey, dtype=torch.bool) if frame.static_mask is None else frame.static_mask
    seen = inside & static[row, column]
    if int(seen.sum()) < 50 or not bool(static.any()):
        return None
    mean = float(gradient[static].mean())
    return float(gradient[row, column][seen].mean()) / mean if mean > 0 else None


def _depth(capture: Capture) -> Iterator[Finding]:
    """Aligns the depth of the sampled frames to the points as training does, and measures its error."""
    samples = list(_depth_at_points(capture))
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


def _depth_at_points(capture: Capture) -> Iterator[PointSamples]:
    """The depth of the sampled frames that have any, at the points."""
    for name in _sampled(capture.train, SAMPLES):
        frame = capture.frame(name)
        if frame.inverse_depth is not None:
            everywhere = torch.ones(frame.image.shape[:2], dtype=torch.bool)
            static = everywhere if frame.static_mask is None else frame.static_mask
            yield sample_points(frame.inverse_depth, static, frame.camera, capture.points)


def _motion(capture: Capture) -> Iterator[Finding]:
    """Compares masks and cameras with the motion in the images."""
    inside, outside = [], []
    for first, second in _pairs(capture):
        found = motion_between(capture.frame(first), capture.frame(second))
        if found is None:
            continue
        outside.append(found.static)
        if found.dynamic is not None:
            inside.append(found.dynamic - found.static)
    if not outside:
        text = "frames that follow each other are seen from cameras too far apart, or have too little texture"
        yield Finding("note", "cameras", f"{text}, to compare their motion")
        return
    static = float(np.median(outside))
    level: Level = "warning" if static > MAX_EPIPOLAR_DISTANCE else "note"
    hint = ": the cameras may not match the images" if level == "warning" else ""
    yield Finding(level, "cameras", f"static pixels are {static:.2f} px off their epipolar lines (median){hint}")
    if len(inside) < 3:
        return
    more = float(np.mean(np.array(inside) > 0))
    if more < 0.25 and float(np.median(inside)) < -0.2:
        text = (
            "static regions of the masks move more than dynamic ones: the masks may be inverted (0 must mean dynamic)"
        )
        yield Finding("error", "masks", text)
    else:
        text = f"dynamic pixels are farther off their epipolar lines than static ones in {more:.0%} of the frames"
        yield Finding("note", "masks", text)


def _pairs(capture: Capture) -> list[tuple[str, str]]:
    """Frames that follow each other in time, of cameras that are not far apart, evenly spread over the capture."""
    cameras = capture.cameras
    names = sorted(capture.train, key=lambda name: cameras[name].time)
    pairs = [(a, b) for a, b in itertools.pairwise(names) if are_comparable(cameras[a], cameras[b])]
    return [pairs[k] for k in evenly_spaced_indices(len(pairs), SAMPLES)]
