"""``warpgs report``: writes one HTML file about runs."""

import importlib.metadata
import statistics
from collections.abc import Sequence
from datetime import datetime, timezone
from pathlib import Path

from warpgs.errors import one_line
from warpgs.files import write_text

from .command import Report
from .page import Gallery, page
from .record import Record, read_records
from .strips import Strips, available, from_folder, rendered


def write_report(options: Report) -> str:
    """Writes the report; returns a summary to print.

    Raises:
        ValueError: If a run cannot be reported on.
        OSError: If the file cannot be written.
    """
    if options.views < 0:
        raise ValueError(f"--views must not be negative, got {options.views}")
    records = read_records(options.run_folders)
    galleries = [_gallery(options, records, group) for group in groups(records)] if options.views else []
    now = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
    made = f"made {now} by warpgs {importlib.metadata.version('warpgs')}"
    out = options.out or (options.run_folders[0] if len(records) == 1 else Path()) / "report.html"
    write_text(out, page(records, [gallery for gallery in galleries if gallery.worst], made))
    return f"{out}: {out.stat().st_size / 1e6:.1f} MB"


def _gallery(options: Report, records: Sequence[Record], group: Sequence[int]) -> Gallery:
    """Worst and best views of runs that share a capture."""
    chosen = [records[k] for k in group]
    worst, best = extremes(chosen, options.views)
    strips: list[Strips] = []
    reasons: dict[int, str] = {}
    for k, record in enumerate(chosen):
        try:
            strips.append(rendered(record, [*worst, *best], options.device, options.quiet))
        except (ValueError, OSError) as error:
            reasons[k] = one_line(error)
            strips.append(Strips({}, ""))
    if len(reasons) == len(chosen):  # then only views of which there are pictures
        worst, best = extremes(chosen, options.views, set.intersection(*map(available, chosen)))
    for k, reason in reasons.items():
        strips[k] = from_folder(chosen[k], [*worst, *best], reason)
    return Gallery(group, worst, best, strips)


def groups(records: Sequence[Record]) -> list[list[int]]:
    """Numbers of the runs that were evaluated on the same views of the same capture."""
    found: dict[tuple[object, ...], list[int]] = {}
    for number, record in enumerate(records):
        key = (record.config.data, record.config.factor, *sorted(view.name for view in record.views))
        found.setdefault(key, []).append(number)
    return list(found.values())


def extremes(records: Sequence[Record], count: int, among: set[str] | None = None) -> tuple[list[str], list[str]]:
    """Views of lowest and of highest PSNR, mean over runs; no view is both, and the extreme ones come first."""
    scores: dict[str, list[float]] = {}
    for record in records:
        for view in record.views:
            psnr = view.figures["psnr"]
            if psnr is not None and (among is None or view.name in among):
                scores.setdefault(view.name, []).append(psnr)
    ordered = sorted(scores, key=lambda name: (statistics.fmean(scores[name]), name))
    worst = ordered[:count]
    return worst, [name for name in reversed(ordered[-count:]) if name not in worst]
