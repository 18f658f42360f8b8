"""``warpgs view``."""

from warpgs.command_line.screen import show, show_error
from warpgs.errors import ending_at_once
from warpgs.posix import share_free_memory

from .options import View


def run(options: View) -> None:
    """Serves until Ctrl-C; raises as ``serve``."""
    share_free_memory()  # before there are threads, of which every visit has some of its own
    with ending_at_once():
        from .serve import serve
    serve(options, report=show, warn=show_error)
