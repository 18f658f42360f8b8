"""Writes captures in the layout of NeRF-DS, as ``loaders`` reads them.

One function per part: images, masks, depth and camera of each frame, then the scene, then the index. The index comes
last, because its dataset.json makes the folder a capture. Each raises an OSError that names a file it cannot write.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from warpgs.files import write_array, write_json, write_png

from .capture import Side
from .lens import Lens
from .units import SceneUnits

LAYOUT = "nerfds"
"""Loader of what is written here, which dataset.json names."""

WORK, STATE, FINISHED = ".prepare", "state.json", "finished"
"""Folder in a capture for the intermediate files of ``warpgs prepare``, file in it with the steps done, and the last of
these steps."""

REPORT = "prepare.json"
"""Report of ``warpgs prepare`` in a finished capture: options, result and seconds of every step, notes."""

GIVEN, ESTIMATED = "given", "estimated"
"""What dataset.json says of the masks, see ``Capture.estimated_masks``."""


MAX_ID_BYTES = 200
"""Maximum length of an id that is written: file systems allow names of 255 bytes, with suffixes and while they are
written."""


MAX_STEPS = 10**6
"""Time steps from the first to the last frame, unless fewer represent all times."""


def is_plain_id(name: str) -> bool:
    """Whether a frame can have this id: it is one plain file name, and does not begin with a dot."""
    return bool(name) and not name.startswith(".") and not any(character in name for character in "/\\\0")


def plain_ids(names: Sequence[str]) -> dict[str, str]:
    """The id under which each of some distinct frames is written: its name, as far as files can have it everywhere."""
    ids: dict[str, str] = {}
    taken = {name for name in names if _portable(name) == name}
    for name in names:
        stem = _portable(name)
        copies = (stem, *(f"{stem}_{k}" for k in range(2, len(names) + 2)))
        ids[name] = name if stem == name else next(found for found in copies if found not in taken)
        taken.add(ids[name])
    return ids


def _portable(name: str) -> str:
    """The name without leading dots, trailing spaces and dots, slashes and control characters, and not too long."""
    kept = "".join(c if c.isprintable() and c not in "/\\" else "_" for c in name).lstrip(". ").rstrip(". ")
    return kept.encode(errors="replace")[:MAX_ID_BYTES].decode(errors="ignore") or "frame"


def write_image(root: Path, name: str, image: UInt8[np.ndarray, "H W 3"], factors: Sequence[int] = (1,)) -> None:
    """Writes rgb/<factor>x/<name>.png for every downscaling factor."""
    for factor in factors:
        size = _reduced_size(image, factor)
        write_png(root / f"rgb/{factor}x/{name}.png", cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def write_mask(root: Path, name: str, static_mask: Bool[np.ndarray, "H W"], factors: Sequence[int] = (1,)) -> None:
    """Writes resized_mask/<factor>x/<name>.png.png for every downscaling factor: 0 = dynamic, 255 = static.

    A pixel of a reduced mask is dynamic if any part of it is.
    """
    dynamic = np.where(static_mask, 0, 255).astype(np.uint8)
    for factor in factors:
        static = cv2.resize(dynamic, _reduced_size(dynamic, factor), interpolation=cv2.INTER_AREA) == 0
        write_png(root / f"resized_mask/{factor}x/{name}.png.png", static.astype(np.uint8) * 255)


def write_covisible(root: Path, name: str, covisible: Bool[np.ndarray, "H W"], factors: Sequence[int] = (1,)) -> None:
    """Writes covisible/<factor>x/val/<name>.png for every downscaling factor: 255 where masked metrics are computed."""
    for factor in factors:
        bright = covisible.astype(np.uint8) * 255
        reduced = cv2.resize(bright, _reduced_size(bright, factor), interpolation=cv2.INTER_AREA) == 255
        write_png(root / f"covisible/{factor}x/val/{name}.png", reduced.astype(np.uint8) * 255)


def write_depth(root: Path, name: str, inverse_depth: Shaped[np.ndarray, "H W"]) -> None:
    """Writes inverse depth, up to a scale and an offset: 8 or 16 bits as depth/1x/<name>.png, floats as .npy."""
    if inverse_depth.dtype.kind == "f":
        write_array(root / f"depth/1x/{name}.npy", inverse_depth)
    else:
        write_png(root / f"depth/1x/{name}.png", inverse_depth)


def write_camera(
    root: Path, name: str, lens: Lens, rotation: Float[np.ndarray, "3 3"], position: Float[np.ndarray, "3"]
) -> None:
    """Writes camera/<name>.json.

    Args:
        root: Folder of the capture.
        name: Id of the frame.
        lens: Intrinsics of the image in full size.
        rotation: [3, 3] world-to-camera rotation, OpenCV axes.
        position: [3] camera centre in the world.
    """
    k = [*lens.coefficients, *[0.0] * 12][:12]
    radial: dict[str, object] = {
        "radial_distortion": [k[0], k[1], k[4]],
        "tangential_distortion": k[2:4],
        **({"rational_distortion": k[5:8]} if any(k[5:8]) else {}),
        **({"prism_distortion": k[8:]} if any(k[8:]) else {}),
    }
    distortions: dict[str, dict[str, object]] = {
        "radial": radial,
        "fisheye": {"fisheye_distortion": k[:4]},
        "equirectangular": {"equirectangular": True},
    }
    fields = {
        "orientation": rotation.tolist(),
        "position": position.tolist(),
        "focal_length": lens.focal[0],
        "principal_point": lens.center,
        "skew": 0.0,
        "pixel_aspect_ratio": lens.focal[1] / lens.focal[0],
        **distortions[lens.model],
        "image_size": [lens.width, lens.height],
    }
    write_json(root / f"camera/{name}.json", fields)


def write_scene(
    root: Path,
    units: SceneUnits,
    points: Float[np.ndarray, "P 3"],
    near: float,
    far: float,
    colors: UInt8[np.ndarray, "P 3"] | None = None,
) -> None:
    """Writes scene.json, points.npy if there are points, and point_colors.npy if they have colours.

    Args:
        root: Folder of the capture.
        units: Scene units of the capture.
        points: [P, 3] sparse static points in the world.
        near, far: Depth range [scene units].
        colors: [P, 3] 8-bit RGB of the points; None if unknown.
    """
    bbox = [[-1, -1, -1], [1, 1, 1]]
    scene = {"center": units.center.tolist(), "scale": units.scale, "bbox": bbox, "near": near, "far": far}
    write_json(root / "scene.json", scene)
    if len(points):
        write_points(root, points, colors)


def write_points(root: Path, points: Float[np.ndarray, "P 3"], colors: UInt8[np.ndarray, "P 3"] | None = None) -> None:
    """Writes points.npy, and point_colors.npy if the points have colours; see ``write_scene``."""
    write_array(root / "points.npy", points)
    if colors is not None:
        write_array(root / "point_colors.npy", colors)


def held_out(names: Sequence[str], holdout: int) -> list[str]:
    """The frames kept for evaluation: every N-th in time, from the middle of the first N on; none if N is 0.

    Raises:
        ValueError: If N is negative or 1, or keeps none of the frames.
    """
    check_holdout(holdout)
    if holdout // 2 >= len(names):
        raise ValueError(f"--holdout {holdout} keeps none of {len(names)} frames for evaluation")
    return list(names[holdout // 2 :: holdout]) if holdout else []


def held_out_of(by_camera: Mapping[int, Sequence[str]], holdout: int, ids: Collection[int]) -> list[str]:
    """The frames kept for evaluation: all of some cameras, and every N-th of each other one.

    Args:
        by_camera: Frames of each camera, in time, as of ``Capture.by_camera``.
        holdout: N; 0 for none.
        ids: Ids of the cameras that are held out as a whole.

    Raises:
        ValueError: As ``held_out``; or if there is no such camera, or no other one.
    """
    for i in ids:
        if i not in by_camera:
            raise ValueError(f"--holdout-camera {i}: there are only the cameras {', '.join(map(str, by_camera))}")
    if ids and {*ids} == {*by_camera}:
        raise ValueError(f"--holdout-camera {' '.join(map(str, ids))} leaves no camera to train on")
    return [name for i, names in by_camera.items() for name in (names if i in ids else held_out(names, holdout))]


def check_holdout(holdout: int) -> None:
    """Checks that every N-th frame can be kept for evaluation.

    Raises:
        ValueError: If N is negative or 1.
    """
    if holdout < 0 or holdout == 1:
        raise ValueError(f"--holdout must be 0 (none) or at least 2, got {holdout}")


def write_index(
    root: Path,
    times: Mapping[str, int | float],
    val: Collection[str] = (),
    camera_ids: Mapping[str, int] | None = None,
    *,
    estimated_masks: bool = False,
    readout: float = 0.0,
    readout_from: Side = "top",
) -> None:
    """Writes metadata.json, then dataset.json, which makes the folder a capture.

    warp_id and appearance_id are the index of the frame's time among all times.

    Args:
        root: Folder of the capture.
        times: Time of every frame on one clock, in any unit and the order of dataset.json. Whole numbers from 0 on are
            written as they are, others as their ``time_steps``.
        val: Frames to evaluate on; all others are trained on.
        camera_ids: Camera of every frame; all are camera 0 if None.
        estimated_masks: Whether the masks are estimates, see ``Capture.estimated_masks``.
        readout, readout_from: See ``Capture``.
    """
    are_steps = all(time >= 0 and float(time).is_integer() for time in times.values())
    steps = (
        [int(time) for time in times.values()] if are_steps else time_steps([float(time) for time in times.values()])
    )
    index = {step: k for k, step in enumerate(sorted(set(steps)))}
    metadata = {}
    for name, step in zip(times, steps, strict=True):
        camera_id = 0 if camera_ids is None else camera_ids[name]
        metadata[name] = {"time_id": step, "warp_id": index[step], "appearance_id": index[step], "camera_id": camera_id}
    write_json(root / "metadata.json", metadata)
    train_ids, val_ids = ([name for name in times if (name in val) == held_out] for held_out in (False, True))
    counts = {"count": len(times), "num_exemplars": len(train_ids)}
    splits = {"ids": [*times], "train_ids": train_ids, "val_ids": val_ids}
    shutter = {"readout": readout or None, "readout_from": None if readout_from == "top" else readout_from}
    others = {k: v for k, v in {"masks": ESTIMATED if estimated_masks else None, **shutter}.items() if v is not None}
    write_json(root / "dataset.json", {**counts, "layout": LAYOUT, **others, **splits})


def time_steps(times: Sequence[float]) -> list[int]:
    """Whole numbers in proportion to some times, from 0 on: as few as represent all of them, if that is possible."""
    low, high = min(times), max(times)
    distinct = np.unique(times)
    if len(distinct) == 1:
        return [0] * len(times)
    relative = (np.array(times) - low) / (high - low)
    smallest = np.diff(distinct).min() / (high - low)
    fewest = round(1.0 / smallest) if smallest > 1.0 / MAX_STEPS else MAX_STEPS
    exact = np.abs(relative * fewest - (relative * fewest).round()).max() < 0.01
    return (relative * (fewest if exact else MAX_STEPS)).round().astype(int).tolist()


def _reduced_size(image: np.ndarray, factor: int) -> tuple[int, int]:
    """(width, height), rounded as ``camera_files`` rounds it."""
    return round(image.shape[1] / factor), round(image.shape[0] / factor)
