"""Pictures and videos of a trained run: its own views, or along a camera path."""

import dataclasses
import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from warpgs import visualize as pictures
from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.evaluation.evaluate import RenderAt
from warpgs.files import remove_numbered, write_png
from warpgs.progress import progress
from warpgs.render import Rendering
from warpgs.runs import run as runs
from warpgs.runs.trained import Player

from . import camera_paths as paths
from . import keyframes as paths_file

PathName = Literal["views", "fixed", "frozen", "moving", "spiral", "bullet"]

FRAMES = 120
"""Pictures along a path, where left out."""

MEANT_FOR = {
    "truth": ("views",),
    "view": ("fixed", "spiral", "bullet"),
    "time": ("frozen", "spiral", "bullet"),
    "frames": ("fixed", "frozen", "moving", "spiral", "bullet", "keyframes"),
}
"""Options that only some paths have."""

MAX_SUPERSAMPLING = 8
REACH = 0.3
"""Radius of the spiral, as a share of the radius of the filming camera's own path."""


@dataclass(frozen=True)
class Render:
    """Renders a run's newest checkpoint to pictures and a video."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folder."""
    path: PathName | None = None
    """What the camera does: the evaluation views (if left out); a fixed camera while time runs; the filming camera's
    path at a frozen moment; the same while time runs; a spiral around the middle view; bullet time around it."""
    keyframes: Path | None = None
    """JSON file of keyframes to follow instead (docs/viewing.md)."""
    out: Path | None = None
    """Folder to write into; RUN/render/PATH if left out."""
    view: str | None = None
    """Id of the view that fixed, spiral and bullet start from; the middle evaluation view if left out."""
    time: float | None = None
    """Moment in [0, 1] at which frozen and bullet stand still (½ if left out); spiral runs through time if left out."""
    frames: int | None = None
    """Pictures along a path; 120 if left out."""
    rate: float = pictures.VIDEO_RATE
    """Pictures a second of the video."""
    write: Literal["both", "png", "mp4"] = "both"
    """Numbered PNG files, a video, or both."""
    layers: Literal["joint", "static", "dynamic", "all"] = "joint"
    """Which image; all of them side by side."""
    truth: bool = False
    """With views: the picture that was filmed beside the image."""
    scale: float = 1.0
    """Size of the pictures, as a factor of the capture's."""
    supersample: int = 1
    """Render this many times as large a side, and average down."""
    data: Path | None = None
    """Where the capture is now, if it was moved."""
    device: Literal["cuda", "cpu"] | None = None
    """Where to render; CUDA if there is a GPU."""
    quiet: bool = False
    """Show no progress."""

    def run(self) -> None:
        print(render_run(self))

    @property
    def kind(self) -> str:
        """The path, or that there are keyframes instead."""
        return "keyframes" if self.keyframes is not None else self.path or "views"


def render_run(options: Render) -> str:
    """Does what the command was asked; returns a text for people.

    Raises:
        ValueError: If the run, its capture, the path or an option can't be used.
        OSError: If something can't be written.
    """
    _check(options)
    config = dataclasses.replace(runs.load_config(options.run_folder), device=options.device)
    config = runs.resolve(dataclasses.replace(config, data=options.data or config.data, lpips=None))
    scene, facts = runs.newest_scene(options.run_folder, config)
    capture = runs.open_capture(config, options.quiet)
    means = torch.cat([scene.dynamic.means, scene.static.means]).detach()
    centers = torch.stack([capture.cameras[name].position for name in capture.train])
    cameras, names = _cameras(options, capture, scene.dynamic.means.detach(), means)
    paths.Ball.around(means, centers).check(cameras, str(options.keyframes or options.kind))
    device = torch.device(config.device or "cpu")
    film = _Film(options, capture, Player(scene.to(device), config, facts), device)
    name = options.keyframes.stem if options.keyframes else options.kind
    folder = options.out or options.run_folder / "render" / name
    return _write(options, folder, names, film.pictures(cameras, names))


def _check(options: Render) -> None:
    if options.keyframes is not None and options.path is not None:
        raise ValueError("--keyframes are a path of their own: leave out --path")
    for name, kinds in MEANT_FOR.items():
        value = getattr(options, name)
        if value is not None and value is not False and options.kind not in kinds:
            raise ValueError(f"--{name} is for {' and '.join(kinds)}, not for {options.kind}")
    if options.frames is not None and not 1 <= options.frames <= paths.MAX_FRAMES:
        raise ValueError(f"--frames must be between 1 and {paths.MAX_FRAMES:,}, got {options.frames}")
    if not 1 <= options.supersample <= MAX_SUPERSAMPLING:
        raise ValueError(f"--supersample must be between 1 and {MAX_SUPERSAMPLING}, got {options.supersample}")
    if options.time is not None and not 0 <= options.time <= 1:
        raise ValueError(f"--time must be in [0, 1], got {options.time}")
    if not (math.isfinite(options.scale) and options.scale > 0):
        raise ValueError(f"--scale must be positive, got {options.scale}")
    slowest, fastest = pictures.VIDEO_RATES
    if not slowest <= options.rate <= fastest:
        raise ValueError(f"--rate must be between {slowest:g} and {fastest:g}, got {options.rate}")


