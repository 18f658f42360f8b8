"""Evaluation of a scene on the frames of a capture that it was not trained on."""

import csv
import io
import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data.capture import Capture, Frame, TakenFrame
from warpgs.files import write_text
from warpgs.rendering import Layer, Rendering

from .lpips import Lpips
from .metric import Comparison, Renderer, known
from .metrics import METRICS

OnView = Callable[[int, Frame, Tensor, Rendering], None]
"""Receives the index, frame, [H, W, 3] ground truth in [0, 1] and rendering of a view."""

Frames = Literal["as taken", "undistorted"]
"""What renderings are compared with."""


@dataclass(frozen=True)
class ViewMetrics:
    """Metrics of one view.

    Attributes:
        name: Id of the view.
        time: Its time in [0, 1].
        values: Metrics by name; None where they could not be measured.
    """

    name: str
    time: float
    values: dict[str, float | None]


@dataclass(frozen=True)
class Evaluation:
    """Metrics of all views, and of the scene as a whole.

    Attributes:
        views: One entry per view.
        scene: Metrics of the scene by name; None where they could not be measured.
        lpips_net: Network of LPIPS; None when it was not measured.
        frames: Whether frames were compared as they were taken, or undistorted, and so resampled, before.
    """

    views: list[ViewMetrics]
    scene: dict[str, float | None]
    lpips_net: str | None
    frames: Frames = "as taken"

    def summary(self) -> dict[str, Any]:
        """Means over the views that have a value, None where none has; and the metrics of the scene."""
        return {
            **{name: _mean([view.values[name] for view in self.views]) for name in of_views()},
            "lpips_net": self.lpips_net,
            "frames": self.frames,
            "num_views": len(self.views),
            **self.scene,
        }


def of_views() -> dict[str, Callable[[Comparison], float | None]]:
    """The functions of metrics that are measured on each view."""
    return {name: metric.of_view for name, metric in METRICS.items() if metric.of_view is not None}


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

    Without evaluation frames only metrics of the scene are measured, through the training cameras.

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
    of_scene = {name: metric.of_scene for name, metric in METRICS.items() if metric.of_scene is not None}
    values = {name: measure(scene, cameras, quiet) for name, measure in of_scene.items()}
    return Evaluation(views, values, lpips.net if lpips else None, frames)


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
    return taken.frame, _distorted(scene.render(wide, branches=True), taken.positions)


def _distorted(rendering: Rendering, positions: Float[Tensor, "H W 2"]) -> Rendering:
    """The layers of a rendering at other positions: images with bicubic interpolation, without depth.

    Args:
        rendering: Through the wide camera of a ``TakenFrame``.
        positions: [H, W, 2] its positions, on any device.
    """
    height, width = rendering.joint.alpha.shape
    size = torch.tensor([width, height], dtype=torch.float32, device=rendering.joint.alpha.device)
    grid = 2.0 * positions.to(size.device) / size - 1.0
    static, dynamic = (
        None if layer is None else _sampled(layer, grid) for layer in (rendering.static, rendering.dynamic)
    )
    return rendering._replace(joint=_sampled(rendering.joint, grid), static=static, dynamic=dynamic)


def _sampled(layer: Layer, grid: Float[Tensor, "H W 2"]) -> Layer:
    values = torch.cat([layer.image, layer.alpha[..., None]], 2).permute(2, 0, 1)[None]
    sampled = grid_sample(values, grid[None], mode="bicubic", padding_mode="border", align_corners=False)[0]
    return Layer(sampled[:-1].permute(1, 2, 0).contiguous(), sampled[-1].clamp(0, 1), None)


def _measure(frame: Frame, image: Tensor, truth: Tensor, lpips: Lpips | None) -> ViewMetrics:
    static, covisible = (
        None if mask is None else mask.to(image.device) for mask in (frame.static_mask, frame.covisible)
    )
    comparison = Comparison(image, truth, static, covisible, lpips)
    return ViewMetrics(
        frame.name, frame.camera.time, {k: known(measure(comparison)) for k, measure in of_views().items()}
    )


def write_views(path: Path, evaluation: Evaluation) -> None:
    """Writes one line per view as CSV; an empty field was not measured."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = list(of_views())
    writer.writerow(["name", "time", *names])
    for view in evaluation.views:
        values = [view.values[name] for name in names]
        writer.writerow([view.name, view.time, *("" if value is None else value for value in values)])
    write_text(path, text.getvalue())
