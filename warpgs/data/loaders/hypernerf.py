"""HyperNeRF: captures of two cameras (vrig-*) and interpolation captures of one camera."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from warpgs.data.capture import Capture
from warpgs.files import read_json

from .nerfies import LAYOUT, NerfiesLoader, Split, read_ids
from .options import LoadOptions


class HyperNerfLoader(NerfiesLoader):
    """Loads captures of HyperNeRF: factor 2, split by train_ids and val_ids, else by every fourth frame."""

    default_factor = 2

    def load(self, root: Path, options: LoadOptions, incomplete_masks: bool = False) -> Capture:
        """Opens a capture; Deformable-3DGS, without distortion, reads those of two cameras at a factor of 4."""
        if options.factor is None and not options.distortion and self.is_vrig(root):
            options = replace(options, factor=4)
        return super().load(root, options, incomplete_masks)

    def is_vrig(self, root: Path) -> bool:
        """Whether a capture is of two cameras, of which one trains and the other evaluates."""
        path = root / "dataset.json"
        dataset = read_json(path, LAYOUT)
        train, val = read_ids(path, dataset, "train_ids"), read_ids(path, dataset, "val_ids")
        return bool(val) and not set(train) & set(val)

    def recognizes(self, root: Path) -> bool:
        """Whether there are images of half the size."""
        return (root / "rgb/2x").is_dir()

    def split(self, root: Path, dataset: dict[str, Any], metadata: dict[str, Any]) -> Split:
        """train_ids and val_ids; of an interpolation capture every fourth frame and those halfway between them."""
        split = super().split(root, dataset, metadata)
        if self.is_vrig(root):
            return split
        ids = read_ids(split.source, dataset, "ids") or split.train
        return Split(split.source, ids[::4], ids[2::4])
