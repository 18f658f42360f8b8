"""Images and videos of a trained scene, at the evaluation views or along a camera path (``warpgs render``)."""

import dataclasses
import math
from collections.abc import Iterator
from contextlib import ExitStack
from functools import cache, partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture, missing_view
from warpgs.editing.edited_scene import with_edits
from warpgs.errors import counted
from warpgs.files import remove_numbered, write_png
from warpgs.runs.opening import open_scene
from warpgs.runs.run import Run

from . import camera_paths, keyframes, writer
from .encodings import ENCODINGS
from .frames import COLORED, render_frames
from .options import Render

FRAMES = 120
"""Default number of frames along a path."""

PATHS_OF_OPTION = {
    "truth": ("views",),
    "view": ("fixed", "spiral", "bullet", "cameras"),
    "time": ("frozen", "spiral", "bullet"),
    "lens": ("fixed", "frozen", "moving", "spiral", "bullet"),
    "frames": ("fixed", "frozen", "moving", "spiral", "bullet", "keyframes"),
}
"""Camera paths that an option applies to; the other options apply to all."""

MAX_SUPERSAMPLING = 8

REACH, MIN_REACH = 0.33, 0.015
"""Radius of the spiral, relative to the radius of the training camera's path, because nothing shows the scene from
farther away; and its minimum relative to the median depth, for a camera that stood still."""


def render_run(options: Render) -> str:
    """Renders the newest checkpoint of a run to images and a video; returns a summary to print.

    Raises:
        ValueError: If the run, its capture, the camera path or an option is not valid.
        OSError: If a file cannot be written.
    """
    run = open_scene(options.run_folder, options.device, options.data)
    if not run.has_capture and options.path_name == "views":
        options = dataclasses.replace(options, path="spiral")
    _check(options)
    opened = cache(partial(_opened_capture, run, options.quiet))
    scene, notes = with_edits(
        run.trained_scene(), run.folder, options.editing, opened, options.quiet, options.layers == "objects"
    )
    capture = opened() or camera_paths.default_capture(scene.splats(0.5).means.cpu(), run.folder.name)
    means = scene.splats(_time(options)).means.cpu()
    dynamic = means[len(scene.scene.static) :]
    centers = torch.stack([capture.cameras[name].position for name in capture.train])
    cameras, names = _cameras(options, capture, dynamic, means)
    if options.lens == "recorded":
        distortion = _start_view(options, capture).distortion
        cameras = [dataclasses.replace(camera, distortion=distortion) for camera in cameras]
    given = options.keyframes or options.cameras
    camera_paths.BoundingSphere.around(means, centers).check(cameras, str(given or options.path_name))
    name = given.stem if given else options.path_name
    folder = options.out or run.folder / "render" / name
    summary = _write(options, folder, names, render_frames(options, capture, scene, cameras, names))
    return "\n".join([summary, *notes])


def _opened_capture(run: Run, quiet: bool) -> Capture | None:
    """The capture of a run; None if it has none, as files of other programs."""
    return run.open_corrected_capture(quiet) if run.has_capture else None


def _check(options: Render) -> None:
    given = [name for name in ("path", "keyframes", "cameras") if getattr(options, name) is not None]
    if len(given) > 1:
        raise ValueError(f"--{given[-1]} define the path: omit --{given[0]}")
    for name, paths in PATHS_OF_OPTION.items():
        value = getattr(options, name)
        if value is not None and value is not False and options.path_name not in paths:
            raise ValueError(f"--{name} is for {', '.join(paths)}, not for {options.path_name}")
    if options.frames is not None and not 1 <= options.frames <= camera_paths.MAX_FRAMES:
        raise ValueError(f"--frames must be between 1 and {camera_paths.MAX_FRAMES:,}, got {options.frames}")
    if not 1 <= options.supersample <= MAX_SUPERSAMPLING:
        raise ValueError(f"--supersample must be between 1 and {MAX_SUPERSAMPLING}, got {options.supersample}")
    if options.time is not None and not 0 <= options.time <= 1:
        raise ValueError(f"--time must be in [0, 1], got {options.time}")
    if not (math.isfinite(options.scale) and options.scale > 0):
        raise ValueError(f"--scale must be positive, got {options.scale}")
    _check_image(options)
    slowest, fastest = writer.FRAME_RATES
    if video := _video_suffix(options):
        fastest = min(fastest, ENCODINGS[video].max_rate)
    if options.rate is not None and not slowest <= options.rate <= fastest:
        raise ValueError(f"--rate must be between {slowest:g} and {fastest:g}, got {options.rate}")


