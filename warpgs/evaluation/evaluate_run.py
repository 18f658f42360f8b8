"""Evaluation of a run folder: metrics.json, views.csv, images/ and time.mp4."""

from pathlib import Path
from typing import Any

import torch

from warpgs.command_line.progress import progress
from warpgs.config import Device, NetName
from warpgs.data.capture import Capture, Frame
from warpgs.data.responses import camera_responses
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.errors import counted
from warpgs.files import read_json, write_json, write_png
from warpgs.rendering import Rendering
from warpgs.runs.captures import require_same_times
from warpgs.runs.config_file import read_notes
from warpgs.runs.run import MASK_TRIAL, Run
from warpgs.runs.trained import TrainedScene
from warpgs.video.camera_paths import replay
from warpgs.video.writer import Video
from warpgs.visualize.images import comparison, to_bytes

from .evaluate import Evaluation, OnView, evaluate, write_views
from .lpips import find
from .machine import commit, device_name
from .metric import Line
from .metrics import METRICS
from .motion import jitter
from .poses import alignment

NUM_IMAGES = 6
"""Evaluation views to save as images, spread over the capture."""

VIDEO_FRAMES = 120
"""Frames of the video over time."""


def evaluate_run(
    folder: Path,
    capture: Capture | None = None,
    lpips: tuple[Path | None, NetName | None] = (None, None),
    device: Device | None = None,
    quiet: bool = False,
) -> str:
    """Evaluates the newest checkpoint of a run and writes the results into its folder.

    Args:
        folder: Run folder.
        capture: Its capture, if it is open already.
        lpips: Folder with the weights of LPIPS, and its network; those of the config where None.
        device: Device to render on; CUDA if None and there is a GPU.
        quiet: Whether to hide progress bars.

    Returns:
        A summary to print.

    Raises:
        ValueError: If the run, its capture or the weights of LPIPS cannot be used.
        OSError: If a file cannot be written.
    """
    run = Run.open(folder, device)
    # First, because opening a capture can take a minute.
    network = find(lpips[0] or run.config.lpips, lpips[1] or run.config.lpips_net)
    known = (read_json(folder / MASK_TRIAL) if (folder / MASK_TRIAL).exists() else {}) | {"notes": read_notes(folder)}
    capture = capture or run.open_capture(quiet)
    scene = run.trained_scene()
    require_same_times(capture, scene.metadata)
    responses = camera_responses(capture) if run.config.exposure else {}
    save_image, align = _image_writer(run, len(capture.val)), alignment(scene, capture.median_depth, responses)
    network = network and network.to(scene.device)
    evaluation = evaluate(scene, capture, network, save_image, align, quiet, responses)
    values = {**evaluation.summary(), "device": device_name(scene.device), **_of_run(scene, capture)}
    _write_metrics(run, {**known, **values, "commit": commit()}, evaluation)
    _write_video(folder / "time.mp4", scene, capture, quiet)  # last: metrics need no FFmpeg
    run.require_present()
    return _summary(values)


def _image_writer(run: Run, num_views: int) -> OnView:
    """A function that saves some of the views as images."""
    chosen = set(evenly_spaced_indices(num_views, NUM_IMAGES))

    def save(index: int, frame: Frame, truth: torch.Tensor, rendering: Rendering) -> None:
        if index in chosen:
            run.require_present()
            write_png(run.folder / "images" / f"{frame.name}.png", comparison(truth, rendering))

    return save


def _of_run(scene: TrainedScene, capture: Capture) -> dict[str, Any]:
    """What is known of the run apart from its views."""
    times = [capture.cameras[name].time for name in capture.train]
    metadata = scene.metadata
    return {
        "jitter": jitter(scene.splats, times),
        "poses_aligned": scene.config.optim.poses > 0 and bool(capture.val),
        "iterations": metadata.iteration,
        "train_seconds": metadata.train_seconds,
        "peak_bytes": metadata.peak_bytes,
        "num_static": len(scene.scene.static),
        "num_dynamic": len(scene.scene.dynamic),
    }


def _write_metrics(run: Run, values: dict[str, Any], evaluation: Evaluation) -> None:
    run.require_present()
    write_json(run.folder / "metrics.json", values)
    write_views(run.folder / "views.csv", evaluation)


def _write_video(path: Path, scene: TrainedScene, capture: Capture, quiet: bool) -> None:
    """Joint | static | dynamic image over time, from the cameras of ``replay``."""
    with Video(path) as video:
        for camera in progress(replay(capture, VIDEO_FRAMES), "video over time", quiet):
            rendering = scene.render(camera.to(scene.device), branches=True)
            layers = (rendering.joint, rendering.static, rendering.dynamic)
            images = [layer.image for layer in layers if layer is not None]
            video.add(to_bytes(torch.cat(images, 1)))


def _summary(values: dict[str, Any]) -> str:
    num_views = values["num_views"]
    heads: dict[Line, str] = {"views": f"{counted(num_views, 'view')}: ", "co-visible": "co-visible: "}
    lines = [head + told for line, head in heads.items() if (told := _told(line, values))]
    if not num_views:
        lines = ["the capture has no evaluation frames: PSNR, SSIM and LPIPS not measured"]
    lines += [
        _told("scene", values),
        f"{values['num_static']:,} static and {values['num_dynamic']:,} dynamic Gaussians",
    ]
    if values["lpips_net"] is not None:
        lines.append(f"network of LPIPS: {values['lpips_net']}")
    if values["poses_aligned"]:
        lines.append("camera poses were corrected in training, so held-out cameras were aligned to the scene")
    return "\n".join(lines)


def _told(line: Line, values: dict[str, Any]) -> str:
    """The metrics of a line of the summary; empty where none was measured. Without views, those of the scene alone."""
    told = {
        name: metric
        for name, metric in METRICS.items()
        if metric.line == line and (metric.of_view is None or values["num_views"])
    }
    if all(values[name] is None for name in told):
        return ""
    return ", ".join(metric.told(values[name]) for name, metric in told.items())
