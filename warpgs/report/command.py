"""``warpgs report``."""

import importlib.metadata
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.errors import one_line
from warpgs.files import write_text

from .page import Gallery, page
from .record import Record, read_records
from .strips import Strips, available, from_folder, rendered


@dataclass(frozen=True)
class Report:
    """Writes one HTML file about runs that were evaluated: curves, every view's figures, worst and best views, timing.

    The file holds everything that it shows, and loads nothing from anywhere.
    """

    run_folders: Annotated[tuple[Path, ...], tyro.conf.arg(name="run"), tyro.conf.Positional]
    """Run folders, side by side."""
    out: Path | None = None
    """File to write; report.html if left out, in the run folder if there is only one."""
    views: int = 3
    """Worst and best views to show, so many of each."""
    device: Literal["cuda", "cpu"] | None = None
    """Where to render; CUDA if there is a GPU."""
    quiet: bool = False
    """Show no progress."""

    def run(self) -> None:
        """Writes the report.

        Raises:
            ValueError: If a run can't be reported on.
            OSError: If the file can't be written.
        """
        if self.views < 0:
            raise ValueError(f"--views must not be negative, got {self.views}")
        records = read_records(self.run_folders)
        galleries = [self._gallery(records, group) for group in groups(records)] if self.views else []
        moment = datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC")
        made = f"made {moment} by warpgs {importlib.metadata.version('warpgs')}"
        out = self.out or (self.run_folders[0] if len(records) == 1 else Path()) / "report.html"
        write_text(out, page(records, [gallery for gallery in galleries if gallery.worst], made))
        print(f"{out}: {out.stat().st_size / 1e6:.1f} MB")

    def _gallery(self, records: Sequence[Record], group: Sequence[int]) -> Gallery:
        """Worst and best views of runs that share a capture."""
        chosen = [records[k] for k in group]
        worst, best = extremes(chosen, self.views)
        strips: list[Strips] = []
        reasons: dict[int, str] = {}
        for k, record in enumerate(chosen):
            try:
                strips.append(rendered(record, [*worst, *best], self.device, self.quiet))
            except (ValueError, OSError) as error:
                reasons[k] = one_line(error)
                strips.append(Strips({}, ""))
        if len(reasons) == len(chosen):  # then only views of which there are pictures
            worst, best = extremes(chosen, self.views, set.intersection(*map(available, chosen)))
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
