"""MegaSaM: an .npz file with images, depth, intrinsics and camera-to-world matrices (OpenCV axes) of a video."""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from warpgs.data.capture import Capture, Conventions
from warpgs.data.images import MAX_SIDE
from warpgs.data.lens import Lens
from warpgs.data.npz import read_npz
from warpgs.data.resized import inverse_of, resize

from .options import LoadOptions
from .posed import PosedFrame, Size, World, every_eighth, posed_capture, world_to_cameras

SUFFIXES = ("_sgd_cvd_hr.npz", "_droid.npz")
"""Ends of the names of the files that MegaSaM writes, the better one first."""

ARRAYS = ("images", "depths", "intrinsic", "cam_c2w")

CONVENTIONS = Conventions(depth="depth", depth_unit="the scale of the poses")


class MegaSamLoader:
    """Loads an output folder of MegaSaM with one video; every eighth frame for evaluation.

    Depth has the units of the cameras, and points are unprojected from it. The file has no masks.
    """

    def recognizes(self, root: Path) -> bool:
        """Whether there is a file of MegaSaM."""
        return any(any(root.glob(f"*{suffix}")) for suffix in SUFFIXES)

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        path = _file(root)
        arrays = read_npz(path, ARRAYS)
        images, depths, K, matrices = (arrays[name] for name in ARRAYS)
        if images.ndim != 4 or images.shape[3] != 3 or images.dtype != np.uint8 or not len(images):
            raise ValueError(f"{path}: images must be 8-bit RGB, [N, H, W, 3], got shape {list(images.shape)}")
        count, height, width = images.shape[:3]
        expected = {"depths": (count, height, width), "intrinsic": (3, 3), "cam_c2w": (count, 4, 4)}
        for name, shape in expected.items():
            if arrays[name].shape != shape or arrays[name].dtype.kind != "f":
                raise ValueError(f"{path}: {name} must have shape {list(shape)}, got {list(arrays[name].shape)}")
        if max(width, height) > MAX_SIDE:
            raise ValueError(f"{path}: images of {width}×{height} pixels are larger than {MAX_SIDE} per side")
        if K[0, 1] != 0:
            raise ValueError(f"{path}: cameras must have no skew, got {K[0, 1]}")
        focal, center = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
        try:
            lens = Lens(width, height, focal, center).checked()
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        poses, notes = world_to_cameras(path, matrices[:, :3].astype(np.float64))
        frames = [
            PosedFrame(
                f"{k:05d}",
                lens,
                poses[k],
                float(k),
                partial(_image, images[k]),
                inverse_depth=partial(inverse_of, depths[k]),
            )
            for k in range(count)
        ]
        val = every_eighth([frame.name for frame in frames])
        world = World(points=None, notes=notes, conventions=CONVENTIONS)
        return posed_capture(root, frames, val, world, options)


def _file(root: Path) -> Path:
    for suffix in SUFFIXES:
        found = sorted(root.glob(f"*{suffix}"))
        if len(found) > 1:
            raise ValueError(
                f"{root} has {len(found)} videos of MegaSaM, expected one: {found[0].name}, {found[1].name}"
            )
        if found:
            return found[0]
    raise ValueError(f"{root} has no file *{SUFFIXES[0]} or *{SUFFIXES[1]}")


def _image(image: UInt8[np.ndarray, "h w 3"], size: Size) -> UInt8[np.ndarray, "H W 3"]:
    return resize(np.ascontiguousarray(image), size)
