"""COLMAP: a model in sparse/0 (text or binary) beside images/, as 3DGS, gsplat and nerfstudio's tools write it."""

from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from warpgs.data.capture import Capture
from warpgs.data.colmap import ModelImage, load_model
from warpgs.data.colmap_folders import PLACES, find_models, largest_model
from warpgs.data.images import read_depth
from warpgs.data.resized import read_resized_image, read_resized_mask
from warpgs.files import natural_order

from .listed import ListedFiles, find_file, without_image_suffix
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
from .turned import turning_notes

MASKS, DEPTHS = "masks", "depths"
"""Folders of the static masks (white = static) and of inverse depth up to scale and offset."""


class ColmapLoader:
    """Loads a COLMAP model and its images; times from the file names, every eighth frame for evaluation."""

    def recognizes(self, root: Path) -> bool:
        """Whether there are a model and a folder of images, but not another program's index."""
        others = ("dataset.json", "transforms.json", "transforms_train.json")
        has_model = any(model.has_images for model in find_models(root))
        return has_model and not any((root / other).exists() for other in others)

    def load(self, root: Path, options: LoadOptions) -> Capture:
        """Opens a capture; errors as for ``load_with``."""
        found, notes = largest_model(root)
        if found is None:
            raise ValueError(f"{root} has no folder images/ with a COLMAP model in {PLACES}")
        model = load_model(found.folder)
        files = _Files(found.part, options.factor or 1)
        images = sorted(model.images, key=lambda image: natural_order(files.stored_name(image)))
        stored_names = [files.stored_name(image) for image in images]
        names = plain_names(stored_names)
        times, source, _, cameras = times_of_names(stored_names)
        cameras = cameras if any(cameras) else _cameras(images)
        notes += model.notes
        if found.part != root:
            notes += _unused(root, found.part)
        frames = [files.frame(*found) for found in zip(names, images, times, cameras, strict=True)]
        reason = f"the model in {found.shown(root)} has no pose for them"
        notes += turning_notes(files.used, [(image.lens.width, image.lens.height) for image in images])
        notes += [*files.images.notes, *skipped_images(root, files.used, reason, files.folder)]
        world = World(model.points, model.colors, time_source=source, notes=notes)
        return posed_capture(root, frames, every_eighth(names), world, options)


class _Files:
    """The images of a capture and what lies beside them; images_<factor>/ is used if it exists."""

    def __init__(self, root: Path, factor: int) -> None:
        reduced = root / f"images_{factor}"
        self.folder = reduced if factor > 1 and reduced.is_dir() else root / "images"
        self.images = ListedFiles(self.folder, "the COLMAP model")
        self.masks, self.depths = root / MASKS, root / DEPTHS
        self.used: list[Path] = []

    def _path(self, image: ModelImage) -> Path:
        path = self.images.find(image.name, is_image=True)
        if path is None:
            raise ValueError(self.images.missing(image.name, "the COLMAP model has a camera for it"))
        return path

    def stored_name(self, image: ModelImage) -> str:
        """The name of an image as the folder spells it; raises as ``frame``."""
        self._path(image)
        return self.images.as_stored(image.name)

    def frame(self, name: str, image: ModelImage, time: float, camera: int) -> PosedFrame:
        """A frame of the model.

        Raises:
            ValueError: If its image is missing.
        """
        path = self._path(image)
        self.used.append(path)
        stem = without_image_suffix(image.name)
        mask = _first(self.masks, f"{image.name}.png", f"{stem}.png")
        depth = _first(self.depths, f"{stem}.npy", f"{stem}.png")
        return PosedFrame(
            name,
            image.lens,
            image.pose,
            time,
            partial(read_resized_image, path),
            None if mask is None else partial(read_resized_mask, mask, image=path),
            None if depth is None else partial(read_depth, depth, image=path),
            camera,
        )


def _cameras(images: Sequence[ModelImage]) -> list[int]:
    """The camera of each image by that of the model, as in rigs; all 0 if one has a single image.

    COLMAP may give every image of a video a camera of its own.
    """
    counts = Counter(image.camera for image in images)
    numbers = {i: k for k, i in enumerate(sorted(counts))}
    return [numbers[image.camera] if min(counts.values()) > 1 else 0 for image in images]


def _unused(root: Path, part: Path) -> list[str]:
    """Notes on masks and depth of the original images, where undistorted ones are read."""
    names = [name for name in (MASKS, DEPTHS) if (root / name).is_dir() and not (part / name).is_dir()]
    place = part.relative_to(root)
    return [f"{name} is skipped: {place}/images is read with {place}/{name}" for name in names]


def _first(folder: Path, *names: str) -> Path | None:
    """The file of the first of some names in a folder; None if it has none of them."""
    return next((path for name in names if (path := find_file(folder, name))), None)
