"""Writes frames, masks and cameras as a capture in the NeRF-DS layout, in scene units around the static points."""

from collections.abc import Callable, Collection, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from warpgs.captures.findings import few_of
from warpgs.command_line.progress import progress
from warpgs.data import writer
from warpgs.data.capture import Side
from warpgs.data.units import depth_range, scene_units

from .cameras.recovered import Cameras, camera_centers
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

Masks = Sequence[Bool[np.ndarray, "H W"]]

NO_PARALLAX = (
    "the camera stays at one place: nothing tells how far away surfaces are, so the points lie on a sphere around it "
    "(unless a network estimates depth), and views from elsewhere are guesses"
)


SEVERAL_SIDES = (
    "the videos were filmed with the phones held differently: a rolling shutter (--readout) begins at the {} of their "
    "images, but --readout-from is one side for all"
)


def write_capture(
    root: Path,
    videos: Sequence[Frames],
    cameras: Sequence[Cameras],
    masks: Callable[[Cameras], Masks],
    *,
    estimated: bool,
    val: Collection[str],
    quiet: bool = True,
) -> tuple[str, list[str]]:
    """Writes the capture, and the contact sheet masks.png; returns a summary, and notes for the user.

    Args:
        root: Folder of the capture.
        videos: All frames that were taken, of each camera.
        cameras: The frames of each camera that were registered.
        masks: Gives the [H, W] dynamic mask of each frame of a camera.
        estimated: Whether the masks are estimates.
        val: Names of the frames for evaluation.
        quiet: Whether to show no progress.

    Raises:
        ValueError: If too few static points remain.
        OSError: If a file cannot be written; the message names it.
    """
    notes = [NO_PARALLAX] if len(cameras) == 1 and not cameras[0].have_parallax else []
    points = _static_points(cameras, masks)
    if omitted := _omitted(videos, cameras):
        notes.append(f"omitted, because no camera was found for them: {few_of(omitted)}")
    sheets = []
    for camera in cameras:
        dynamic, chosen = masks(camera), choose_evenly(len(camera.names), len(cameras))
        shown = write_frames(root, videos[0].folder, camera, dynamic, chosen, quiet)
        sheets.append(_painted(camera.names, shown, dynamic))
    times = {frame.name: frame.time for video in videos for frame in video.taken}
    write_scene(root, cameras, points, times, val, estimated, _common_side(videos, notes))
    write_contact_sheet(root / "masks.png", sheets)
    return f"{len(times) - len(omitted)} frames, {len(omitted)} omitted, {len(points)} static points", notes


def _common_side(videos: Sequence[Frames], notes: list[str]) -> Side:
    """``Frames.readout_from`` of all videos; the top, and a note for the user, if they differ."""
    sides = {video.readout_from for video in videos}
    if len(sides) > 1:
        notes.append(SEVERAL_SIDES.format(", ".join(sorted(sides))))
        return "top"
    return sides.pop()


def _omitted(videos: Sequence[Frames], cameras: Sequence[Cameras]) -> list[str]:
    """The frames without a camera, and where they are from."""
    placed = {name for camera in cameras for name in camera.names}
    return [f"{frame.name} ({frame.source})" for video in videos for frame in video.taken if frame.name not in placed]


def _painted(
    names: Sequence[str], shown: dict[int, UInt8[np.ndarray, "H W 3"]], dynamic: Masks
) -> dict[str, UInt8[np.ndarray, "H W 3"]]:
    """Images by index with their masks, by name."""
    bright = zip(shown, brighten([*shown.values()]), strict=True)
    return {names[k]: overlay_mask(image, dynamic[k]) for k, image in bright}


def capture_files(root: Path, names: Sequence[str]) -> list[Path]:
    """The files of a capture with these frames that ``write_capture`` writes, without the contact sheet."""
    sizes = [f"{folder}/{factor}x/{{}}{end}" for folder, end in FOLDERS.items() for factor in FACTORS]
    frames = [root / path.format(name) for path in (*sizes, "camera/{}.json") for name in names]
    return [root / "dataset.json", root / "metadata.json", root / "scene.json", root / "points.npy", *frames]


def _static_points(cameras: Sequence[Cameras], masks: Callable[[Cameras], Masks]) -> Float[np.ndarray, "P 3"]:
    if len(cameras) > 1:
        points = np.unique(np.concatenate([camera.points for camera in cameras]), axis=0)
    elif cameras[0].have_parallax:
        points = cameras[0].points
    else:
        return _enough(points_around(cameras[0], masks(cameras[0])))
    return _enough(points[are_static(points, ((camera, masks(camera)) for camera in cameras))])


def _enough(points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    if len(points) < MIN_STATIC_POINTS:
        raise ValueError(
            f"only {len(points)} static points are left: nearly everything moves, or the masks are inverted "
            "(0 = dynamic)"
        )
    return points


def are_static(points: Float[np.ndarray, "P 3"], cameras: Iterable[tuple[Cameras, Masks]]) -> Bool[np.ndarray, " P"]:
    """[P] whether at least half of the frames that see a point see it in a static region.

    Args:
        points: [P, 3] in the world.
        cameras: The frames of each camera, and their [H, W] dynamic masks, in the size of the lens.
    """
    hits, views = np.zeros(len(points)), np.zeros(len(points))
    for camera, dynamic in cameras:
        lens = camera.lens
        for pose, mask in zip(camera.poses, dynamic, strict=True):
            in_camera = points @ pose[:, :3].T + pose[:, 3]
            front = lens.file_depths(in_camera) > 0
            position = lens.project(np.where(front[:, None], in_camera, (0.0, 0.0, 1.0))).T
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
    root: Path,
    cameras: Sequence[Cameras],
    points: Float[np.ndarray, "P 3"],
    times: dict[str, int],
    val: Collection[str] = (),
    estimated_masks: bool = False,
    readout_from: Side = "top",
) -> None:
    """Writes points.npy, scene.json, metadata.json, and finally dataset.json, which makes the folder a capture.

    Args:
        root: Folder of the capture.
        cameras: The frames of each camera.
        points: [P, 3] static points in the world.
        times: Time of each frame, see ``SourceFrame``.
        val: Names of the frames for evaluation.
        estimated_masks: Whether the masks are estimates.
        readout_from: See ``Capture.readout_from``.

    Raises:
        OSError: If a file cannot be written; the message names it.
    """
    write_world(root, points, np.concatenate([camera.poses for camera in cameras]))
    first = min(times[camera.names[0]] for camera in cameras)
    time_ids = {name: times[name] - first for camera in cameras for name in camera.names}
    camera_ids = {name: k for k, camera in enumerate(cameras) for name in camera.names}
    others: dict[str, Any] = {"estimated_masks": estimated_masks, "readout_from": readout_from}
    writer.write_index(root, time_ids, val, camera_ids, **others)


def write_world(root: Path, points: Float[np.ndarray, "P 3"], poses: Float[np.ndarray, "F 3 4"]) -> None:
    """Writes points.npy, and scene.json with the units around them.

    Args:
        root: Folder of the capture.
        points: [P, 3] static points in the world.
        poses: [F, 3, 4] world to camera, of all frames.

    Raises:
        OSError: If a file cannot be written; the message names it.
    """
    units = scene_units(points, camera_centers(poses))
    depths = np.concatenate([points @ p[2, :3] + p[2, 3] for p in poses[:: max(1, len(poses) // 20)]])
    writer.write_scene(root, units, points, *depth_range(depths * units.scale))
