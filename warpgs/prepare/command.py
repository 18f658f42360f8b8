"""The command ``warpgs prepare``."""

from warpgs.captures.given import require_given
from warpgs.command_line.screen import show
from warpgs.errors import ending_at_once, terminable

from .options import Prepare, require_source

USED_BY_ADD = ("paths", "add", "tracks", "options", "masks", "depth", "weights", "quiet")
"""Options that mean something with ``--add``."""


def run_prepare(options: Prepare) -> None:
    """Makes a capture, or adds to one; raises as ``prepare`` and ``add_parts``."""
    log = None if options.quiet else show
    if options.add is not None:
        _check_alone(options)
        require_given(options.paths[0])
        with ending_at_once():
            from .add import AddOptions, add_parts
        how = options.options
        parts = AddOptions(options.add.split(","), how.masks, how.depth or "flow", how.weights, options.tracks)
        add_parts(options.paths[0], parts, log)
        return
    if options.tracks is not None:
        raise ValueError("--tracks is for a capture that is there: warpgs prepare CAPTURE --add tracks --tracks FILE")
    if len(options.paths) < 2:
        raise ValueError("prepare needs a source and a folder for the capture, or a capture and --add")
    *sources, root = options.paths
    if not root.exists():  # what was begun may not need its sources any more
        for source in sources:
            require_source(source)
    with ending_at_once():
        from .pipeline import prepare  # imports OpenCV, SciPy and COLMAP
    try:
        with terminable():
            prepare(sources, root, options.options, force=options.force, log=log)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted; run the same command again to continue") from None


def _check_alone(options: Prepare) -> None:
    """Refuses what --add has no use for."""
    if len(options.paths) != 1:
        raise ValueError(f"with --add, give the capture only, got {', '.join(map(str, options.paths)) or 'nothing'}")
    plain = Prepare(options.paths)
    for given, default in (
        (options.options.selection, plain.options.selection),
        (options.options, plain.options),
        (options, plain),
    ):
        for name, value in vars(default).items():
            if name not in USED_BY_ADD and getattr(given, name) != value:
                option = f"--{name.replace('_', '-')}"
                raise ValueError(f"{option} cannot be used with --add, which keeps the frames and cameras")
