"""Writes frames, masks and cameras as a capture in the NeRF-DS layout, in scene units around the static points."""

import dataclasses
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8

from warpgs.captures.findings import few_of
from warpgs.command_line.progress import progress
from warpgs.data import writer
from warpgs.data.units import depth_range, scene_units

from .cameras.recovered import Cameras
from .cameras.sphere import points_around
from .contact_sheet import choose_evenly, overlay_mask, write_contact_sheet
from .frames.images import brighten, read_images
from .frames.take import Frames

FACTORS = (1, 2)
"""Downscaling factors of the images and masks; training uses the second with ``--factor 2``."""

FOLDERS = {"rgb": ".png", "resized_mask": ".png.png"}
"""Folders of the images and masks, and how the files of frames end there."""

MAX_DYNAMIC_VIEWS = 0.5
"""Fraction of a point's views in dynamic regions above which the point is omitted."""

MIN_STATIC_POINTS = 50

NO_PARALLAX = (
    "the camera stays at one place: nothing tells how far away surfaces are, so the points lie on a sphere around it "
    "(unless a network estimates depth), and views from elsewhere are guesses"
)


def write_capture(
    root: Path,
    frames: Frames,
    cameras: Cameras,
    dynamic: Sequence[Bool[np.ndarray, "H W"]],
    *,
    estimated: bool,
    holdout: int,
    quiet: bool = True,
) -> tuple[str, list[str]]:
    """Writes the capture, and the contact sheet masks.png; returns a summary, and notes for the user.

    Args:
        root: Folder of the capture.
        frames: All frames that were taken.
        cameras: Cameras of the registered frames.
        dynamic: [H, W] dynamic mask of each frame of the cameras.
        estimated: Whether the masks are estimates.
        holdout: Every N-th frame is for evaluation; 0 for none.
        quiet: Whether to show no progress.

    Raises:
        ValueError: If too few static points remain, or no frame for evaluation.
        OSError: If a file cannot be written; the message names it.
    """
    notes = [] if cameras.have_parallax else [NO_PARALLAX]
    cameras = _with_static_points(cameras, dynamic)
    writer.held_out(cameras.names, holdout)  # fails before anything is written
    omitted = [f"{frame.name} ({frame.source})" for frame in frames.taken if frame.name not in cameras.names]
    if omitted:
        notes.append(f"omitted, because no camera was found for them: {few_of(omitted)}")
    shown = write_frames(root, frames.folder, cameras, dynamic, choose_evenly(len(dynamic)), quiet)
    write_scene(root, cameras, {frame.name: frame.time for frame in frames.taken}, holdout, estimated)
    painted = {k: overlay_mask(image, dynamic[k]) for k, image in zip(shown, brighten([*shown.values()]), strict=True)}
    write_contact_sheet(root / "masks.png", painted, cameras.names)
    return f"{len(dynamic)} frames, {len(omitted)} omitted, {len(cameras.points)} static points", notes


def capture_files(root: Path, names: Sequence[str]) -> list[Path]:
    """The files of a capture with these frames that ``write_capture`` writes, without the contact sheet."""
    sizes = [f"{folder}/{factor}x/{{}}{end}" for folder, end in FOLDERS.items() for factor in FACTORS]
    frames = [root / path.format(name) for path in (*sizes, "camera/{}.json") for name in names]
    return [root / "dataset.json", root / "metadata.json", root / "scene.json", root / "points.npy", *frames]


def _with_static_points(cameras: Cameras, dynamic: Sequence[Bool[np.ndarray, "H W"]]) -> Cameras:
    if cameras.have_parallax:
        points = cameras.points[static_points(cameras, dynamic)]
    else:
        points = points_around(cameras, dynamic)
    if len(points) < MIN_STATIC_POINTS:
        raise ValueError(
            f"only {len(points)} static points are left: nearly everything moves, or the masks are inverted "
            "(0 = dynamic)"
        )
    return dataclasses.replace(cameras, points=points)


