"""Truth, our image and the error of a run's views."""

import base64
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from jaxtyping import UInt8

from warpgs import visualize as pictures
from warpgs.progress import progress
from warpgs.runs.run import Run

from .record import Record

WIDEST = 480
"""Of an embedded picture [px]."""

QUALITY = 88
"""Of JPEG."""

PANELS = 5
"""Of a picture that the evaluation leaves in the run folder: truth, joint, static, dynamic, error."""


class Strip(NamedTuple):
    """Pictures of one view, as data URIs."""

    truth: str
    ours: str
    error: str


class Strips(NamedTuple):
    """Pictures of a run.

    Attributes:
        by_view: By the view's name.
        note: What has to be said of them; empty if nothing.
    """

    by_view: dict[str, Strip]
    note: str


def available(record: Record) -> set[str]:
    """Views of which the evaluation left pictures in the run folder."""
    return {view.name for view in record.views if _kept(record.folder, view.name) is not None}


def rendered(record: Record, names: Sequence[str], device: Literal["cuda", "cpu"] | None, quiet: bool) -> Strips:
    """Strips of views, rendered from the newest checkpoint.

    Raises:
        ValueError: If the capture or the checkpoint can't be read.
        OSError: Likewise.
    """
    run = Run.open(record.folder, device)
    capture, scene = run.open_capture(quiet), run.trained_scene()
    strips = {}
    for name in progress(names, f"pictures of {record.label}", quiet):
        if name not in capture.cameras:
            raise ValueError(f"{capture.name} has no view {name}")
        frame = capture.frame(name)
        truth = frame.image.to(scene.device).float() / 255.0
        ours = scene.render(frame.camera.to(scene.device)).joint.image.clamp(0, 1)
        images = pictures.to_bytes(truth), pictures.to_bytes(ours), pictures.error_image(ours, truth)
        strips[name] = Strip(*map(data_uri, images))
    evaluated, newest = record.metrics.get("iterations"), scene.metadata.iteration
    note = "" if evaluated == newest else f"pictures are of iteration {newest}, figures of iteration {evaluated}"
    return Strips(strips, note)


def from_folder(record: Record, names: Sequence[str], reason: str) -> Strips:
    """Strips of those views of which the evaluation left pictures."""
    strips = {name: strip for name in names if (strip := _kept(record.folder, name)) is not None}
    return Strips(strips, f"only views whose pictures the evaluation kept: {reason}")


def _kept(folder: Path, name: str) -> Strip | None:
    root = (folder / "images").resolve()
    path = (root / f"{name}.png").resolve()
    if path.parent != root or not path.is_file():
        return None
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None or image.shape[1] % PANELS or image.shape[0] <= pictures.CAPTION_HEIGHT:
        return None
    panels = np.split(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)[pictures.CAPTION_HEIGHT :], PANELS, axis=1)
    return Strip(*(data_uri(np.ascontiguousarray(panels[k])) for k in (0, 1, 4)))


def data_uri(image: UInt8[np.ndarray, "H W 3"]) -> str:
    """An RGB picture as text that a page can hold; scaled down if it is large."""
    height, width = image.shape[:2]
    if width > WIDEST:
        size = (WIDEST, max(1, round(height * WIDEST / width)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return f"data:image/jpeg;base64,{base64.b64encode(data.tobytes()).decode()}"
