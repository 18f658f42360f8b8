"""The order in which cells start."""

import pytest

from warpgs.runs import checkpoint
from warpgs.sweep.board import Board, longest_first, remaining_cost
from warpgs.sweep.cells import plan_cells
from warpgs.sweep.spec import SweepSpec, Variant, read_spec

LONGEST_FIRST = ["c", "d", "e", "no-dap", "a", "b", "no-s2", "no-app"]
"""Variants of `ablation`: the first four use the appearance network, which takes the time."""


def plan(folder, variants=None, scenes=("as",), seeds=(0,), **overrides):
    shipped = read_spec("ablation")
    chosen = tuple(Variant(name, name, options) for name, options in (variants or {}).items()) or shipped.variants
    spec = SweepSpec(shipped.source, "Mine", "paper", seeds, (), {}, chosen)
    return plan_cells(spec, {name: f"/{name}" for name in scenes}, folder, overrides)


def add_checkpoint(cell, iteration):
    path = checkpoint.path_of(cell.folder, iteration)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()


@pytest.mark.parametrize("overrides", [{}, {"iterations": 12_000}])
def test_cells_with_the_appearance_network_start_first_and_tables_stay_whole(tmp_path, overrides):
    cells = plan(tmp_path, scenes=("y", "x"), seeds=(7, 4, 5), **overrides)
    tables = [(seed, scene) for seed in (7, 4, 5) for scene in ("y", "x")]
    started = [cell.name for cell in longest_first(cells)]
    assert started == [f"{scene}-{name}-seed{seed}" for seed, scene in tables for name in LONGEST_FIRST]


def test_jobs_start_in_this_order_and_the_live_table_keeps_that_of_the_variants(tmp_path):
    board = Board(tmp_path, plan(tmp_path), print)
    assert [job.name for job in board.jobs("cpu")] == [f"as-{name}-seed0" for name in LONGEST_FIRST]
    shown = [f"as-{variant.name}-seed0" for variant in read_spec("ablation").variants]
    assert [str(name) for name in board.table().columns[0].cells] == shown == [cell.name for cell in board.unfinished()]


def test_more_iterations_start_first(tmp_path):
    cells = plan(tmp_path, {"short": {"iterations": 3_000}, "long": {"iterations": 9_000}})
    assert [cell.variant for cell in longest_first(cells)] == ["long", "short"]


def test_a_training_that_continues_costs_what_is_left_of_it(tmp_path):
    whole, early, late, trained = plan(tmp_path, {name: {} for name in ("whole", "early", "late", "trained")})
    for cell, iterations in ((early, (5_000, 12_000)), (late, (60_000, 65_000)), (trained, (72_000,))):
        for iteration in iterations:
            add_checkpoint(cell, iteration)
    checkpoint.path_of(late.folder, 0).with_name("mine.safetensors").touch()
    costs = [remaining_cost(cell) for cell in (whole, early, late, trained)]
    assert costs == [72_000 + 40_000, 60_000 + 40_000, 7_000 + 7_000, 0]
    assert longest_first([trained, late, early, whole]) == [whole, early, late, trained]
