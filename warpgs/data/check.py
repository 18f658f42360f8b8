"""Is a capture fit to train on? Reads it as training does, and measures what would make training in vain."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from warpgs.cameras import Camera

from .capture import MIN_EXTENT, Capture, Frame
from .depth_alignment import align_to_points
from .loaders import Dataset, load_capture, recognise
from .motion_check import motion_between

Level = Literal["error", "warning", "note"]

MIN_VISIBLE_FRACTION = 0.2
"""Median share of the points that a training camera should have in its picture."""

MIN_POINT_CONTRAST = 0.8
"""Contrast at the points over that of the picture: COLMAP's points have 2 to 4, those of a depth sensor about 1."""

NEAREST_POINT = 0.01
"""Points nearer to a camera than this share of the cameras' extent are no surfaces."""

MAX_FRACTION_AT_CAMERAS = 0.01
"""Share of such points."""

MUCH_MOVING = 0.4
"""Share of the pixels; more of it is seldom true."""

MAX_DEPTH_ERROR = 0.25
"""Median relative error of aligned depth at the points."""

MAX_EPIPOLAR = 3.0
"""Median distance of static pixels' flow from their epipolar lines [px]; more and the cameras are not the pictures'."""

SAMPLES = 12
"""Frames that are looked at closely, spread over the capture; all are read."""

QUICK_SAMPLES = 3


@dataclass(frozen=True)
class Finding:
    """One thing that was found.

    Attributes:
        level: "error" if training would be in vain, "warning" if it would suffer, "note" otherwise.
        topic: What it is about, one word.
        text: One sentence.
    """

    level: Level
    topic: str
    text: str

    def __str__(self) -> str:
        return f"{self.level}: {self.text}"


@dataclass(frozen=True)
class Report:
    """All that was found of a capture."""

    root: Path
    findings: list[Finding]

    @property
    def is_fit(self) -> bool:
        return not any(f.level == "error" for f in self.findings)

    def plain(self) -> dict[str, Any]:
        return {"capture": str(self.root), "fit": self.is_fit, "findings": [asdict(f) for f in self.findings]}

    def __str__(self) -> str:
        order = {"note": 0, "warning": 1, "error": 2}
        lines = [str(f) for f in sorted(self.findings, key=lambda f: order[f.level])]
        verdict = "fit to train on" if self.is_fit else "not fit to train on"
        return "\n".join([*lines, f"{self.root}: {verdict}"])


def check_capture(root: Path, dataset: Dataset | None = None, factor: int | None = None) -> Report:
    """Reads all of a capture and reports.

    Args:
        root: Folder with dataset.json.
        dataset, factor: As for ``load_capture``.
    """
    try:
        capture = load_capture(root, dataset, factor=factor, cache_frames=2 * SAMPLES)
    except ValueError as error:
        return Report(root, [Finding("error", "files", str(error))])
    kind = dataset or recognise(root)
    findings = [Finding("note", "layout", f"read as {kind}"), *_counts(capture), *_files(capture)]
    if not any(f.level == "error" for f in findings):
        findings += [*_geometry(capture, SAMPLES), *_depth(capture), *_motion(capture)]
    return Report(root, findings)


def quick_findings(capture: Capture, all_static: bool = False) -> list[Finding]:
    """The errors and warnings that cameras, points and three frames of an opened capture tell, in less than a second.

    Args:
        capture: It.
        all_static: Whether it will be learnt as static, whatever the masks say: then one time does for all frames.

    Raises:
        ValueError: If one of the three frames can't be read.
    """
    findings = [*_counts(capture, all_static), *_geometry(capture, QUICK_SAMPLES)]
    return [f for f in findings if f.level != "note"]


def _sampled(names: tuple[str, ...], count: int) -> list[str]:
    places = np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int))
    return [names[k] for k in places]


