"""Copies a capture of any layout into the layout of warpgs, in scene units."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np

from warpgs.command_line.progress import progress
from warpgs.data import writer
from warpgs.data.capture import Capture, Frame
from warpgs.data.lens import Lens
from warpgs.data.tracks import write_tracks
from warpgs.data.units import SceneUnits, depth_range
from warpgs.errors import command, counted
from warpgs.files import complete_or_absent

from .opening import load_capture

FACTORS = (1, 2)
"""Downscaling factors of the images and masks that are written."""

MAX_HALF = 6e4
"""Maximum of the stored inverse depth; half floats end at 65504."""


def import_capture(
    source: Path,
    target: Path,
    dataset: str | None = None,
    *,
    factor: int | None = None,
    holdout: int | None = None,
    holdout_camera: Collection[int] = (),
    log: Callable[[str], None] | None = None,
) -> None:
    """Writes a copy of a capture in the layout of warpgs (docs/capture-format.md).

    Args:
        source: Folder of the capture.
        target: Folder to write; it must not exist or be empty.
        dataset: Layout of the source, a key of ``LOADERS``; recognized from its files if None.
        factor: Downscaling factor of the images; that of the layout if None.
        holdout, holdout_camera: See ``Import``; None and none keep the split of the source.
        log: Receives lines for the user; None shows nothing, the progress bar included.

    Raises:
        ValueError: If the source is damaged, the target is not empty, or there is nothing to hold out.
        OSError: If a file cannot be written; the message names it.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise ValueError(f"{target} is not an empty folder: choose a new one for the capture")
    capture, renamed = _with_plain_ids(load_capture(source, dataset, factor=factor, cache_frames=2))
    by_camera = capture.by_camera((*capture.train, *capture.val))  # videos are decoded in order
    chooses = holdout is not None or bool(holdout_camera)
    val = writer.held_out_of(by_camera, holdout or 0, holdout_camera) if chooses else [*capture.val]
    with complete_or_absent(target) as folder:
        counts = _write_frames(folder, capture, names := [*chain(*by_camera.values())], quiet=log is None)
        _write_index(folder, capture, names, val)
    if log is not None:
        log(
            f"{source} is read as {capture.layout}: {counted(len(names), 'frame')}, {counts[0]} with masks, "
            f"{counts[1]} with depth, {len(val)} for evaluation, {counted(len(capture.points), 'point')}"
        )
        _log_remarks(capture, renamed, log)
        log(f"{target} is finished: next run {command('check', target)}")


def _with_plain_ids(capture: Capture) -> tuple[Capture, list[tuple[str, str]]]:
    """The capture with ids that the copy can have, and those that differ, before and after."""
    ids = writer.plain_ids([*capture.train, *capture.val])
    renamed = [(old, new) for old, new in ids.items() if old != new]
    if not renamed:
        return capture, []
    old_of = {new: old for old, new in ids.items()}
    return replace(
        capture,
        cameras={ids[name]: camera for name, camera in capture.cameras.items()},
        train=[ids[name] for name in capture.train],
        val=[ids[name] for name in capture.val],
        read=lambda name: replace(capture.frame(old_of[name]), name=name),
    ), renamed


def _log_remarks(capture: Capture, renamed: list[tuple[str, str]], log: Callable[[str], None]) -> None:
    if renamed:
        example = "{!r} is {!r} in the copy".format(*renamed[0])
        log(f"note: {len(renamed)} frames have ids that files cannot have everywhere: {example}")
    for note in (*capture.notes, capture.time_source):
        log(f"note: {note}")
    if capture.assumption == "dynamic":
        log("everything is taken as dynamic in it: train on the copy with --assume dynamic, or add masks")


def _write_frames(folder: Path, capture: Capture, names: Sequence[str], quiet: bool) -> tuple[int, int]:
    """Writes the frames; returns the numbers of those with masks and with depth."""
    num_masks = num_depths = 0
    for name, frame in zip(progress(names, "importing", quiet), capture.frames(names), strict=True):
        if frame.static_mask is not None and capture.assumption == "masks":
            writer.write_mask(folder, name, frame.static_mask.numpy(), FACTORS)
            num_masks += 1
        if frame.inverse_depth is not None:
            inverse = frame.inverse_depth.numpy() / Lens.of(frame.camera).axial_depths()
            writer.write_depth(folder, name, np.minimum(inverse, MAX_HALF).astype(np.float16))
            num_depths += 1
        if frame.covisible is not None:
            writer.write_covisible(folder, name, frame.covisible.numpy(), FACTORS)
        _write_view(folder, frame)
    return num_masks, num_depths


def _write_view(folder: Path, frame: Frame) -> None:
    lens = Lens.of(frame.camera)
    rotation, position = frame.camera.viewmat[:3, :3].double(), frame.camera.position.double()
    writer.write_image(folder, frame.name, frame.image.numpy(), FACTORS)
    writer.write_camera(folder, frame.name, lens, rotation.numpy(), position.numpy())


def _write_index(folder: Path, capture: Capture, names: list[str], val: list[str]) -> None:
    points = capture.points.double().numpy()
    colors = None if capture.point_colors is None else capture.point_colors.numpy()
    near, far = depth_range(_depths(capture))
    writer.write_scene(folder, SceneUnits(np.zeros(3), 1.0), points, near, far, colors)
    cameras = {name: capture.cameras[name] for name in names}
    if (tracks := capture.tracks) is not None:
        size = capture.cameras[capture.train[0]].size
        write_tracks(folder, tracks.positions * np.array(size), tracks.visible, size)
    writer.write_index(
        folder,
        {name: camera.time for name, camera in cameras.items()},
        val,
        {name: camera.id for name, camera in cameras.items()},
        estimated_masks=capture.estimated_masks,
        readout=capture.readout,
        readout_from=capture.readout_from,
    )


def _depths(capture: Capture) -> np.ndarray:
    """Depths of the points in at most 40 training cameras [scene units]."""
    cameras = [capture.cameras[name] for name in capture.train[:: max(1, len(capture.train) // 20)]]
    return np.concatenate([camera.project(capture.points)[2].numpy() for camera in cameras])
