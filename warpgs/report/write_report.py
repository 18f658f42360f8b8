"""``warpgs report``: writes one HTML file about runs."""

import statistics
from collections.abc import Sequence
from pathlib import Path

from warpgs.errors import one_line
from warpgs.files import write_text

from .evaluated_run import EvaluatedRun, groups, read_runs
from .image_strips import Strips, rendered_strips, saved_strips, saved_views
from .options import Report
from .page import Gallery, page


def write_report(options: Report) -> str:
    """Writes the report; returns a summary to print.

    Raises:
        ValueError: If a run cannot be reported on.
        OSError: If the file cannot be written.
    """
    if options.views < 0:
        raise ValueError(f"--views must not be negative, got {options.views}")
    runs = read_runs(options.run_folders)
    galleries = [_gallery(options, runs, group) for group in groups(runs)] if options.views else []
    out = options.out or (options.run_folders[0] if len(runs) == 1 else Path()) / "report.html"
    write_text(out, page(runs, [gallery for gallery in galleries if gallery.worst]))
    return f"{out}: {out.stat().st_size / 1e6:.1f} MB"


def _gallery(options: Report, runs: Sequence[EvaluatedRun], group: Sequence[int]) -> Gallery:
    """Worst and best views of runs that share a capture."""
    chosen = [runs[k] for k in group]
    worst, best = extremes(chosen, options.views)
    strips: list[Strips] = []
    reasons: dict[int, str] = {}
    for k, run in enumerate(chosen):
        try:
            strips.append(rendered_strips(run, [*worst, *best], options.device, options.quiet))
        except (ValueError, OSError) as error:
            reasons[k] = one_line(error)
            strips.append(Strips({}, ""))
    if len(reasons) == len(chosen):  # only views with saved images
        worst, best = extremes(chosen, options.views, set.intersection(*map(saved_views, chosen)))
    for k, reason in reasons.items():
        strips[k] = saved_strips(chosen[k], [*worst, *best], reason)
    return Gallery(group, worst, best, strips)


def extremes(runs: Sequence[EvaluatedRun], count: int, among: set[str] | None = None) -> tuple[list[str], list[str]]:
    """The views with the lowest and with the highest mean PSNR over the runs, most extreme first; no view is in both.

    Args:
        runs: Runs with the same views.
        count: Maximum number of views of either type.
        among: Names of the views to choose from; all if None.
    """
    scores: dict[str, list[float]] = {}
    for run in runs:
        for view in run.views:
            psnr = view.values["psnr"]
            if psnr is not None and (among is None or view.name in among):
                scores.setdefault(view.name, []).append(psnr)
    ordered = sorted(scores, key=lambda name: (statistics.fmean(scores[name]), name))
    worst = ordered[:count]
    return worst, [name for name in reversed(ordered[-count:]) if name not in worst]
