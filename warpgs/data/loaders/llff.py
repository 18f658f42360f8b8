"""LLFF: poses_bounds.npy beside images/, also with masks and other cameras (NVIDIA Dynamic Scene, as in NSFF).

A row of poses_bounds.npy holds a [3, 5] matrix and the nearest and farthest depth. The first three columns of the
matrix are the camera's axes down, right and backward in the world, the fourth is its centre, the fifth is height, width
and focal length [px]. Rows belong to the images in the order of their names.
"""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from warpgs.data.capture import Capture, Conventions
from warpgs.data.colmap import load_model
from warpgs.data.colmap_folders import ModelFolder, find_models
from warpgs.data.images import exchanged_sides, image_size, orientation_to, read_depth
from warpgs.data.lens import Lens
from warpgs.data.resized import read_resized_image, read_resized_mask
from warpgs.data.time_source import TimeSource
from warpgs.data.units import scene_units
from warpgs.files import natural_order, read_array

from .listed import find_file
from .options import LoadOptions
from .posed import PosedFrame, World, every_eighth, plain_names, posed_capture, world_to_cameras
from .turned import turning_notes

INDEX = "poses_bounds.npy"

MAX_FRAMES = 100_000

NUM_CAMERAS = 12
"""Cameras of NVIDIA's rig: frame t of the video is that of camera t modulo 12."""

MASKS, EVALUATION, EVALUATION_MASKS, DEPTHS = "motion_masks", "mv_images", "mv_masks", "disp"
"""Folders of NSFF: dynamic masks (white = dynamic), images of all cameras at each time with their masks, and inverse
depth up to scale and offset."""


WHITE_IS_DYNAMIC = Conventions(masks="white must mean dynamic and black static")


class LlffLoader:
    """Loads LLFF captures: every eighth frame for evaluation, or the other cameras of NVIDIA's rig."""

    def recognizes(self, root: Path) -> bool:
        """Whether there is a poses_bounds.npy; without NSFF's folders, a COLMAP model is preferred."""
        dynamic = any((root / name).is_dir() for name in (MASKS, EVALUATION))
        return (root / INDEX).is_file() and (dynamic or not _models(root))

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        poses, bounds, sizes, notes = read_poses(root / INDEX)
        paths = _images(_image_folder(root, options.factor))
        if len(paths) != len(poses):
            raise ValueError(f"{root / INDEX} has {len(poses)} poses, but {paths[0].parent} has {len(paths)} images")
        lenses = [_lens(root, path, size) for path, size in zip(paths, sizes, strict=True)]
        names = plain_names([path.name for path in paths])
        frames = [
            PosedFrame(name, lens, pose, float(k), partial(read_resized_image, path), *_mask_and_depth(root, path))
            for k, (name, path, lens, pose) in enumerate(zip(names, paths, lenses, poses, strict=True))
        ]
        others = list(_other_cameras(root, frames))
        val = [frame.name for frame in others] if others else every_eighth(names)
        options = replace(options, factor=1)  # that of the folder
        source = TimeSource(f"times from the order of the images, one for each pose of {INDEX}")
        world = world_of(root, poses, bounds)
        turned = turning_notes(paths, [(lens.width, lens.height) for lens in lenses])
        world = replace(world, time_source=source, notes=(*world.notes, *notes, *turned))
        return posed_capture(root, [*frames, *others], frozenset(val), world, options)


class Poses(NamedTuple):
    """[N, 3, 4] world-to-camera poses, [N, 2] bounds, [N, 3] height, width, focal length [px], and notes."""

    poses: Float[np.ndarray, "N 3 4"]
    bounds: Float[np.ndarray, "N 2"]
    sizes: Float[np.ndarray, "N 3"]
    notes: tuple[str, ...]


def read_poses(path: Path) -> Poses:
    """What a poses_bounds.npy holds.

    Raises:
        ValueError: If it is missing or damaged, or its numbers cannot be those of cameras.
    """
    rows = read_array(path, 17 * MAX_FRAMES).astype(np.float64)
    if rows.ndim != 2 or rows.shape[1] != 17 or len(rows) == 0 or not np.isfinite(rows).all():
        raise ValueError(f"{path} must hold finite numbers of shape [N, 17] with N > 0, got {list(rows.shape)}")
    matrices, bounds = rows[:, :15].reshape(-1, 3, 5), rows[:, 15:]
    down, right, backward, center = (matrices[:, :, k : k + 1] for k in range(4))
    poses, notes = world_to_cameras(path, np.concatenate([right, down, -backward, center], 2))
    if not ((bounds[:, 0] > 0) & (bounds[:, 1] > bounds[:, 0])).all() or not (matrices[:, :, 4] > 0).all():
        raise ValueError(f"{path}: bounds, sizes and focal lengths must be positive, and near less than far")
    return Poses(np.array(poses), bounds, matrices[:, :, 4], notes)


