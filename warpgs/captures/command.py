"""The commands ``warpgs check`` and ``warpgs import``."""

import contextlib
import json
import sys

from warpgs.command_line.screen import show

from .check import check_capture
from .import_capture import import_capture
from .options import Check, Import


def run_check(options: Check) -> None:
    """Prints the report.

    Raises:
        SystemExit: With code 1 if the capture is not fit to train on.
    """
    with contextlib.redirect_stdout(sys.stderr):  # OpenEXR prints there what is damaged
        report = check_capture(options.capture, options.dataset, options.factor, options.assume)
    if options.as_json:
        print(json.dumps(report.plain(), indent=2))
    else:
        show(report)
    if not report.is_fit:
        raise SystemExit(1)


def run_import(options: Import) -> None:
    """Copies the capture; raises as ``import_capture``."""
    import_capture(
        options.source,
        options.capture,
        options.dataset,
        factor=options.factor,
        holdout=options.holdout,
        holdout_camera=options.holdout_camera,
        log=None if options.quiet else show,
    )