def _cameras(options: Render, capture: Capture, moving: Tensor, means: Tensor) -> tuple[list[Camera], list[str]]:
    """The cameras of the path, and a name for the picture of each."""
    frames, moment = options.frames or FRAMES, 0.5 if options.time is None else options.time
    if options.keyframes is not None:
        return _numbered(paths_file.read_path(options.keyframes, capture, frames))
    if options.kind == "views":
        if not capture.val:
            raise ValueError(f"{capture.name} has no evaluation views; choose another --path")
        return [capture.cameras[name] for name in capture.val], list(capture.val)
    if options.path in ("frozen", "moving"):
        path = paths.training_path(capture, frames)
        frozen = [dataclasses.replace(camera, time=moment) for camera in path]
        return _numbered(path if options.path == "moving" else frozen)
    camera = _view(options, capture)
    if options.path == "fixed":
        return _numbered(paths.at_times(camera, paths.evenly_spaced(frames)))
    distance = paths.focus(camera, moving if len(moving) else means)
    if options.path == "spiral":
        times = paths.evenly_spaced(frames) if options.time is None else [options.time] * frames
        return _numbered(paths.spiral(camera, distance, REACH * capture.extent, times))
    return _numbered(paths.bullet(camera, distance, moment, frames))


def _numbered(path: list[Camera]) -> tuple[list[Camera], list[str]]:
    return path, [_number(k) for k in range(len(path))]


def _number(k: int) -> str:
    return f"{k:05d}"


def _view(options: Render, capture: Capture) -> Camera:
    names = capture.val or capture.train
    name = options.view or names[len(names) // 2]
    if name not in capture.cameras:
        raise ValueError(f"{capture.name} has no view {name!r}; its first is {names[0]!r}")
    return capture.cameras[name]


@dataclass(frozen=True)
class _Film:
    options: Render
    capture: Capture
    render_at: RenderAt
    device: torch.device

    def pictures(self, cameras: list[Camera], names: list[str]) -> Iterator[np.ndarray]:
        for camera, name in progress(list(zip(cameras, names, strict=True)), "rendering", self.options.quiet):
            yield pictures.to_bytes(self.picture(camera, name))

    def picture(self, camera: Camera, name: str) -> Float[Tensor, "H W 3"]:
        options = self.options
        factor = options.supersample
        camera = paths.resized(camera, options.scale).to(self.device)
        rendering = self.render_at(paths.resized(camera, float(factor)), options.layers != "joint")
        images = [_averaged(image, factor) for image in _images(rendering, options.layers)]
        if options.truth:
            truth = self.capture.frame(name).image.to(self.device).float() / 255.0
            images.insert(0, _fitted(truth, camera))
        return torch.cat(images, 1)


def _images(rendering: Rendering, layers: str) -> list[Float[Tensor, "H W 3"]]:
    by_name = {"joint": rendering.joint, "static": rendering.static, "dynamic": rendering.dynamic}
    chosen = by_name if layers == "all" else {layers: by_name[layers]}
    return [layer.image.clamp(0, 1) for layer in chosen.values() if layer is not None]


def _averaged(image: Float[Tensor, "H W 3"], factor: int) -> Float[Tensor, "h w 3"]:
    if factor == 1:
        return image
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), factor).permute(1, 2, 0)


def _fitted(truth: Float[Tensor, "H W 3"], camera: Camera) -> Float[Tensor, "h w 3"]:
    """A filmed picture in the size of a camera's."""
    size = (camera.height, camera.width)
    if truth.shape[:2] == size:
        return truth
    channels = truth.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(channels, size, mode="bilinear", antialias=True)[0].permute(1, 2, 0)


def _write(options: Render, folder: Path, names: list[str], images: Iterator[np.ndarray]) -> str:
    """Writes pictures as they come."""
    if options.kind != "views" and options.write != "mp4":  # of a longer path before this one
        remove_numbered(folder, lambda k: f"{_number(k)}.png")
    with ExitStack() as stack:
        video = pictures.Video(folder / "video.mp4", options.rate)
        writer = stack.enter_context(video) if options.write != "png" else None
        for name, image in zip(names, images, strict=True):
            if writer is not None:
                _add(writer, image)
            if options.write != "mp4":
                write_png(folder / f"{name}.png", image)
    height, width = image.shape[:2]
    return f"{len(names)} pictures of {width} × {height} in {folder}"


def _add(video: pictures.Video, image: np.ndarray) -> None:
    try:
        video.add(image)
    except OSError as error:
        raise OSError(f"{error}; --write png needs no encoder for MP4") from error
