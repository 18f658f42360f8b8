"""``warpgs render``."""

from warpgs.command_line.screen import show

from .options import Render
from .render_run import render_run


def run(options: Render) -> None:
    """Renders and prints a summary; raises as ``render_run``."""
    show(render_run(options))
