"""``warpgs bench``."""

from warpgs.command_line.screen import show

from .options import Bench
from .run_bench import run_bench


def run(options: Bench) -> None:
    """Measures and prints the results; raises as ``run_bench``."""
    for path in run_bench(options):
        show(f"wrote {path}")