def _image_folder(root: Path, factor: int | None) -> Path:
    """images_<factor>/; without a factor the only images_<width>x<height>/, which NSFF trains on, or else images/.

    Raises:
        ValueError: If there is no such folder.
    """
    reduced = [path for path in root.glob("images_*x*") if path.is_dir()]
    if factor is None and len(reduced) == 1:
        return reduced[0]
    folder = root / ("images" if factor in (None, 1) else f"images_{factor}")
    if not folder.is_dir():
        found = ", ".join(sorted(path.name for path in root.glob("images*"))) or "no images"
        raise ValueError(f"{folder} is missing: {root} has {found}")
    return folder


def _images(folder: Path) -> list[Path]:
    suffixes = (".png", ".jpg", ".jpeg")
    found = [path for path in folder.iterdir() if path.suffix.lower() in suffixes]
    if not found:
        raise ValueError(f"{folder} has no images")
    return sorted(found, key=lambda path: natural_order(path.name))


def _lens(root: Path, path: Path, size: Float[np.ndarray, "3"]) -> Lens:
    """The lens of an image that may have been reduced since its pose was written."""
    return lens_of_row(root, path, image_size(path), size)


def lens_of_row(root: Path, path: Path, stored: tuple[int, int], size: Float[np.ndarray, "3"]) -> Lens:
    """The lens of an image or video.

    Args:
        root: Folder of the capture.
        path: The file.
        stored: (width, height) of its images, as stored [px].
        size: [3] height, width and focal length of its row in poses_bounds.npy, perhaps of larger images [px].

    Raises:
        ValueError: If the two sizes differ in shape, or the focal length is out of range.
    """
    full_height, full_width, focal = size.tolist()

    def fits(size: tuple[int, int]) -> bool:
        return bool(abs(size[0] * full_height - size[1] * full_width) <= 0.01 * size[0] * full_height)

    width, height = stored if orientation_to(path, stored, fits) == 1 else stored[::-1]
    if not fits((width, height)):
        shape = f"but its pose is of {full_width:g}×{full_height:g} images{exchanged_sides(path, stored, fits)}"
        raise ValueError(f"{path} is {width}×{height}, {shape}")
    scale = focal / full_width * width
    try:
        return Lens.centered(scale, (width, height)).checked()
    except ValueError as error:
        raise ValueError(f"{root / INDEX}: {error}") from error


def _mask_and_depth(root: Path, image: Path) -> tuple[partial | None, partial | None]:
    mask = find_file(root / MASKS, f"{image.stem}.png")
    depth = find_file(root / DEPTHS, f"{image.stem}.npy")
    return (
        None if mask is None else partial(_read_static, mask, image=image),
        None if depth is None else partial(read_depth, depth, image=image),
    )


def _read_static(path: Path, size: tuple[int, int], image: Path) -> Bool[np.ndarray, "H W"]:
    """The static mask of a file of NSFF, in which dynamic pixels are white."""
    return ~read_resized_mask(path, size, image)


def _other_cameras(root: Path, frames: list[PosedFrame]) -> list[PosedFrame]:
    """mv_images/<time>/cam<camera>: what the rig's other cameras saw at the times of the video, which is camera 0."""
    found = []
    for path in sorted((root / EVALUATION).glob("*/cam*.jpg")) + sorted((root / EVALUATION).glob("*/cam*.png")):
        number = re.fullmatch(r"cam(\d{1,3})", path.stem)
        time = int(path.parent.name) if path.parent.name.isdecimal() else -1
        camera = int(number[1]) - 1 if number else -1
        if not 0 <= time < len(frames) or not 0 <= camera < min(NUM_CAMERAS, len(frames)):
            raise ValueError(f"{path} must be a camera from cam01 to cam{NUM_CAMERAS} at the time of a frame")
        if time % NUM_CAMERAS == camera:
            continue  # the video itself
        mask = find_file(root / EVALUATION_MASKS / path.parent.name, f"{path.stem}.png")
        source = frames[camera]
        name = f"{path.parent.name}_{path.stem}"
        read_mask = None if mask is None else partial(_read_static, mask, image=path)
        found.append(
            PosedFrame(
                name,
                source.lens,
                source.pose,
                float(time),
                partial(read_resized_image, path),
                read_mask,
                camera=camera + 1,
            )
        )
    return found


def world_of(root: Path, poses: Float[np.ndarray, "N 3 4"], bounds: Float[np.ndarray, "N 2"]) -> World:
    """Points of a COLMAP model, if there is one; otherwise units that contain what lies between the bounds."""
    if models := _models(root):
        # Several models have unrelated worlds: the poses come from the one with as many images.
        folder = next((model.folder for model in models if model.num_images() == len(poses)), models[0].folder)
        _, points, colors, notes = load_model(folder)
        if len(points):
            return World(points, colors, notes=notes, conventions=WHITE_IS_DYNAMIC)
    centers = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
    along = centers[:, None] + bounds[:, :, None] * poses[:, None, 2, :3]
    return World(np.zeros((0, 3)), units=scene_units(along.reshape(-1, 3), centers), conventions=WHITE_IS_DYNAMIC)


def _models(root: Path) -> list[ModelFolder]:
    """COLMAP models of the images themselves, not of undistorted copies."""
    return [model for model in find_models(root) if model.part == root]
