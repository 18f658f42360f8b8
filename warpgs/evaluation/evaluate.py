"""Evaluation of a scene on the frames of a capture that it was not trained on."""

import csv
import io
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data.capture import Capture, Frame, TakenFrame
from warpgs.files import write_text
from warpgs.rendering import Rendering

from . import metrics
from .distort import distort
from .lpips import Lpips


@runtime_checkable
class Renderer(Protocol):
    """What is evaluated: ``TrainedScene`` is one."""

    @property
    def device(self) -> torch.device:
        """Device to render on."""

    def render(self, camera: Camera, *, branches: bool = False) -> Rendering:
        """Renders through a camera at the camera's time, with or without the static and the dynamic image."""

    def play(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The joint image, as fast as possible."""


OnView = Callable[[int, Frame, Tensor, Rendering], None]
"""Receives the index, frame, [H, W, 3] ground truth in [0, 1] and rendering of a view."""

Frames = Literal["as taken", "undistorted"]
"""What renderings are compared with."""

STATIC_ALPHA = 0.05
"""A pixel counts as static for the flicker score where the dynamic image's alpha is lower than this in both frames."""

FLICKER_FRAMES = 30
TIMED_FRAMES = 30
TIMED_SECONDS = 0.5
"""Frames are timed in rounds of ``TIMED_FRAMES``, for at least ``TIMED_SECONDS`` [s]."""


@dataclass(frozen=True)
class ViewMetrics:
    """Metrics of one view; None where they could not be measured.

    Images are clamped to [0, 1] and not rounded to 8 bits. ``_static`` and ``_dynamic`` are over the pixels of that
    region of the view's mask, ``masked_`` over the co-visible pixels of iPhone captures, as in DyCheck. MS-SSIM needs
    images of at least 161 pixels a side.
    """

    name: str
    time: float
    psnr: float
    ssim: float
    ms_ssim: float | None
    lpips: float | None
    psnr_static: float | None
    psnr_dynamic: float | None
    ssim_static: float | None
    ssim_dynamic: float | None
    masked_psnr: float | None
    masked_ssim: float | None
    masked_lpips: float | None


@dataclass(frozen=True)
class Evaluation:
    """Metrics of all views, and of the scene as a whole.

    Attributes:
        views: One entry per view.
        flicker: Mean absolute change between consecutive renderings of the static region through the middle camera of
            the evaluation, held fixed; None with fewer than two times. There is no ground truth of a fixed camera in a
            capture of a moving one, so changes that are real (shadows) count too.
        fps: Joint images per second, including everything that depends on time.
        lpips_net: Network of LPIPS; None when it was not measured.
        frames: Whether frames were compared as they were taken, or undistorted, and so resampled, before.
    """

    views: list[ViewMetrics]
    flicker: float | None
    fps: float
    lpips_net: str | None
    frames: Frames = "as taken"

    def summary(self) -> dict[str, Any]:
        """Means over the views that have a value; None where none has."""
        means = {f.name: _mean([getattr(v, f.name) for v in self.views]) for f in fields(ViewMetrics)[2:]}
        return {
            **means,
            "lpips_net": self.lpips_net,
            "frames": self.frames,
            "num_views": len(self.views),
            "flicker": self.flicker,
            "fps": self.fps,
        }


def _mean(values: Sequence[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return statistics.fmean(known) if known else None


@torch.no_grad()
def evaluate(
    scene: Renderer,
    capture: Capture,
    lpips: Lpips | None = None,
    on_view: OnView | None = None,
    align: Callable[[Frame], Camera] | None = None,
    quiet: bool = False,
    as_taken: bool = False,
) -> Evaluation:
    """Compares a scene with every evaluation frame of a capture.

    Without evaluation frames only flicker and frames per second are measured, through the training cameras.

    Args:
        scene: The scene to render.
        capture: Where the frames come from.
        lpips: On the scene's device; LPIPS is not measured if None.
        on_view: Called with each view.
        align: The camera to render a frame through, on the scene's device; the frame's own if None.
        quiet: Whether to hide the progress bar.
        as_taken: Whether to distort a wider rendering as the lens does instead of undistorting (resampling) frames.
    """
    device = scene.device
    views = []
    indices = progress(range(len(capture.val)), "evaluating", quiet)
    for index, (frame, taken) in zip(indices, read_views(capture, as_taken), strict=True):
        camera = frame.camera.to(device) if align is None else align(frame)
        if taken is None:
            rendering = scene.render(camera, branches=True)
        else:
            frame, rendering = _as_taken(scene, taken, camera)
        truth = frame.image.to(device).float() / 255.0
        views.append(_measure(frame, rendering.joint.image.clamp(0, 1), truth, lpips))
        if on_view is not None:
            on_view(index, frame, truth, rendering)
    cameras = [capture.cameras[name].to(device) for name in capture.val or capture.train]
    frames: Frames = "as taken" if as_taken or capture.read_taken is None else "undistorted"
    net, fps = lpips.net if lpips else None, frame_rate(scene.play, cameras)
    return Evaluation(views, _flicker(scene, cameras, quiet), fps, net, frames)


def read_views(capture: Capture, as_taken: bool = False) -> Iterator[tuple[Frame, TakenFrame | None]]:
    """Reads every evaluation frame, and once more as it was taken if that is asked for and differs, else None.

    Raises:
        ValueError: If a file of a frame is missing, damaged or of another size; the message names it. With
            ``as_taken``, also if a lens is a fisheye or its distortion cannot be inverted.
    """
    read_taken = capture.read_taken if as_taken else None
    for name, frame in zip(capture.val, capture.frames(capture.val), strict=True):
        yield frame, None if read_taken is None else read_taken(name)


def check_views(capture: Capture, as_taken: bool = False, quiet: bool = True) -> None:
    """Reads every evaluation frame as ``evaluate`` does and keeps none in memory; raises as ``read_views``."""
    frames = read_views(replace(capture, cache_frames=0), as_taken)
    for _ in zip(progress(capture.val, "reading evaluation frames", quiet), frames, strict=True):
        pass


def _as_taken(scene: Renderer, taken: TakenFrame, camera: Camera) -> tuple[Frame, Rendering]:
    """A frame as it was taken, and the scene from the pose of a camera as the frame's lens shows it."""
    wide = replace(taken.frame.camera.to(scene.device), viewmat=camera.viewmat)
    return taken.frame, distort(scene.render(wide, branches=True), taken.positions)


def _measure(frame: Frame, image: Tensor, truth: Tensor, lpips: Lpips | None) -> ViewMetrics:
    def within(metric: Callable[..., float | Tensor], region: Bool[Tensor, "H W"] | None) -> float | None:
        if region is None or not bool(region.any()):
            return None
        return _known(float(metric(image, truth, region.to(image.device))))

    static, covisible = frame.static_mask, frame.covisible
    dynamic = None if static is None else ~static
    return ViewMetrics(
        name=frame.name,
        time=frame.camera.time,
        psnr=metrics.psnr(image, truth),
        ssim=metrics.ssim(image, truth),
        ms_ssim=_known(metrics.ms_ssim(image, truth)),
        lpips=None if lpips is None else float(lpips(image, truth)),
        psnr_static=within(metrics.psnr, static),
        psnr_dynamic=within(metrics.psnr, dynamic),
        ssim_static=within(metrics.ssim, static),
        ssim_dynamic=within(metrics.ssim, dynamic),
        masked_psnr=within(metrics.psnr, covisible),
        masked_ssim=within(metrics.masked_ssim, covisible),
        masked_lpips=None if lpips is None else within(lpips.masked, covisible),
    )


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value


def _flicker(scene: Renderer, cameras: Sequence[Camera], quiet: bool) -> float | None:
    middle, times = cameras[len(cameras) // 2], sorted({camera.time for camera in cameras})
    changes = []
    before: Rendering | None = None
    for at in progress(times[:FLICKER_FRAMES], "flicker", quiet):
        after = scene.render(replace(middle, time=at), branches=True)
        if before is not None:
            assert before.dynamic is not None
            assert after.dynamic is not None
            static = (before.dynamic.alpha < STATIC_ALPHA) & (after.dynamic.alpha < STATIC_ALPHA)
            change = metrics.flicker(before.joint.image.clamp(0, 1), after.joint.image.clamp(0, 1), static)
            changes += [] if math.isnan(change) else [change]
        before = after
    return _mean(changes)


def frame_rate(play: Callable[[Camera], object], cameras: Sequence[Camera]) -> float:
    """Frames per second of wall time, after one warm-up frame, cycling through the cameras."""
    device = cameras[0].viewmat.device

    def play_frames(count: int) -> None:
        for k in range(count):
            play(cameras[k % len(cameras)])
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    play_frames(1)
    start, rounds = time.perf_counter(), 0
    while time.perf_counter() - start < TIMED_SECONDS:
        play_frames(TIMED_FRAMES)
        rounds += 1
    return rounds * TIMED_FRAMES / (time.perf_counter() - start)


def write_views(path: Path, evaluation: Evaluation) -> None:
    """Writes one line per view as CSV; an empty field was not measured."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [f.name for f in fields(ViewMetrics)], lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: "" if v is None else v for k, v in asdict(view).items()} for view in evaluation.views)
    write_text(path, text.getvalue())
