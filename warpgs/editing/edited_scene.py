"""The scene of a run with its edits: objects are changed and Gaussians removed in a copy in memory."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from scipy.spatial import cKDTree
from torch import Tensor

from warpgs.data.capture import Capture
from warpgs.runs.trained import TrainedScene
from warpgs.video.camera_paths import evenly_spaced

from .contribution import Contribution, contribution, sample_cameras, weakest
from .edits_file import NAME, check, edits_in_use, save_edits
from .object_scene import ObjectScene, number_of, with_boxes, with_objects
from .objects import Objects, find_objects, stored_objects
from .options import Box, Editing, Edits, split_names

NUM_TIMES = 9
"""Number of times at which positions and opacities are looked at."""

FLOATERS = 0.003
"""Maximum part of all blend weights that floaters hold together."""

NUM_NEIGHBORS = 16
MIN_ISOLATION = 1.5
"""Isolation from which a Gaussian is isolated (``isolation``)."""

NOTHING = Edits()
"""No edits."""

Opened = Callable[[], Capture | None]
"""Opens the capture of a run; None if it cannot be opened."""


def with_edits(
    scene: TrainedScene,
    folder: Path,
    editing: Editing,
    open_capture: Opened,
    quiet: bool = True,
    numbered: bool = False,
) -> tuple[TrainedScene, list[str]]:
    """A scene with the edits that are in use, which are saved if the options ask for it; and lines about them.

    Args:
        scene: Of the newest checkpoint; not changed.
        folder: Its run folder.
        editing: The options.
        open_capture: Opens the capture; called only if an edit needs the training cameras.
        quiet: Whether to hide the progress bar.
        numbered: Whether its splats are to have the numbers of their objects in any case.

    Raises:
        ValueError: As ``edits_in_use``, ``stored_objects`` and ``edited``.
        OSError: If edits cannot be saved.
    """
    edits, original = edits_in_use(folder, editing, scene), scene
    before, notes = _number(scene), list[str]()
    if numbered or edits.about_objects:
        scene, notes = with_ids(scene, folder, edits)
    if edits != NOTHING:
        capture = open_capture() if edits.drop_floaters or edits.max_gaussians is not None else None
        scene = edited(scene, edits, capture, quiet)
        saved = f", with those of {folder / NAME}" if editing.edits is None and (folder / NAME).exists() else ""
        notes.append(f"edits keep {_number(scene):,} of {before:,} Gaussians{saved}")
    if editing.save_edits:
        notes.append(f"edits saved as {save_edits(folder, editing, edits, original)}")
    return scene, notes


def with_ids(scene: TrainedScene, folder: Path, edits: Edits = NOTHING) -> tuple[TrainedScene, list[str]]:
    """A scene whose splats know their objects, and lines about these; a sequence of files has none.

    Args:
        scene: Of the newest checkpoint, which may know them already.
        folder: Its run folder.
        edits: The boxes of static objects, for the lines; ``edited`` adds them to the scene.

    Raises:
        ValueError: As ``stored_objects`` and ``with_boxes``.
    """
    if scene.varies:
        return scene, []
    notes = []
    if not isinstance(scene, ObjectScene):
        ids, note = stored_objects(scene, folder)
        scene, notes = with_objects(scene, with_boxes(ids, scene, ()), NOTHING), [note] if note else []
    if scene.scene.num_segments > 1:
        notes.append("each segment of time has numbers of its own: name all that an object has")
    return scene, [f"objects: {with_boxes(scene.of_dynamic, scene, edits.box)}", *notes]


def edited(scene: TrainedScene, edits: Edits, capture: Capture | None = None, quiet: bool = True) -> TrainedScene:
    """A scene with changed objects and without the Gaussians that edits remove; the same one if nothing changes.

    Args:
        scene: Not changed. One of ``with_ids`` is asked for its objects; those of others are found.
        edits: What to change and to remove.
        capture: Its training cameras see how much each Gaussian contributes. Without it, default cameras do so for
            ``max_gaussians``.
        quiet: Whether to hide the progress bar.

    Raises:
        ValueError: If an edit is out of its range, names an unknown object, removes all Gaussians, or needs a capture.
    """
    check(edits)
    if scene.varies and edits != NOTHING:
        raise ValueError("a sequence of files cannot be edited: edit its files one by one")
    kept = _not_erased(scene, edits)
    if edits.about_objects:
        ids = scene.of_dynamic if isinstance(scene, ObjectScene) else find_objects(scene)
        objects = with_boxes(ids, scene, edits.box)
        scene = changed = with_objects(scene, objects, edits)
        kept &= _of_objects(changed, objects, edits)
    scene = _kept(scene, kept)
    if edits.crop is not None or edits.min_opacity is not None:
        scene = _kept(scene, _inside_and_opaque(scene, edits))
    if not edits.drop_floaters and (edits.max_gaussians is None or _number(scene) <= edits.max_gaussians):
        return scene
    if edits.drop_floaters and capture is None:
        raise ValueError("--drop-floaters needs the training cameras, but the capture cannot be opened")
    contributions = contribution(scene, sample_cameras(scene, capture), quiet)
    kept = torch.ones_like(contributions.total, dtype=torch.bool)
    if edits.drop_floaters:
        kept &= ~floaters(scene, contributions)
    if edits.max_gaussians is not None:
        order = torch.where(kept, contributions.total, -1.0).sort(descending=True, stable=True).indices
        kept[order[edits.max_gaussians :]] = False
    return _kept(scene, kept)


def floaters(scene: TrainedScene, contributions: Contribution) -> Bool[Tensor, " N"]:
    """Which Gaussians are floaters: isolated, and seen by few cameras or little by them.

    They hold less than ``FLOATERS`` of all blend weights together, and are isolated at the start, the middle and the
    end.
    """
    times = evenly_spaced(3) if len(scene.scene.dynamic) else [0.0]
    least = np.minimum.reduce([isolation(scene.splats(time).means.cpu().numpy()) for time in times])
    isolated = torch.from_numpy(least > MIN_ISOLATION).to(scene.device)
    return isolated & weakest(contributions.total, FLOATERS)


def isolation(points: np.ndarray) -> np.ndarray:
    """[N] how far each of [N, 3] points is from its neighbours, relative to how far these are from theirs.

    The mean distance to the ``NUM_NEIGHBORS`` nearest points over the median of the same of these points: a local
    outlier factor (Breunig et al. 2000), about 1 in regions of any density. At most as many points have no neighbours
    to compare: theirs is 1.
    """
    finite = np.isfinite(points).all(1)
    if not finite.all():  # which the search for neighbours refuses; such Gaussians are never drawn
        found = np.ones(len(points))
        found[finite] = isolation(points[finite])
        return found
    if len(points) <= NUM_NEIGHBORS:
        return np.ones(len(points))
    distances, neighbors = cKDTree(points).query(points, NUM_NEIGHBORS + 1)
    own = distances[:, 1:].mean(1)
    around = np.median(own[neighbors[:, 1:]], axis=1)
    return np.where(own > 0, own / np.maximum(around, np.finfo(np.float64).tiny), 0.0)


def _inside_and_opaque(scene: TrainedScene, edits: Edits) -> Bool[Tensor, " N"]:
    """Which Gaussians are inside of the box at any time, and as opaque as they have to be at any time."""
    inside = torch.zeros(_number(scene), dtype=torch.bool, device=scene.device)
    opacities = torch.zeros_like(inside, dtype=torch.float32)
    low, high = _corners(edits.crop, scene.device)
    for time in evenly_spaced(NUM_TIMES):
        splats = scene.splats(time)
        inside |= ((splats.means >= low) & (splats.means <= high)).all(1)
        opacities = opacities.maximum(splats.opacities)
    return inside & (opacities >= (edits.min_opacity or 0.0))


def _not_erased(scene: TrainedScene, edits: Edits) -> Bool[Tensor, " N"]:
    """Which Gaussians are not selected to be removed."""
    kept = torch.ones(_number(scene), dtype=torch.bool, device=scene.device)
    if edits.erased is not None:
        if edits.erased.size != len(kept):
            raise ValueError(f"edits erase some of {edits.erased.size:,} Gaussians, but the scene has {len(kept):,}")
        kept &= ~torch.from_numpy(edits.erased.mask).to(scene.device)
    return kept


def _of_objects(scene: ObjectScene, objects: Objects, edits: Edits) -> Bool[Tensor, " N"]:
    """Which Gaussians belong to the objects to keep."""
    kept = torch.ones_like(scene.ids, dtype=torch.bool)
    for option, names, stays in (("objects", edits.objects, True), ("remove", edits.remove, False)):
        if names is not None:
            numbers = [number_of(objects, option, name) for name in split_names(names)]
            kept &= torch.isin(scene.ids, torch.tensor(numbers, device=scene.device)) == stays
    return kept


def _corners(crop: Box | None, device: torch.device) -> tuple[Tensor, Tensor]:
    """The lowest and the highest corner of a box; of all space without one."""
    corners = torch.tensor(crop or (*[-torch.inf] * 3, *[torch.inf] * 3), dtype=torch.float32, device=device).view(2, 3)
    return corners.amin(0), corners.amax(0)


def _kept(scene: TrainedScene, kept: Bool[Tensor, " N"]) -> TrainedScene:
    """The scene with the Gaussians to keep; the same one if these are all."""
    if kept.all():
        return scene
    if not kept.any():
        means = scene.splats(0.5).means.cpu().numpy()
        low, high = (" ".join(f"{v:.3g}" for v in np.nanquantile(means, q, axis=0)) for q in (0.01, 0.99))
        raise ValueError(f"edits leave no Gaussian; most have their centres between {low} and {high}")
    return scene.select(kept)


def _number(scene: TrainedScene) -> int:
    return len(scene.scene.static) + len(scene.scene.dynamic)