def _check_image(options: Render) -> None:
    if options.size is not None and options.scale != 1.0:
        raise ValueError("--size is the size of the image: omit --scale")
    if options.size is not None:
        _ = options.image_size
    if options.transparent and options.layers not in (*COLORED, "all"):
        raise ValueError(f"--transparent is for joint, static, dynamic and all, not for {options.layers}")
    video = _video_suffix(options)
    if options.transparent and video and not ENCODINGS[video].has_alpha:
        raise ValueError("MP4 has no transparency: add --write png, --write webp or --write gif to --transparent")


def _video_suffix(options: Render) -> str | None:
    """Suffix of the video that the options ask for; None without a video."""
    return {"png": None, "both": ".mp4"}.get(options.write, f".{options.write}")


def _cameras(options: Render, capture: Capture, dynamic: Tensor, means: Tensor) -> tuple[list[Camera], list[str]]:
    """The cameras of the path and the name of each image."""
    frames, time = options.frames or FRAMES, _time(options)
    if options.keyframes is not None:
        return _numbered(keyframes.read_path(options.keyframes, capture, frames))
    if options.cameras is not None:
        from .given_cameras import read_cameras  # imports loaders

        return _numbered(read_cameras(options.cameras, capture, options.view))
    if options.path_name == "views":
        if not capture.val:
            raise ValueError(f"{capture.name} has no evaluation views; choose another --path")
        return [capture.cameras[name] for name in capture.val], list(capture.val)
    if options.path in ("frozen", "moving"):
        path = camera_paths.training_path(capture, frames)
        frozen = [dataclasses.replace(camera, time=time) for camera in path]
        return _numbered(path if options.path == "moving" else frozen)
    if options.path == "bullet":
        stays = options.view is not None
        path = [_start_view(options, capture).pinhole] if stays else camera_paths.replay(capture, max(frames, FRAMES))
        return _numbered(camera_paths.bullet(path, (dynamic, means), time, frames))
    camera = _start_view(options, capture).pinhole
    if options.path == "fixed":
        return _numbered(camera_paths.at_times(camera, camera_paths.evenly_spaced(frames)))
    times = camera_paths.evenly_spaced(frames) if options.time is None else [options.time] * frames
    distance = camera_paths.focus(camera, dynamic, means)
    reach = max(REACH * capture.path_radius, MIN_REACH * capture.median_depth)
    return _numbered(camera_paths.spiral(camera, distance, reach, times))


def _time(options: Render) -> float:
    """Time of the frozen path, and at which the bullet path stops."""
    return 0.5 if options.time is None else options.time


def _numbered(path: list[Camera]) -> tuple[list[Camera], list[str]]:
    return path, [_number(k) for k in range(len(path))]


def _number(k: int) -> str:
    return f"{k:05d}"


def _start_view(options: Render, capture: Capture) -> Camera:
    """The camera from which the fixed and spiral paths start, and the bullet path with --view; its lens is --lens."""
    name = options.view or camera_paths.middle_view(capture)
    if name not in capture.cameras:
        raise ValueError(missing_view(capture, name))
    return capture.cameras[name]


def _write(options: Render, folder: Path, names: list[str], images: Iterator[np.ndarray]) -> str:
    """Writes images while they are rendered; returns a summary."""
    with_images = options.write in ("png", "both")
    if options.path_name != "views" and with_images:
        # an earlier, longer path may have left more images
        remove_numbered(folder, lambda k: f"{_number(k)}.png")
    with ExitStack() as stack:
        suffix = _video_suffix(options)
        file = folder / f"video{suffix}"
        video = writer.Video(file, options.rate or writer.FRAME_RATE) if suffix else None
        if video is not None:
            stack.enter_context(video)
        for name, image in zip(names, images, strict=True):
            if video is not None:
                _add(video, image)
            if with_images:
                write_png(folder / f"{name}.png", image)
    height, width = image.shape[:2]
    written = [*([folder] if with_images else []), *([file] if video else [])]
    return f"{counted(len(names), 'image')} of {width} × {height} in {' and '.join(map(str, written))}"


def _add(video: writer.Video, image: np.ndarray) -> None:
    try:
        video.add(image)
    except OSError as error:
        raise OSError(f"{error}; --write png needs no encoder") from error
