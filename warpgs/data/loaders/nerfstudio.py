"""nerfstudio: transforms.json, as ns-process-data, Polycam, Record3D, KIRI Engine and instant-ngp write it."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

from warpgs.data.capture import Capture, Conventions
from warpgs.data.ply import read_ply_points
from warpgs.data.resized import read_metric_depth, read_resized_image, read_resized_mask
from warpgs.data.time_source import TimeSource, with_steps
from warpgs.errors import visible
from warpgs.files import natural_order, read_numbers

from .name_times import times_of_names
from .options import LoadOptions
from .posed import (
    PosedFrame,
    World,
    every_eighth,
    plain_names,
    posed_capture,
)
from .skipped import skipped_images
from .transforms import Transforms
from .turned import turning_notes

INDEX = "transforms.json"

MILLIMETRES = 1e-3
"""World units per unit of a depth file, nerfstudio's default ``depth_unit_scale_factor``."""


class NerfstudioLoader:
    """Loads transforms.json with the masks, depth and points that it names."""

    def recognizes(self, root: Path) -> bool:
        """Whether there is a transforms.json."""
        return (root / INDEX).is_file()

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        transforms = Transforms(root / INDEX)
        entries = sorted(transforms.frames, key=lambda entry: natural_order(transforms.image_name(entry)))
        images = [transforms.image(entry) for entry in entries]
        names = plain_names([transforms.image_name(entry) for entry in entries])
        times, source, cameras = _times(transforms, entries)
        frames = []
        for entry, image, name, time, camera in zip(entries, images, names, times, cameras, strict=True):
            mask, depth = transforms.file(entry, "mask_path"), transforms.file(entry, "depth_file_path")
            unit = _depth_unit(transforms)
            frames.append(
                PosedFrame(
                    name,
                    transforms.lens(entry, image),
                    transforms.pose(entry),
                    time,
                    partial(read_resized_image, image),
                    None if mask is None else partial(read_resized_mask, mask, image=image),
                    None if depth is None else partial(read_metric_depth, depth, unit=unit, image=image),
                    camera,
                )
            )
        by_image = {image.resolve(): name for image, name in zip(images, names, strict=True)}
        val, ignored = _evaluated(transforms, by_image)
        kept = [frame for frame in frames if frame.name not in ignored]
        notes = turning_notes(images, [(frame.lens.width, frame.lens.height) for frame in frames])
        notes += skipped_images(root, images, f"not listed in {INDEX}", others=transforms.found)
        if ignored:
            lists = "its lists train_filenames, val_filenames and test_filenames do not name them"
            notes.append(f"{len(ignored)} of {len(frames)} frames of {INDEX} are skipped: {lists}")
        world = replace(_world(transforms), time_source=source, notes=(*transforms.notes, *notes))
        return posed_capture(root, kept, val, world, options)


def _times(transforms: Transforms, entries: Sequence[dict[str, Any]]) -> tuple[list[float], TimeSource, list[int]]:
    """Times of sorted frames, from the first on: their field ``time`` or ``timestamp``, else those of their names.

    And the camera of each: its field ``camera_id``, else that of its name.
    """
    names = [transforms.image_name(entry) for entry in entries]
    times, source, are_read, named = times_of_names(names)
    cameras = transforms.cameras(entries) or named
    given = transforms.times(entries, "time", "timestamp")
    if given is None:
        return times, source, cameras
    field, stated = given
    first = min(stated)
    text = with_steps(f"times from the field {field} of {INDEX}", [float(time - first) for time in stated])
    by_name = sorted(zip(times, stated, names, strict=True), key=lambda item: item[:2])
    reversed_ = next(((a, b) for a, b in pairwise(by_name) if are_read and b[1] < a[1]), None)
    problem = ""
    if reversed_ is not None:
        before, after = (visible(item[2]) for item in reversed_)
        problem = f"the numbers in the names have another order: {after} is earlier than {before}"
    return [float(time - first) for time in stated], TimeSource(text, problem), cameras


def _depth_unit(transforms: Transforms) -> float:
    fields = {"depth_unit_scale_factor": MILLIMETRES, **transforms.fields}
    unit = float(read_numbers(transforms.path, fields, "depth_unit_scale_factor", ()))
    if unit <= 0:
        raise ValueError(f"{transforms.path}: depth_unit_scale_factor must be positive, got {unit}")
    return unit


def _evaluated(transforms: Transforms, names: dict[Path, str]) -> tuple[set[str], set[str]]:
    """Names of the frames to evaluate on, and of those to ignore.

    They are the split of train_filenames, val_filenames and test_filenames; every eighth frame without them.
    """
    lists = {key: transforms.fields.get(f"{key}_filenames") for key in ("train", "val", "test")}
    if all(given is None for given in lists.values()):
        return set(every_eighth([*names.values()])), set()
    chosen: dict[str, set[str]] = {}
    for key, given in lists.items():
        entries = [{f"{key}_filenames": entry} for entry in given] if isinstance(given, list) else []
        if given is not None and not isinstance(given, list):
            raise ValueError(f"{transforms.path}: {key}_filenames must be a list of files")
        paths = [transforms.file(entry, f"{key}_filenames") for entry in entries]
        unknown = next((path for path in paths if path is None or path.resolve() not in names), None)
        if len(paths) and unknown is not None:
            raise ValueError(f"{transforms.path}: {key}_filenames lists {unknown}, which is not a frame")
        chosen[key] = {names[path.resolve()] for path in paths if path is not None}
    held_out = chosen["val"] | chosen["test"]
    if not chosen["train"]:
        raise ValueError(
            f"{transforms.path} has no frames to train on: train_filenames must list some, beside val_filenames and "
            "test_filenames; without the three, every eighth frame is for evaluation"
        )
    if both := held_out & chosen["train"]:
        raise ValueError(f"{transforms.path}: frame {min(both)} is listed for both training and evaluation")
    return held_out, {*names.values()} - held_out - chosen["train"]


def _world(transforms: Transforms) -> World:
    """Points of ply_file_path; without it, points of the depth."""
    path = transforms.file(transforms.fields, "ply_file_path")
    if path is not None:
        return World(*read_ply_points(path), conventions=Conventions(depth="depth"))
    unit = f"depth_unit_scale_factor in {INDEX} ({_depth_unit(transforms):g})"
    return World(points=None, conventions=Conventions(depth="depth", depth_unit=unit))
