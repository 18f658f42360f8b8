"""Options of ``warpgs sweep``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.config import NetName
from warpgs.errors import require_present, suggestion

FOLDER = Path(__file__).parent / "sweeps"
"""The sweeps that ship, as <name>.toml."""


def shipped() -> list[str]:
    """Names of the sweeps that ship."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def file_of(name: str) -> Path:
    """The file of a sweep that ships, by its name, or a TOML file.

    Raises:
        ValueError: If no sweep has this name.
    """
    if name.endswith(".toml"):
        return Path(name)
    if name not in shipped():
        known = f"{', '.join(shipped())} or a .toml file"
        raise ValueError(f"there is no sweep {name!r}, expected {known}{suggestion(name, shipped())}")
    return FOLDER / f"{name}.toml"


@dataclass(frozen=True)
class Sweep:
    """Trains every variant on every capture with every seed, on this machine or a Ray cluster; writes the tables.

    Each training is a run folder of its own. After Ctrl-C, SIGTERM or an error, the same command continues. Exit code 1
    if a training failed twice. Needs Ray, which the extra sweep installs (docs/cluster.md).
    """

    sweep: Annotated[str, tyro.conf.arg(metavar="SWEEP"), tyro.conf.Positional]
    """What to train: ablation (paper, Table 4), masks (Table 5), scenes (Tables 1 to 3), best (what each part of that
    preset brings), seeds, depth, or a TOML file (docs/cluster.md)."""
    data: Annotated[tuple[str, ...], tyro.conf.arg(metavar="CAPTURE [CAPTURE ...]")] = ()
    """Captures, folders of captures, or built-in captures (builtin:studio); NAME=CAPTURE gives one a name."""
    out: Path | None = None
    """Folder of the sweep; runs/sweep-<sweep> by default."""
    seeds: int | None = None
    """Number of seeds, from 0 on; by default those of the sweep."""
    preset: str | None = None
    """Preset of every training; by default the sweep's."""
    iterations: int | None = None
    """Iterations of every training; by default the preset's."""
    factor: int | None = None
    """Downscaling factor of the images; the dataset's default if omitted."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS; finished trainings without LPIPS are evaluated again."""
    lpips_net: NetName | None = None
    """Network of LPIPS; vgg by default."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to train on; CUDA by default if there is a GPU."""
    per_gpu: int = 1
    """Number of trainings that share a GPU; small captures do not fill one."""
    cpus: int | None = None
    """Cores of each training; by default an equal share of a node's on a GPU, 2 without."""
    address: str | None = None
    """HOST:PORT of the head of a Ray cluster; by default Ray is started on this machine."""
    compare: Path | None = None
    """JSON file with numbers of other methods, shown beside."""
    tables_only: bool = False
    """Train nothing; write the tables of what is finished."""
    dry_run: bool = False
    """Print the command of every training and end."""

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such sweep."""
        require_present(file_of(self.sweep))
