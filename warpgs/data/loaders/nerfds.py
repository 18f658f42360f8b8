"""NeRF-DS: full-size images with masks, one training and one evaluation camera."""

from pathlib import Path

from .nerfies import NerfiesLoader


class NerfDsLoader(NerfiesLoader):
    """Loads captures of NeRF-DS: factor 1, split by train_ids and val_ids."""

    default_factor = 1

    def recognizes(self, root: Path) -> bool:
        """Whether masks have the full size, or images have the full size only.

        HyperNeRF's captures have images of a quarter of the size and more; masks that were added to them in several
        sizes do not make them captures of NeRF-DS.
        """
        if not (root / "rgb/1x").is_dir():
            return False
        masks = {path.name for path in (root / "resized_mask").glob("*x")}
        is_hypernerf = (root / "rgb/4x").is_dir() and masks != {"1x"}
        return not (root / "rgb/2x").is_dir() or ("1x" in masks and not is_hypernerf)
