"""``warpgs eval``."""

from warpgs.command_line.screen import show
from warpgs.runs.run import Run

from .evaluate_run import evaluate_run
from .options import Eval


def run(options: Eval) -> None:
    """Evaluates and prints a summary; raises as ``evaluate_run``."""
    weights, capture = (options.lpips, options.lpips_net), None
    if options.data is not None:
        capture = Run.open(options.run_folder, options.device, options.data).open_capture(options.quiet)
    show(evaluate_run(options.run_folder, capture, weights, options.device, options.quiet))
