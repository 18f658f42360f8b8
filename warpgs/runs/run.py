"""Run folders: config.json, checkpoints/, metrics.json, views.csv, events/, pictures/."""

import dataclasses
import fcntl
import json
import reprlib
import subprocess
import sys
import typing
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import torch

from . import checkpoint
from warpgs import visualize as pictures
from warpgs.config import TrainConfig, validate
from warpgs.data.capture import Capture, Frame
from warpgs.data.loaders.nerfies import load_capture
from warpgs.data.synthetic import builtin_capture
from warpgs.data.writer import write_png
from warpgs.evaluation.evaluate import Evaluation, RenderAt, evaluate, write_json, write_views
from warpgs.files import read_bounded, write_text
from warpgs.evaluation.lpips import find, locate
from .trained import Player
from warpgs.progress import progress
from warpgs.render import Rendering
from warpgs.model.scene import SplitScene

PICTURES = 6
"""Evaluation views to draw, spread over the capture."""

LARGEST_CONFIG = 1 << 20
"""Of config.json [bytes]."""

LOCK = ".lock"
"""File in a run folder that whoever trains there holds."""

VIDEO_FRAMES = 120
"""Frames of the video over time, at most."""


def resolve(config: TrainConfig) -> TrainConfig:
    """The config with its device chosen.

    Raises:
        ValueError: If CUDA is asked for and there is none, or the weights of LPIPS are not where they should be.
    """
    locate(config.lpips)
    if config.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda was asked for, but torch sees no CUDA device; use --device cpu")
    return dataclasses.replace(config, device=config.device or ("cuda" if torch.cuda.is_available() else "cpu"))


def open_capture(config: TrainConfig, quiet: bool = False) -> Capture:
    """The capture of a config; without one, the built-in scene, made if need be."""
    root = config.data or builtin_capture(device=torch.device(config.device or "cpu"), quiet=quiet)
    return load_capture(root, config.dataset, factor=config.factor, perturbation=config.masks)


def new_folder(config: TrainConfig, capture: Capture) -> Path:
    """Where a new run goes; nothing is made yet.

    Raises:
        ValueError: If the folder asked for exists already and holds something.
    """
    folder = config.out
    if folder is None:
        stem = Path("runs") / f"{capture.name}-{config.preset}"
        folder = next(p for k in range(1, 10_000) if not (p := stem if k == 1 else Path(f"{stem}-{k}")).exists())
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} exists and is not empty: go on with --resume {folder}, or choose another --out")
    return folder


