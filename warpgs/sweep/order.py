"""The order in which cells start: the longest one first, within each table."""

from collections.abc import Iterable
from itertools import groupby

from warpgs.config import scaled
from warpgs.runs.checkpoint import list_checkpoints
from warpgs.training.schedule import Protocol

from .cells import Cell


def remaining_cost(cell: Cell) -> int:
    """About how long the training of a cell still takes, relative to other cells of its capture."""
    protocol = Protocol(scaled(cell.config), has_depth=cell.config.depth)
    done = max((int(path.stem) for path in list_checkpoints(cell.folder) if path.stem.isdecimal()), default=0)
    return protocol.remaining_cost(done)


def longest_first(cells: Iterable[Cell]) -> list[Cell]:
    """The cells of each seed and capture by remaining cost: a long one that starts last would run beside idle GPUs.

    Seeds and captures keep their order, so that whole tables come first, and so do cells of equal cost.
    """
    tables = groupby(cells, key=lambda cell: (cell.seed, cell.scene))
    return [cell for _, table in tables for cell in sorted(table, key=remaining_cost, reverse=True)]