def _counts(capture: Capture, all_static: bool = False) -> Iterator[Finding]:
    sizes = sorted({camera.size for camera in capture.cameras.values()})
    shown = ", ".join(f"{w}×{h}" for w, h in sizes[:4])
    yield Finding("note", "counts", f"{len(capture.train)} frames to train on, {len(capture.val)} to evaluate, {shown}")
    times = sorted(capture.cameras[name].time for name in capture.train)
    distinct = len(set(times))
    yield Finding("note", "time", f"times from {times[0]:.3f} to {times[-1]:.3f}, {distinct} moments")
    if distinct == 1 and len(times) > 1:
        text = "all training frames have one time: time_id (or warp_id) in metadata.json is wrong"
        hint = "" if all_static else "; a scene in which nothing moves can be trained with --assume static"
        yield Finding("warning" if all_static else "error", "time", text + hint)
    elif times[-1] - times[0] < 0.5:
        yield Finding("warning", "time", "training frames cover less than half of the time range")
    late = [n for n in capture.val if not times[0] <= capture.cameras[n].time <= times[-1]]
    if late:
        yield Finding("warning", "time", f"{len(late)} evaluation frames lie before or after all training frames")
    if len(capture.train) < 10:
        yield Finding("warning", "counts", f"{len(capture.train)} training frames are very few")


def _files(capture: Capture) -> Iterator[Finding]:
    """Reads every frame."""
    masks, moving, depths = 0, [], 0
    for name in (*capture.train, *capture.val):
        try:
            frame = capture.frame(name)
        except ValueError as error:
            yield Finding("error", "files", str(error))
            continue
        depths += frame.inverse_depth is not None
        if frame.static_mask is not None:
            masks += 1
            moving.append(1.0 - float(frame.static_mask.float().mean()))
    count = len(capture.train) + len(capture.val)
    yield Finding("note", "files", f"{masks} of {count} frames have masks, {depths} have depth")
    if not moving:
        yield Finding("warning", "masks", "there are no masks: everything would be learnt as static")
    elif max(moving) == 0.0:
        yield Finding("warning", "masks", "the masks say that nothing moves")
    elif min(moving) == 1.0:
        yield Finding("error", "masks", "the masks say that everything moves: 0 must mean moving, 255 static")
    else:
        share = float(np.mean(moving))
        text = f"the masks say that {share:.1%} of the pixels move, {max(moving):.1%} at most"
        yield Finding("warning" if share > MUCH_MOVING else "note", "masks", text)


def _geometry(capture: Capture, samples: int) -> Iterator[Finding]:
    """Cameras and points against each other and against the pictures."""
    cameras = [capture.cameras[name] for name in capture.train]
    if capture.extent <= MIN_EXTENT:
        yield Finding("warning", "cameras", "the camera hardly moves: depth can't be learnt from it")
    if len(capture.points) == 0:
        yield Finding("warning", "points", "there are no sparse points: training starts from random ones")
        return
    names = _sampled(capture.train, samples)
    visible = [float(capture.cameras[n].project(capture.points)[3].float().mean()) for n in names]
    median = float(np.median(visible))
    yield Finding(
        "note", "points", f"{len(capture.points)} points, {median:.0%} of them in a camera's picture (median)"
    )
    if median == 0.0:
        text = "the cameras do not see the points: orientation, position or scene.json's center and scale are wrong"
        yield Finding("error", "points", text)
        return
    if median < MIN_VISIBLE_FRACTION:
        yield Finding("warning", "points", f"a camera sees only {median:.0%} of the points (median)")
    yield from _at_cameras(capture, cameras)
    contrasts = [c for n in names if (c := _contrast_at_points(capture.frame(n), capture.points)) is not None]
    if contrasts:
        ratio = float(np.median(contrasts))
        low = ratio < MIN_POINT_CONTRAST
        text = f"contrast at the points is {ratio:.2f} times that of the pictures"
        hint = ": points and cameras may not belong to the pictures" if low else ""
        yield Finding("warning" if low else "note", "points", text + hint)


