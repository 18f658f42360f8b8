"""Evaluation of a scene on the frames of a capture that it was not trained on."""

import csv
import io
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.data.capture import Capture, Frame
from warpgs.data.responses import Response, in_response
from warpgs.files import write_text
from warpgs.rendering import Rendering

from .lpips import Lpips
from .metric import Comparison, Renderer, known
from .metrics import METRICS

OnView = Callable[[int, Frame, Tensor, Rendering], None]
"""Receives the index, frame, [H, W, 3] ground truth in [0, 1] and rendering of a view."""


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
    """

    views: list[ViewMetrics]
    scene: dict[str, float | None]
    lpips_net: str | None

    def summary(self) -> dict[str, Any]:
        """Means over the views that have a value, None where none has; and the metrics of the scene."""
        return {
            **{name: _mean([view.values[name] for view in self.views]) for name in of_views()},
            "lpips_net": self.lpips_net,
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
    responses: Mapping[int, Response] = MappingProxyType({}),
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
        responses: As of ``camera_responses``: renderings are compared as the camera of a frame records them.
    """
    device = scene.device
    views = []
    indices = progress(range(len(capture.val)), "evaluating", quiet)
    for index, frame in zip(indices, capture.frames(capture.val), strict=True):
        camera = frame.camera.to(device) if align is None else align(frame)
        truth = frame.image.to(device).float() / 255.0
        rendering, shown = scene.render(camera, branches=True), camera.shown
        recorded = in_response(rendering.joint.image, frame, responses)
        rendering = rendering._replace(joint=rendering.joint._replace(image=recorded))
        if shown is not None:
            rendering = rendering._replace(joint=rendering.joint.only_where(shown, truth))
        views.append(_measure(frame, rendering.joint.image.clamp(0, 1), truth, shown, lpips))
        if on_view is not None:
            on_view(index, frame, truth, rendering)
    cameras = [capture.cameras[name].to(device) for name in capture.val or capture.train]
    of_scene = {name: metric.of_scene for name, metric in METRICS.items() if metric.of_scene is not None}
    values = {name: measure(scene, cameras, quiet) for name, measure in of_scene.items()}
    return Evaluation(views, values, lpips.net if lpips else None)


def check_views(capture: Capture, quiet: bool = True) -> None:
    """Reads every evaluation frame as ``evaluate`` does and keeps none in memory.

    Raises:
        ValueError: If a file of a frame is missing, damaged or of another size; the message names it.
    """
    frames = replace(capture, cache_frames=0).frames(capture.val)
    for _ in zip(progress(capture.val, "reading evaluation frames", quiet), frames, strict=True):
        pass


def _measure(frame: Frame, image: Tensor, truth: Tensor, shown: Tensor | None, lpips: Lpips | None) -> ViewMetrics:
    static, covisible = (
        None if mask is None else mask.to(image.device) for mask in (frame.static_mask, frame.covisible)
    )
    comparison = Comparison(image, truth, static, covisible, shown, lpips)
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
