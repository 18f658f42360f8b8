"""iPhone (DyCheck): one moving camera with a depth sensor, still cameras for evaluation."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from warpgs.data import images
from warpgs.data.units import SceneUnits
from warpgs.files import read_json

from .nerfies import NerfiesLoader, Split, metadata_field, read_ids

CLAMPED_DEPTH = 3.0
"""DyCheck's processing clamps depth to exactly this value, which is therefore not a measurement [m]."""


class IPhoneLoader(NerfiesLoader):
    """Loads captures of DyCheck: factor 2, split by splits/*.json, depth of the sensor in metres."""

    default_factor = 2

    def recognizes(self, root: Path) -> bool:
        """Whether there is splits/train.json, covisible/<factor>x/val, or depth of camera 0 as .npy.

        DyCheck adds splits, covisibility and extra.json to HyperNeRF's captures too, but names those splits train_mono,
        train_intl, ….
        """
        signs = (root.glob("covisible/*x/val"), root.glob("depth/*x/0_*.npy"))
        return (root / "splits/train.json").is_file() or any(next(sign, None) for sign in signs)

    def split(self, root: Path, dataset: dict[str, Any], metadata: dict[str, Any]) -> Split:
        """splits/train.json and val.json, else train_ids and val_ids, else camera 0 and the other cameras."""
        split = super().split(root, dataset, metadata)
        train_path, val_path = root / "splits/train.json", root / "splits/val.json"
        if train_path.is_file():
            train, val = (read_ids(path, read_json(path), "frame_names") for path in (train_path, val_path))
            return Split(train_path, train, val, "frame_names")
        if split.train:
            return split
        ids = read_ids(split.source, dataset, "ids")
        moving = [metadata_field(metadata, i, "camera_id") == 0 for i in ids]
        train, val = ([i for i, m in zip(ids, moving, strict=True) if m == trained] for trained in (True, False))
        return Split(split.source, train, val)

    def has_metric_depth(self, paths: Iterable[Path]) -> bool:
        """Whether all depth is that of the sensor (.npy), which has the units of the cameras."""
        return all(path.suffix.lower() == ".npy" for path in paths)

    def inverse_depth(
        self, path: Path, size: tuple[int, int], units: SceneUnits, image: Path
    ) -> Float[np.ndarray, "H W"]:
        """Inverse of the sensor's z-depth (.npy), 0 = unknown [1 / scene units]; images hold inverse depth already."""
        values = images.read_depth(path, size, image)
        if path.suffix.lower() != ".npy":
            return values
        known = (values > 0) & (values != CLAMPED_DEPTH)
        metres = np.where(known, values, np.float32(np.nan))
        with np.errstate(over="ignore", divide="ignore"):
            inverse = 1.0 / (metres * np.float32(units.scale))
        inverse[np.isinf(inverse)] = np.nan
        return inverse
