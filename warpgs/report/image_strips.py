"""Ground truth, joint, static and dynamic image and error image of views."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from warpgs.command_line.progress import progress
from warpgs.data.capture import missing_view
from warpgs.data.images import decode
from warpgs.data.responses import camera_responses, in_response
from warpgs.evaluation.poses import alignment
from warpgs.runs.run import Device, Run
from warpgs.visualize.images import CAPTION_HEIGHT, error_image, reduced, to_bytes

from .evaluated_run import EvaluatedRun

MAX_WIDTH = 800
"""Maximum width of an embedded image [px]."""

QUALITY = 88
"""JPEG quality."""

IMAGE_FOLDERS = ("images", "pictures")
"""Folders of a run with images of its evaluation; warpgs 0.1.0 wrote the second one."""

PANELS = 5
"""Panels of an image that the evaluation saves: truth, joint, static, dynamic, error."""


class Strip(NamedTuple):
    """Images of one view, as data URIs."""

    truth: str
    rendered: str
    static: str
    dynamic: str
    error: str


class Strips(NamedTuple):
    """Image strips of a run.

    Attributes:
        by_view: Strips by name of the view.
        note: A note to show with them; may be empty.
    """

    by_view: dict[str, Strip]
    note: str


def saved_views(run: EvaluatedRun) -> set[str]:
    """Names of the views of which the evaluation saved images in the run folder."""
    return {view.name for view in run.views if _read_saved(run.folder, view.name) is not None}


def rendered_strips(evaluated: EvaluatedRun, names: Sequence[str], device: Device | None, quiet: bool) -> Strips:
    """Strips of views, rendered from the newest checkpoint.

    Args:
        evaluated: The run.
        names: Names of the views.
        device: Device to render on; CUDA if None and there is a GPU.
        quiet: Whether to hide the progress bar.

    Raises:
        ValueError: If the capture or the checkpoint cannot be read.
        OSError: Likewise.
    """
    run = Run.open(evaluated.folder, device)
    capture, scene = run.open_capture(quiet), run.trained_scene()
    responses = camera_responses(capture) if run.config.exposure else {}
    align = alignment(scene, capture.median_depth, responses)
    strips = {}
    for name in progress(names, f"rendering {evaluated.label}", quiet):
        if name not in capture.cameras:
            raise ValueError(missing_view(capture, name))
        frame = capture.frame(name)
        truth = frame.image.to(scene.device).float() / 255.0
        rendering = scene.render(align(frame), branches=True)
        joint = rendering.joint._replace(image=in_response(rendering.joint.image, frame, responses))
        layers = (joint, rendering.static, rendering.dynamic)
        shown = [to_bytes(layer.image) for layer in layers if layer is not None]
        error = error_image(joint.image.clamp(0, 1), truth)
        strips[name] = Strip(*map(data_uri, (to_bytes(truth), *shown, error)))
    measured, newest = evaluated.metrics.get("iterations"), scene.metadata.iteration
    note = "" if measured == newest else f"the images are of iteration {newest}, the metrics of iteration {measured}"
    return Strips(strips, note)


def saved_strips(run: EvaluatedRun, names: Sequence[str], reason: str) -> Strips:
    """Strips of those views of which the evaluation saved images; ``reason`` says why they are not rendered."""
    strips = {name: strip for name in names if (strip := _read_saved(run.folder, name)) is not None}
    return Strips(strips, f"only views whose images the evaluation saved: {reason}")


def _read_saved(folder: Path, name: str) -> Strip | None:
    roots = [(folder / part).resolve() for part in IMAGE_FOLDERS]
    paths = [(root / f"{name}.png").resolve() for root in roots]
    path = next((p for p, root in zip(paths, roots, strict=True) if p.parent == root and p.is_file()), None)
    if path is None:
        return None
    try:
        image = decode(path, cv2.IMREAD_COLOR)
    except ValueError:  # the same as without a saved image, which the page's note says
        return None
    if image.shape[1] % PANELS or image.shape[0] <= CAPTION_HEIGHT:
        return None
    panels = np.split(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)[CAPTION_HEIGHT:], PANELS, axis=1)
    return Strip(*(data_uri(np.ascontiguousarray(panel)) for panel in panels))


def data_uri(image: UInt8[np.ndarray, "H W 3"]) -> str:
    """An RGB image as a data URI; scaled down to ``MAX_WIDTH``."""
    image = reduced(image, MAX_WIDTH)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"
