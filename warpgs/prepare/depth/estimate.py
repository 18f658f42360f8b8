"""A method that estimates inverse depth, and the files of the depth that it finds for a capture."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float

from warpgs.captures.findings import few_of
from warpgs.data.images import read_mask
from warpgs.data.writer import write_depth

from ..cameras.panorama import TURNS, cut, joined, views_of
from ..cameras.posed_frames import PosedFrames, load_posed_frames
from ..cameras.recovered import Cameras
from ..cameras.sphere import points_around
from ..contact_sheet import choose_evenly, colored_depth, write_contact_sheet
from ..scene import write_world
from ..weights import Network, find_weights

Planes = Sequence[Float[np.ndarray, "H W"]]

MAX_SIDE = 512
"""Longest side of the images that depth is estimated on [px]; smaller images are not enlarged."""

MAX_HALF = 1e3
"""Maximum of the stored inverse depth, relative to its median: half floats end at 65504."""


@dataclass(frozen=True)
class DepthMethod:
    """A method that estimates depth.

    Attributes:
        estimate: Inverse depth [H, W] of the frames up to scale and offset, NaN where unknown, from the frames, their
            dynamic masks, the folder of the network's weights (None without a network), and whether to be quiet.
        network: The network that it needs.
        needs_parallax: Whether the camera must move.
    """

    estimate: Callable[[PosedFrames, Iterable[Bool[np.ndarray, "H W"]], Path | None, bool], Planes]
    network: Network | None = None
    needs_parallax: bool = False

    def applies_to(self, cameras: Sequence[Cameras]) -> list[Cameras]:
        """Those cameras whose frames it can estimate depth of."""
        return [camera for camera in cameras if camera.have_parallax or not self.needs_parallax]


def add_depth(
    root: Path, cameras: Sequence[Cameras], method: DepthMethod, weights: Path | None, quiet: bool
) -> tuple[str, list[str]]:
    """Estimates the depth of a capture's frames and writes it, with the contact sheet depth.png.

    Args:
        root: Folder of the capture.
        cameras: The frames of each camera that the capture was written with.
        method: How to estimate depth.
        weights: Folder with the networks' weights; None for the Hugging Face cache.
        quiet: Whether to show no progress.

    Returns:
        A summary, and notes: the frames without any known depth.

    Raises:
        OSError: If a file cannot be written; the message names it.
    """
    known: dict[str, float] = {}
    sheets, folder, chosen = [], find_weights(method.network, weights), method.applies_to(cameras)
    for camera in chosen:
        planes = _estimated(root, camera, method, folder, quiet)
        for name, plane in zip(camera.names, planes, strict=True):
            write_depth(root, name, as_half(plane))
            known[name] = float(np.isfinite(plane).mean())
        if len(cameras) == 1 and not camera.have_parallax:
            _place_points(root, camera, planes)
        shown = choose_evenly(len(planes), len(chosen))
        sheets.append({camera.names[k]: colored_depth(planes[k]) for k in shown})
    if not chosen:
        return "none, because no camera moves", []
    write_contact_sheet(root / "depth.png", sheets)
    whose = " of the cameras that move" if len(chosen) < len(cameras) else ""
    unknown = [name for name, fraction in known.items() if fraction == 0.0]
    notes = [f"depth is unknown everywhere in {few_of(unknown)}"] if unknown else []
    return f"known on {np.mean([*known.values()]):.0%} of the pixels{whose}", notes


def _estimated(root: Path, camera: Cameras, method: DepthMethod, folder: Path | None, quiet: bool) -> Planes:
    """Inverse depth of a camera's frames, of panoramas the inverse distance from six views."""
    images = root / "rgb/1x"
    if not camera.lens.is_panorama:
        frames = load_posed_frames(images, camera, MAX_SIDE, max_factor=1.0)
        dynamic = _dynamic_masks(root, camera, (frames.lens.width, frames.lens.height))
        planes = method.estimate(frames, dynamic, folder, quiet)
        return planes if frames.shown is None else [np.where(frames.shown, plane, np.nan) for plane in planes]
    size, views = (camera.lens.width, camera.lens.height), []
    for turn, frames in zip(TURNS, views_of(images, camera, MAX_SIDE // 2), strict=True):
        masks = _dynamic_masks(root, camera, size)
        dynamic = (cut(mask.astype(np.float32), turn, frames.lens) > 0.0 for mask in masks)
        slant = np.sqrt(np.square(frames.rays).sum(-1) + 1.0)
        views.append([plane / slant for plane in method.estimate(frames, dynamic, folder, quiet)])
    return joined(views, size, cv2.INTER_NEAREST)


def depth_files(root: Path, names: Sequence[str]) -> list[Path]:
    """The files with the depth of frames that ``add_depth`` writes."""
    return [root / f"depth/1x/{name}.npy" for name in names]


def _place_points(root: Path, cameras: Cameras, planes: Planes) -> None:
    """Writes the points of a camera that stays at one place as far away as its depth says, if it says anything."""
    masks = list(_dynamic_masks(root, cameras, (cameras.lens.width, cameras.lens.height)))
    points = points_around(cameras, masks, planes)
    if len(points):
        write_world(root, points, cameras.poses)


def _dynamic_masks(root: Path, cameras: Cameras, size: tuple[int, int]) -> Iterator[Bool[np.ndarray, "H W"]]:
    """The capture's masks, resized to ``size`` (width, height)."""
    for name in cameras.names:
        static = read_mask(root / f"resized_mask/1x/{name}.png.png", (cameras.lens.width, cameras.lens.height))
        yield cv2.resize((~static).astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0


def as_half(inverse_depth: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """[H, W] inverse depth as half floats, divided by its median to stay in their range.

    Depth of a capture is defined up to scale and offset, so the divisor is not stored.
    """
    known = inverse_depth[np.isfinite(inverse_depth)]
    scale = (float(np.median(known)) if len(known) else 0.0) or 1.0  # a network may predict infinite depth everywhere
    return np.minimum(inverse_depth / scale, MAX_HALF).astype(np.float16)