def _at_cameras(capture: Capture, cameras: list[Camera]) -> Iterator[Finding]:
    positions = torch.stack([camera.position for camera in cameras[:: max(1, len(cameras) // 200)]])
    points = capture.points[:: max(1, len(capture.points) // 20_000)]
    nearest = torch.cat([torch.cdist(part, positions).amin(1) for part in points.split(2000)])
    share = float((nearest < NEAREST_POINT * capture.extent).float().mean())
    if share > MAX_FRACTION_AT_CAMERAS:
        yield Finding("warning", "points", f"{share:.1%} of the points lie at the cameras' places and are no surfaces")


def _contrast_at_points(frame: Frame, points: torch.Tensor) -> float | None:
    """Mean gradient at static points over that of static pixels; None where there are too few points."""
    row, column, _, inside = frame.camera.project(points)
    grey = frame.image.float().mean(2)
    slope = torch.zeros_like(grey)
    slope[:-1, :-1] = (grey[1:, :-1] - grey[:-1, :-1]).abs() + (grey[:-1, 1:] - grey[:-1, :-1]).abs()
    slope = torch.nn.functional.max_pool2d(slope[None], 3, 1, 1)[0]  # points are off by a pixel
    static = torch.ones_like(grey, dtype=torch.bool) if frame.static_mask is None else frame.static_mask
    seen = inside & static[row, column]
    if int(seen.sum()) < 50 or not bool(static.any()):
        return None
    mean = float(slope[static].mean())
    return float(slope[row, column][seen].mean()) / mean if mean > 0 else None


def _depth(capture: Capture) -> Iterator[Finding]:
    """How well each sampled frame's depth fits the points once it is aligned to them."""
    if len(capture.points) == 0:
        return
    errors, failed, looked = [], 0, 0
    for name in _sampled(capture.train, SAMPLES):
        frame = capture.frame(name)
        if frame.inverse_depth is None:
            continue
        looked += 1
        everywhere = torch.ones(frame.image.shape[:2], dtype=torch.bool)
        static = everywhere if frame.static_mask is None else frame.static_mask
        a, b = align_to_points(frame.inverse_depth, static, frame.camera, capture.points).tolist()
        row, column, z, inside = frame.camera.project(capture.points)
        aligned = a * frame.inverse_depth[row, column] + b
        known = inside & aligned.isfinite() & static[row, column]
        if not math.isfinite(a) or not bool(known.any()):
            failed += 1
            continue
        errors.append(float((aligned[known] * z[known] - 1.0).abs().median()))
    if looked == 0:
        return
    if failed:
        text = f"the depth of {failed} of {looked} frames can't be aligned to the points"
        yield Finding("warning", "depth", f"{text}: it must be inverse depth, larger is nearer")
    if errors:
        median = float(np.median(errors))
        level: Level = "warning" if median > MAX_DEPTH_ERROR else "note"
        yield Finding(level, "depth", f"aligned depth is {median:.1%} off at the points (median)")


def _motion(capture: Capture) -> Iterator[Finding]:
    """Masks and cameras against the motion in the pictures."""
    inside, outside = [], []
    for first, second in _pairs(capture):
        found = motion_between(capture.frame(first), capture.frame(second))
        if found is None:
            continue
        outside.append(found.static)
        if found.moving is not None:
            inside.append(found.moving - found.static)
    if not outside:
        return
    static = float(np.median(outside))
    level: Level = "warning" if static > MAX_EPIPOLAR else "note"
    hint = ": the cameras may not belong to the pictures" if level == "warning" else ""
    yield Finding(level, "cameras", f"static pixels move {static:.2f} px off their epipolar lines (median){hint}")
    if len(inside) < 3:
        return
    more = float(np.mean(np.array(inside) > 0))
    text = f"pixels masked as moving move more than the camera explains in {more:.0%} of the frames"
    if more < 0.25 and float(np.median(inside)) < -0.2:
        text = (
            "what the masks call static moves more than what they call moving: they may be turned around (0 = moving)"
        )
        yield Finding("error", "masks", text)
    else:
        yield Finding("note", "masks", text)


def _pairs(capture: Capture) -> list[tuple[str, str]]:
    """Frames that follow each other in time, whatever camera took them, spread over the capture."""
    names = sorted(capture.train, key=lambda name: capture.cameras[name].time)
    pairs = list(itertools.pairwise(names))
    return [pairs[k] for k in np.unique(np.linspace(0, len(pairs) - 1, min(SAMPLES, len(pairs))).astype(int))]
