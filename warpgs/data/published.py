"""Public datasets whose layouts are read: pages, scenes, and archives for ``warpgs download``.

Addresses of archives are those in download scripts of several public projects. No release publishes a SHA-256 of its
archives, and none was verified: ``warpgs download`` prints the one that it finds, for this table.
"""

import re
from pathlib import Path
from typing import NamedTuple


class Release(NamedTuple):
    """A .zip file at a fixed address.

    Attributes:
        address: Its address.
        scenes: Names of the captures in it, in the order of papers.
        suffix: End of the names of their folders in it, after the name of the scene. The folder of a single scene may
            have any name.
        sha256: Its SHA-256 in hexadecimal digits; None if it is not known.
    """

    address: str
    scenes: tuple[str, ...]
    suffix: str = ""
    sha256: str | None = None


class Published(NamedTuple):
    """A public dataset.

    Attributes:
        title: Its name.
        address: Page that says how to download it.
        parts: Its names in paths, of lower-case letters and digits alone; downloads are in a folder of the first.
        releases: Its archives; without any, it must be downloaded by hand.
        by_hand: Where its files are and go then.
    """

    title: str
    address: str
    parts: tuple[str, ...]
    releases: tuple[Release, ...] = ()
    by_hand: str = ""

    @property
    def name(self) -> str:
        return self.parts[0]

    @property
    def scenes(self) -> tuple[str, ...]:
        """Scenes that can be downloaded."""
        return tuple(scene for release in self.releases for scene in release.scenes)


HYPERNERF = "https://github.com/google/hypernerf/releases"
HYPERNERF_SCENES = {
    "vrig": ("broom", "3dprinter", "chicken", "peel-banana"),
    "interp": ("aleks-teapot", "chickchicken", "cut-lemon", "hand", "slice-banana", "torchocolate"),
    "misc": ("americano", "cross-hands", "espresso", "keyboard", "oven-mitts", "split-cookie", "tamping"),
}

PUBLISHED = (
    Published(
        "NeRF-DS",
        "https://github.com/JokerYan/NeRF-DS/releases/tag/v0.1-pre-release",
        ("nerfds",),
        (
            Release(
                "https://github.com/JokerYan/NeRF-DS/releases/download/v0.1-pre-release/NeRF-DS.dataset.zip",
                ("as", "basin", "bell", "cup", "plate", "press", "sieve"),
                "_novel_view",
            ),
        ),
    ),
    Published(
        "HyperNeRF",
        f"{HYPERNERF}/tag/v0.1",
        ("hypernerf",),
        tuple(
            Release(f"{HYPERNERF}/download/v0.1/{kind}_{scene}.zip", (scene,))
            for kind, scenes in HYPERNERF_SCENES.items()
            for scene in scenes
        ),
    ),
    Published(
        "Nerfies",
        "https://github.com/google/nerfies/releases/tag/0.1",
        ("nerfies",),
        (
            Release(
                "https://github.com/google/nerfies/releases/download/0.1/nerfies-vrig-dataset-v0.1.zip",
                ("broom", "curls", "tail", "toby-sit"),
            ),
        ),
    ),
    Published(
        "D-NeRF",
        "https://github.com/albertpumarola/D-NeRF",
        ("dnerf",),
        (
            Release(
                "https://www.dropbox.com/s/0bf6fl0ye2vz3vr/data.zip?dl=1",
                ("bouncingballs", "hellwarrior", "hook", "jumpingjacks", "lego", "mutant", "standup", "trex"),
            ),
        ),
    ),
    Published(
        "the iPhone dataset of DyCheck",
        "https://github.com/KAIR-BAIR/dycheck/blob/main/docs/DATASETS.md",
        ("iphone", "dycheck"),
        by_hand="each scene is a file in a folder of Google Drive; unpack it so that iphone/SCENE/dataset.json exists",
    ),
    Published(
        "the NVIDIA Dynamic Scene dataset",
        "https://gorokee.github.io/jsyoon/dynamic_synth",
        ("nvidia", "nvidiadynamic", "nvidiadynamicscene", "dynamicscene"),
        by_hand="unpack it so that nvidia/SCENE/poses_bounds.npy and nvidia/SCENE/images exist",
    ),
    Published(
        "the example of NR-NeRF",
        "https://github.com/facebookresearch/nonrigid_nerf",
        ("nonrigidnerf", "nrnerf", "hand"),
        by_hand="it is data/example_sequence of that repository",
    ),
)
"""All of them."""


def words(name: str) -> list[str]:
    """The words of a name, in lower case: nerf and ds of NeRF-DS."""
    return re.findall(r"[^\W_]+", name.lower())


def find_dataset(name: str) -> Published | None:
    """The dataset of a name, however it is written."""
    joined = "".join(words(name))
    return next((dataset for dataset in PUBLISHED if joined in dataset.parts), None)


def dataset_in(path: Path) -> Published | None:
    """The dataset that a path is named after, if any."""
    return next(filter(None, map(find_dataset, reversed(path.parts))), None)
