"""NeRF-DS: full-size images with masks, one training and one evaluation camera."""

from pathlib import Path

from .nerfies import NerfiesLoader


class NerfDsLoader(NerfiesLoader):
    """Loads captures of NeRF-DS: factor 1, split by train_ids and val_ids."""

    default_factor = 1

    def recognizes(self, root: Path) -> bool:
        """Whether masks have the full size, or images have the full size only."""
        full_size = (root / "resized_mask/1x").is_dir() or not (root / "rgb/2x").is_dir()
        return full_size and (root / "rgb/1x").is_dir()
