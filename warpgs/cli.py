"""The ``warpgs`` command."""

import importlib.metadata
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from .bench.command import Bench
from .errors import is_out_of_memory, one_line, out_of_memory
from .export.command import Export
from .prepare.command import Check, Prepare
from .report.command import Report
from .runs import run as runs
from .video.command import Render
from .viewer.command import View


@dataclass(frozen=True)
class Eval:
    """Evaluates a run's last iterate; writes metrics.json, views.csv, pictures and a video into its folder."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folder."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS; else the one in WARPGS_LPIPS."""
    device: Literal["cuda", "cpu"] | None = None
    """Where to render; CUDA if there is a GPU."""
    quiet: bool = False
    """Show no progress."""

    def run(self) -> None:
        print(runs.evaluate_run(self.run_folder, lpips=self.lpips, device=self.device, quiet=self.quiet))


COMMANDS: dict[str, Callable[..., Bench | Check | Eval | Export | Prepare | Render | Report | View]] = {
    "bench": Bench,
    "check": Check,
    "eval": Eval,
    "export": Export,
    "prepare": Prepare,
    "render": Render,
    "report": Report,
    "view": View,
}
"""Each command is a dataclass of its options with a method ``run``."""


INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


ADVICE = "free some, or ask for less: smaller pictures, fewer Gaussians; --device cpu where a GPU has too little"
"""What to do without enough memory."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; wrong options and other errors of the user end with one line and exit code 2."""
    if (sys.argv[1:] if arguments is None else list(arguments)) == ["--version"]:
        print(f"warpgs {importlib.metadata.version('warpgs')}")
        return 0
    command = tyro.extras.subcommand_cli_from_dict(COMMANDS, prog="warpgs", description=__doc__, args=arguments)
    try:
        command.run()
    except (ValueError, ImportError, OSError) as error:
        print(f"warpgs: {one_line(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("warpgs: stopped", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        print(f"warpgs: {out_of_memory(error)}; {ADVICE}", file=sys.stderr)
        return 2
    return 0
