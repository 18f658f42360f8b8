"""NeRF-DS: full-size images with masks, one training and one evaluation camera; and what tells it from HyperNeRF."""

from pathlib import Path

from warpgs.data.writer import REPORT
from warpgs.files import read_json

from .nerfies import NerfiesLoader

RELEASED_SIZES = {(480, 270): "nerfds", (1072, 1920): "hypernerf"}
"""Full size of the images as released: those of NeRF-DS (CVMI-Lab/SC-GS, issue 24), and nearly all of HyperNeRF
(google/hypernerf, issue 59)."""

RELEASED_FOLDERS = ("train_camera", "vrig_camera")
"""Folders of cameras that captures of NeRF-DS have beside camera/, as its README lists them."""


class NerfDsLoader(NerfiesLoader):
    """Loads captures of NeRF-DS: factor 1, split by train_ids and val_ids."""

    default_factor = 1

    def recognizes(self, root: Path) -> bool:
        """Whether images have the full size only, its origin has this layout, or else masks have the full size.

        HyperNeRF's captures have images of a quarter of the size and more; masks that were added to them in several
        sizes do not make them captures of NeRF-DS.
        """
        if not (root / "rgb/1x").is_dir():
            return False
        if not (root / "rgb/2x").is_dir():
            return True
        if (origin := _origin(root)) is not None:
            return origin == "nerfds"
        masks = _mask_sizes(root)
        return "1x" in masks and (masks == {"1x"} or not (root / "rgb/4x").is_dir())


def is_ambiguous(root: Path) -> bool:
    """Whether a capture may be of NeRF-DS or of HyperNeRF, whose files have one layout: images and masks in several
    sizes fit both, it is not as either was released, and ``warpgs prepare`` did not write it."""
    has_sizes = all((root / f"rgb/{size}").is_dir() for size in ("1x", "2x"))
    return has_sizes and "1x" in _mask_sizes(root) and _origin(root) is None


def _mask_sizes(root: Path) -> set[str]:
    return {path.name for path in (root / "resized_mask").glob("*x")}


def _origin(root: Path) -> str | None:
    """The layout by who made the capture: ``warpgs prepare``, NeRF-DS or HyperNeRF; None if nothing shows it."""
    if (root / REPORT).is_file():  # version 0.2 of prepare named no layout in dataset.json
        return "nerfds"
    if any((root / folder).is_dir() for folder in RELEASED_FOLDERS):
        return "nerfds"
    camera = next((root / "camera").glob("*.json"), None)
    try:
        size = None if camera is None else read_json(camera).get("image_size")
    except ValueError:  # the loader reports it
        return None
    return next((name for released, name in RELEASED_SIZES.items() if size == [*released]), None)
