"""Images and videos of a trained scene, at the evaluation views or along a camera path (``warpgs render``)."""

import dataclasses
import math
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from warpgs import visualize
from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.files import remove_numbered, write_png
from warpgs.progress import progress
from warpgs.rendering import Rendering
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene

from . import camera_paths, keyframes, mp4
from .command import Render

FRAMES = 120
"""Default number of frames along a path."""

PATHS_OF_OPTION = {
    "truth": ("views",),
    "view": ("fixed", "spiral", "bullet"),
    "time": ("frozen", "spiral", "bullet"),
    "frames": ("fixed", "frozen", "moving", "spiral", "bullet", "keyframes"),
}
"""Camera paths that an option applies to; the other options apply to all."""

MAX_SUPERSAMPLING = 8

REACH = 0.3
"""Radius of the spiral, relative to the radius of the training camera's path."""


def render_run(options: Render) -> str:
    """Renders the newest checkpoint of a run to images and a video; returns a summary to print.

    Raises:
        ValueError: If the run, its capture, the camera path or an option is not valid.
        OSError: If a file cannot be written.
    """
    _check(options)
    run = Run.open(options.run_folder, options.device, options.data)
    scene = run.trained_scene()
    capture = run.open_capture(options.quiet)
    dynamic, static = scene.scene.dynamic.means.cpu(), scene.scene.static.means.cpu()
    means = torch.cat([dynamic, static])
    centers = torch.stack([capture.cameras[name].position for name in capture.train])
    cameras, names = _cameras(options, capture, dynamic, means)
    camera_paths.BoundingSphere.around(means, centers).check(cameras, str(options.keyframes or options.path_name))
    name = options.keyframes.stem if options.keyframes else options.path_name
    folder = options.out or options.run_folder / "render" / name
    return _write(options, folder, names, _frames(options, capture, scene, cameras, names))


def _check(options: Render) -> None:
    if options.keyframes is not None and options.path is not None:
        raise ValueError("--keyframes define the path: omit --path")
    for name, paths in PATHS_OF_OPTION.items():
        value = getattr(options, name)
        if value is not None and value is not False and options.path_name not in paths:
            raise ValueError(f"--{name} is for {' and '.join(paths)}, not for {options.path_name}")
    if options.frames is not None and not 1 <= options.frames <= camera_paths.MAX_FRAMES:
        raise ValueError(f"--frames must be between 1 and {camera_paths.MAX_FRAMES:,}, got {options.frames}")
    if not 1 <= options.supersample <= MAX_SUPERSAMPLING:
        raise ValueError(f"--supersample must be between 1 and {MAX_SUPERSAMPLING}, got {options.supersample}")
    if options.time is not None and not 0 <= options.time <= 1:
        raise ValueError(f"--time must be in [0, 1], got {options.time}")
    if not (math.isfinite(options.scale) and options.scale > 0):
        raise ValueError(f"--scale must be positive, got {options.scale}")
    slowest, fastest = mp4.FRAME_RATES
    if options.rate is not None and not slowest <= options.rate <= fastest:
        raise ValueError(f"--rate must be between {slowest:g} and {fastest:g}, got {options.rate}")


def _cameras(options: Render, capture: Capture, dynamic: Tensor, means: Tensor) -> tuple[list[Camera], list[str]]:
    """The cameras of the path and the name of each image."""
    frames, time = options.frames or FRAMES, 0.5 if options.time is None else options.time
    if options.keyframes is not None:
        return _numbered(keyframes.read_path(options.keyframes, capture, frames))
    if options.path_name == "views":
        if not capture.val:
            raise ValueError(f"{capture.name} has no evaluation views; choose another --path")
        return [capture.cameras[name] for name in capture.val], list(capture.val)
    if options.path in ("frozen", "moving"):
        path = camera_paths.training_path(capture, frames)
        frozen = [dataclasses.replace(camera, time=time) for camera in path]
        return _numbered(path if options.path == "moving" else frozen)
    camera = _start_view(options, capture)
    if options.path == "fixed":
        return _numbered(camera_paths.at_times(camera, camera_paths.evenly_spaced(frames)))
    distance = camera_paths.focus(camera, dynamic if len(dynamic) else means)
    if options.path == "spiral":
        times = camera_paths.evenly_spaced(frames) if options.time is None else [options.time] * frames
        return _numbered(camera_paths.spiral(camera, distance, REACH * capture.extent, times))
    return _numbered(camera_paths.bullet(camera, distance, time, frames))


def _numbered(path: list[Camera]) -> tuple[list[Camera], list[str]]:
    return path, [_number(k) for k in range(len(path))]


def _number(k: int) -> str:
    return f"{k:05d}"


def _start_view(options: Render, capture: Capture) -> Camera:
    """The camera from which the fixed, spiral and bullet paths start."""
    names = capture.val or capture.train
    name = options.view or names[len(names) // 2]
    if name not in capture.cameras:
        raise ValueError(f"{capture.name} has no view {name!r}; its first is {names[0]!r}")
    return capture.cameras[name]


def _frames(
    options: Render, capture: Capture, scene: TrainedScene, cameras: list[Camera], names: list[str]
) -> Iterator[np.ndarray]:
    """Renders the 8-bit RGB image of each camera, one at a time."""
    for camera, name in progress(list(zip(cameras, names, strict=True)), "rendering", options.quiet):
        camera = camera_paths.resized(camera, options.scale).to(scene.device)
        larger = camera_paths.resized(camera, float(options.supersample))
        rendering = scene.render(larger, branches=options.layers != "joint")
        images = [_averaged(image, options.supersample) for image in _images(rendering, options.layers)]
        if options.truth:
            truth = capture.frame(name).image.to(scene.device).float() / 255.0
            images.insert(0, _resized(truth, camera))
        yield visualize.to_bytes(torch.cat(images, 1))


def _images(rendering: Rendering, layers: str) -> list[Float[Tensor, "H W 3"]]:
    by_name = {"joint": rendering.joint, "static": rendering.static, "dynamic": rendering.dynamic}
    chosen = by_name if layers == "all" else {layers: by_name[layers]}
    return [layer.image.clamp(0, 1) for layer in chosen.values() if layer is not None]


def _averaged(image: Float[Tensor, "H W 3"], factor: int) -> Float[Tensor, "h w 3"]:
    if factor == 1:
        return image
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), factor).permute(1, 2, 0)


def _resized(truth: Float[Tensor, "H W 3"], camera: Camera) -> Float[Tensor, "h w 3"]:
    """A ground-truth image, resized to a camera's size."""
    size = (camera.height, camera.width)
    if truth.shape[:2] == size:
        return truth
    channels = truth.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(channels, size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)


def _write(options: Render, folder: Path, names: list[str], images: Iterator[np.ndarray]) -> str:
    """Writes images while they are rendered; returns a summary."""
    if options.path_name != "views" and options.write != "mp4":
        # an earlier, longer path may have left more images
        remove_numbered(folder, lambda k: f"{_number(k)}.png")
    with ExitStack() as stack:
        video = mp4.Video(folder / "video.mp4", options.rate or mp4.FRAME_RATE)
        writer = stack.enter_context(video) if options.write != "png" else None
        for name, image in zip(names, images, strict=True):
            if writer is not None:
                _add(writer, image)
            if options.write != "mp4":
                write_png(folder / f"{name}.png", image)
    height, width = image.shape[:2]
    return f"{len(names)} images of {width} × {height} in {folder}"


def _add(video: mp4.Video, image: np.ndarray) -> None:
    try:
        video.add(image)
    except OSError as error:
        raise OSError(f"{error}; --write png needs no encoder for MP4") from error