def static_points(cameras: Cameras, dynamic: Sequence[Bool[np.ndarray, "H W"]]) -> Bool[np.ndarray, " P"]:
    """[P] whether at least half of the frames that see a point see it in a static region.

    Args:
        cameras: Cameras with points.
        dynamic: [H, W] dynamic mask of each camera, in the size of the lens.
    """
    lens, points = cameras.lens, cameras.points
    hits, views = np.zeros(len(points)), np.zeros(len(points))
    for pose, mask in zip(cameras.poses, dynamic, strict=True):
        in_camera = points @ pose[:, :3].T + pose[:, 3]
        front = in_camera[:, 2] > 0
        depth = np.where(front, in_camera[:, 2], 1.0)
        position = lens.image(in_camera[:, 0] / depth, in_camera[:, 1] / depth)
        column, row = np.floor(position).clip(-1, 1e6).astype(int)
        visible = front & (column >= 0) & (column < lens.width) & (row >= 0) & (row < lens.height)
        views += visible
        hits[visible] += mask[row[visible], column[visible]]
    return hits <= MAX_DYNAMIC_VIEWS * np.maximum(views, 1)


def write_frames(
    root: Path,
    folder: Path,
    cameras: Cameras,
    dynamic: Sequence[Bool[np.ndarray, "H W"]],
    shown: Collection[int] = (),
    quiet: bool = True,
) -> dict[int, UInt8[np.ndarray, "H W 3"]]:
    """Writes images and masks in full and half size, and the camera of every frame.

    Args:
        root: Folder of the capture.
        folder: Folder of the frames as recorded.
        cameras: Cameras of the frames.
        dynamic: [H, W] dynamic mask of each frame.
        shown: Indices of the images to return.
        quiet: Whether to show no progress.

    Returns:
        [H, W, 3] images by index.

    Raises:
        ValueError: If a frame was damaged since it was taken.
        OSError: If a file cannot be written; the message names it.
    """
    images = {}
    originals = read_images(folder, cameras.names)
    for k, image in zip(progress(range(len(cameras.names)), "capture", quiet), originals, strict=True):
        name, pose = cameras.names[k], cameras.poses[k]
        writer.write_image(root, name, image, FACTORS)
        writer.write_mask(root, name, ~dynamic[k], FACTORS)
        writer.write_camera(root, name, cameras.lens, pose[:, :3], -pose[:, :3].T @ pose[:, 3])
        if k in shown:
            images[k] = image
    return images


def write_scene(
    root: Path, cameras: Cameras, times: dict[str, int], holdout: int, estimated_masks: bool = False
) -> None:
    """Writes points.npy, scene.json, metadata.json, and finally dataset.json, which makes the folder a capture.

    Args:
        root: Folder of the capture.
        cameras: Cameras with static points only.
        times: Time of each frame, see ``SourceFrame``.
        holdout: Every N-th frame is for evaluation; 0 for none.
        estimated_masks: Whether the masks are estimates.

    Raises:
        OSError: If a file cannot be written; the message names it.
    """
    write_world(root, cameras)
    first = times[cameras.names[0]]
    time_ids = {name: times[name] - first for name in cameras.names}
    val = writer.held_out(cameras.names, holdout)
    writer.write_index(root, time_ids, val, estimated_masks=estimated_masks)


def write_world(root: Path, cameras: Cameras) -> None:
    """Writes points.npy, and scene.json with the units around them.

    Raises:
        OSError: If a file cannot be written; the message names it.
    """
    units, poses = scene_units(cameras.points, cameras.centers), cameras.poses
    depths = np.concatenate([cameras.points @ p[2, :3] + p[2, 3] for p in poses[:: max(1, len(poses) // 20)]])
    writer.write_scene(root, units, cameras.points, *depth_range(depths * units.scale))
