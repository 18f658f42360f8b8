"""Options of ``warpgs download``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Download:
    """Downloads public captures as DATASET/SCENE, ready to train on; without a name, lists them.

    The same command continues after Ctrl-C. Archives stay in the user's cache (~/.cache/warpgs/archives).
    """

    dataset: Annotated[str | None, tyro.conf.arg(metavar="[DATASET]"), tyro.conf.Positional] = None
    """Dataset; without one, all datasets and scenes are listed."""
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="[SCENE]"), tyro.conf.Positional] = ()
    """Scenes of it; all by default."""
    to: Path = Path()
    """Folder for the folder of the dataset; the current one by default."""