def create(folder: Path, config: TrainConfig) -> None:
    """Makes a run folder and writes its config.json.

    Raises:
        OSError: If it can't be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    data, weights = config.data and config.data.resolve(), config.lpips and config.lpips.resolve()
    plain = dataclasses.asdict(dataclasses.replace(config, out=folder, data=data, lpips=weights))
    write_text(folder / "config.json", json.dumps(plain, indent=2, default=str) + "\n")


@contextmanager
def held(folder: Path) -> Iterator[None]:
    """Holds a run folder while it is trained in, so that no other process does; ends with the process at the latest.

    Raises:
        ValueError: If another process holds it.
        OSError: If it can't be written in.
    """
    with open(folder / LOCK, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ValueError(f"{folder} is being trained by another process") from error
        yield


def load_config(folder: Path) -> TrainConfig:
    """The config of a run.

    Raises:
        ValueError: If the folder is no run, or its config has unknown or ill-typed fields.
    """
    path = folder / "config.json"
    if not path.exists():
        raise ValueError(f"{folder} is no run folder: it has no config.json")
    data = read_bounded(path, LARGEST_CONFIG)
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    config = dataclasses.replace(_from_plain(TrainConfig, values, path), out=folder)
    try:
        validate(config)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return config


def _from_plain(kind: Any, values: Any, path: Path) -> Any:
    """A (nested) dataclass of what JSON kept of it."""
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected an object for {kind.__name__}, got {values!r}")
    hints = typing.get_type_hints(kind)
    if unknown := sorted(set(values) - set(hints)):
        raise ValueError(f"{path} has fields of another version: {', '.join(unknown)}")
    parts = {}
    for name, value in values.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            value = _from_plain(hint, value, path)
        elif Path in typing.get_args(hint) and isinstance(value, str):
            value = Path(value)
        elif not _fits(value, hint):
            raise ValueError(f"{path}: {name} can't be {reprlib.repr(value)}")
        parts[name] = float(value) if hint is float else value
    return kind(**parts)


def _fits(value: Any, hint: Any) -> bool:
    if typing.get_origin(hint) is typing.Literal:
        return value in typing.get_args(hint)
    if choices := typing.get_args(hint):
        return any(_fits(value, choice) for choice in choices)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return type(value) is hint


def newest_scene(folder: Path, config: TrainConfig) -> tuple[SplitScene, dict[str, Any]]:
    """The scene of a run's newest checkpoint, and what the checkpoint says of itself.

    Raises:
        ValueError: If there is no checkpoint or it is damaged.
    """
    saved = checkpoint.saved(folder)
    if not saved:
        raise ValueError(f"{folder} has no checkpoint yet")
    loaded = checkpoint.load(saved[-1])
    loaded.check_stage(config.model.sh_degree)
    return checkpoint.load_scene(loaded, config.model, saved[-1]), loaded.facts


def evaluate_run(
    folder: Path,
    capture: Capture | None = None,
    lpips: Path | None = None,
    device: Literal["cuda", "cpu"] | None = None,
    quiet: bool = False,
) -> str:
    """Evaluates the last iterate of a run: metrics.json, views.csv, pictures and a video; returns a text for people.

    Args:
        folder: Of the run.
        capture: Its capture, if that is open already.
        lpips: Folder with the weights of LPIPS; that of the config if None.
        device: Where to render; CUDA if there is a GPU.
        quiet: Whether to show no progress bars.

    Raises:
        ValueError: If the run, its capture or the weights of LPIPS can't be used.
        OSError: If something can't be written.
    """
    config = resolve(dataclasses.replace(load_config(folder), device=device))
    target = torch.device(config.device or "cpu")
    capture = capture or open_capture(config, quiet)
    scene, facts = newest_scene(folder, config)
    render_at = Player(scene.to(target), config, facts)
    network = find(lpips or config.lpips)
    chosen = {round(k * (len(capture.val) - 1) / max(1, PICTURES - 1)) for k in range(PICTURES)}

    def draw(index: int, frame: Frame, truth: torch.Tensor, rendering: Rendering) -> None:
        if index in chosen:
            path = folder / "pictures" / f"{frame.name}.png"
            write_png(path, pictures.comparison(truth, rendering))

    evaluation = evaluate(render_at, capture, target, network and network.to(target), draw, render_at.play, quiet)
    counts = {"num_static": len(scene.static), "num_dynamic": len(scene.dynamic)}
    run = {name: facts[name] for name in ("iteration", "train_seconds", "peak_bytes")}
    totals = {"iterations": run.pop("iteration"), **run, **counts, "commit": _commit()}
    write_json(folder / "metrics.json", {**evaluation.summary(), **totals})
    write_views(folder / "views.csv", evaluation)
    _write_video(folder / "time.mp4", render_at, capture, target, quiet)  # last: figures need no FFmpeg
    return _report(evaluation, counts)


def _write_video(path: Path, render_at: RenderAt, capture: Capture, device: torch.device, quiet: bool) -> None:
    """The middle evaluation camera (else training camera) over time: joint | static | dynamic."""
    names = capture.val or capture.train
    camera = capture.cameras[names[len(names) // 2]].to(device)
    with pictures.Video(path) as video:
        for k in progress(range(VIDEO_FRAMES), "video over time", quiet):
            rendering = render_at(dataclasses.replace(camera, time=k / (VIDEO_FRAMES - 1)), True)
            layers = (rendering.joint, rendering.static, rendering.dynamic)
            images = [layer.image for layer in layers if layer is not None]
            video.add(pictures.to_bytes(torch.cat(images, 1)))


def _report(evaluation: Evaluation, counts: dict[str, int]) -> str:
    values = evaluation.summary()

    def show(name: str, digits: int) -> str:
        value = values[name]
        return "not measured" if value is None else f"{value:.{digits}f}"

    last_line = f"{counts['num_static']:,} static and {counts['num_dynamic']:,} dynamic Gaussians"
    if not evaluation.views:
        quality = "the capture has no frames to evaluate on: PSNR, SSIM and LPIPS not measured"
        return f"{quality}\nflicker {show('flicker', 5)}, {show('fps', 1)} frames/s\n{last_line}"
    lpips = f"LPIPS ({evaluation.lpips_net}) {show('lpips', 4)}"
    if evaluation.lpips_net is None:
        lpips = "LPIPS not measured: no weights (give their folder with --lpips or in WARPGS_LPIPS)"
    lines = [
        f"{values['num_views']} views: PSNR {show('psnr', 2)} dB, SSIM {show('ssim', 4)}, {lpips}",
        f"static region {show('psnr_static', 2)} dB, dynamic region {show('psnr_dynamic', 2)} dB, "
        f"flicker {show('flicker', 5)}, {show('fps', 1)} frames/s",
        last_line,
    ]
    if values["masked_psnr"] is not None:
        lines.insert(1, f"co-visible: mPSNR {show('masked_psnr', 2)} dB, mSSIM {show('masked_ssim', 4)}")
    return "\n".join(lines)


def _commit() -> str | None:
    """The commit of the program where it runs from a checkout, not that of a checkout which it is installed in."""
    source = Path(__file__).parents[1]
    if not (source.parent / ".git").exists():
        return None
    try:
        done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=source, capture_output=True, text=True)
    except OSError:
        return None
    return done.stdout.strip() or None
