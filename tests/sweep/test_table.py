"""Means over seeds and captures, and their formats."""

import csv
import io
import json
import re

import pytest
from rich.console import Console

from warpgs.sweep.formats import latex, markdown, means_csv, terminal
from warpgs.sweep.peers import read_peers
from warpgs.sweep.table import Statistic, best_means, make_tables

LABELS = {"a": "(a) S1", "b": "(b) 50% & more"}


def measured(psnrs, **others):
    """Results from {(variant, scene): [PSNR of each seed]}; None = not finished."""
    return {
        (variant, scene, seed): None if psnr is None else {"psnr": psnr, **others}
        for (variant, scene), values in psnrs.items()
        for seed, psnr in enumerate(values)
    }


def column(table, key):
    index = list(table.metrics).index(key)
    return [row.values[index] for row in table.rows]


def test_a_table_has_mean_and_sample_deviation_over_seeds():
    (table,) = make_tables(measured({("a", "as"): [1.0, 2.0, 6.0], ("b", "as"): [4.0]}), LABELS, {})
    assert table.title == "as"
    assert column(table, "psnr") == [Statistic(3.0, pytest.approx(7**0.5)), Statistic(4.0, None)]
    assert [(row.label, row.done, row.planned) for row in table.rows] == [("(a) S1", 3, 3), ("(b) 50% & more", 1, 1)]


def test_the_mean_over_captures_is_that_of_each_seed_over_all_captures():
    cells = measured({("a", "x"): [1.0, 3.0], ("a", "y"): [3.0, 9.0], ("b", "x"): [5.0, 5.0], ("b", "y"): [7.0, None]})
    mean, x, y = make_tables(cells, LABELS, {})
    assert mean.title == "Mean over 2 captures"
    assert column(mean, "psnr") == [Statistic(4.0, pytest.approx(8**0.5)), Statistic(6.0, None)]
    assert [row.done for row in mean.rows] == [2, 1]
    assert [row.done for row in y.rows] == [2, 1]
    assert column(x, "psnr")[1] == Statistic(5.0, 0.0)


def test_a_capture_on_which_nothing_finished_is_left_out():
    cells = measured({("a", "x"): [1.0], ("a", "y"): [3.0], ("a", "broken"): [None]})
    tables = make_tables(cells, {"a": "a"}, {})
    assert [table.title for table in tables] == ["Mean over 2 of 3 captures", "x", "y"]
    assert column(tables[0], "psnr") == [Statistic(2.0, None)]


def test_units_and_sums():
    cells = measured({("a", "as"): [1.0]}, train_seconds=90.0, peak_bytes=2_500_000_000, num_static=40, num_dynamic=2)
    (table,) = make_tables(cells, {"a": "a"}, {})
    found = {name: value.mean for name, value in zip(table.metrics, table.rows[0].values, strict=True)}
    assert found == {"psnr": 1.0, "train_seconds": 1.5, "peak_bytes": 2.5, "num_gaussians": 42.0}


def test_a_value_that_one_seed_lacks_has_no_mean():
    cells = {("a", "as", 0): {"psnr": 1.0, "lpips": None}, ("a", "as", 1): {"psnr": 1.0, "lpips": 0.5}}
    (table,) = make_tables({**cells, ("b", "as", 0): {"psnr": 2.0, "lpips": 0.1}}, LABELS, {})
    assert column(table, "lpips") == [None, Statistic(0.1, None)]


def test_the_best_of_a_column_is_the_highest_or_the_lowest_and_ties_of_all_have_none():
    cells = {("a", "as", 0): {"psnr": 30.0, "lpips": 0.2, "ssim": 0.9}}
    cells["b", "as", 0] = {"psnr": 31.0, "lpips": 0.1, "ssim": 0.90001}
    (table,) = make_tables(cells, LABELS, {})
    assert best_means(table) == [31.0, None, 0.1]


def test_a_line_that_lacks_seeds_is_never_the_best_which_markdown_marks():
    cells = measured({("a", "as"): [30.0, 31.0], ("b", "as"): [32.0, None], ("c", "as"): [29.0, 31.0]})
    tables = make_tables(cells, {**LABELS, "c": "c"}, {})
    assert best_means(tables[0]) == [30.5]
    lines = markdown("Mine", tables, ["1 failed"]).splitlines()
    assert "| (a) S1 | **30.50 ± 0.71** | 2 |" in lines
    assert "| (b) 50% & more | 32.00 | 1 of 2 |" in lines
    assert lines[-1] == "1 failed"
    (alone,) = make_tables(dict([*cells.items()][:4]), LABELS, {})
    assert best_means(alone) == [None]


def test_latex_is_escaped_and_balanced():
    cells = measured({("a", "as"): [30.0, 31.0], ("b", "as"): [29.0]})
    text = latex("Mine_1", make_tables(cells, LABELS, {}), ["as_1: 50% of `x|y` < 3"])
    assert r"(b) 50\% \& more & 29.00 & 1 \\" in text
    assert r"\textbf{30.50 $\pm$ 0.71}" in text
    assert r"\caption{Mine\_1: as. Mean $\pm$ standard deviation over seeds.}" in text
    note = r"as\_1: 50\% of \textasciigrave{}x\textbar{}y\textasciigrave{} \textless{} 3"
    assert text.endswith(f"\\end{{table}}\n\n{note}\n")
    assert text.count(r"\begin") == text.count(r"\end")
    lines = [line for line in text.splitlines() if line.endswith(r" \\")]
    assert [line.count(" & ") for line in lines] == [2, 2, 2]
    assert r"\begin{tabular}{lrr}" in text


def test_every_format_says_how_many_seeds_of_how_many_are_in_a_line():
    cells = measured({("a", "as"): [30.0, 31.0], ("b", "as"): [29.0, None]})
    tables = make_tables(cells, LABELS, {"D3DGS": {"as": {"psnr": Statistic(25.0, None)}}})
    assert "| (b) 50% & more | 29.00 | 1 of 2 |" in markdown("Mine", tables, [])
    assert r"(b) 50\% \& more & 29.00 & 1 of 2 \\" in latex("Mine", tables, [])
    lines = list(csv.DictReader(io.StringIO(means_csv(tables))))
    assert [(line["seeds"], line["planned seeds"]) for line in lines] == [("2", "2"), ("1", "2"), ("", "")]


def test_csv_has_unrounded_numbers():
    tables = make_tables(measured({("a", "as"): [30.0, 31.25], ("b", "as"): [29.0]}), LABELS, {})
    first, second = csv.DictReader(io.StringIO(means_csv(tables)))
    assert float(first["PSNR [dB]"]) == 30.625
    assert float(first["PSNR [dB] deviation"]) == pytest.approx(0.8838834764831844)
    assert (second["row"], second["PSNR [dB] deviation"]) == ("(b) 50% & more", "")


def peers(folder, values):
    (folder / "peers.json").write_text(json.dumps(values))
    return read_peers(folder / "peers.json")


def test_peers_stand_below_with_their_numbers_and_the_mean_of_captures_they_all_have(tmp_path):
    numbers = {"D3DGS": {"x": {"psnr": [24.0, 0.5]}, "y": {"psnr": 26}}, "Other": {"mean": {"psnr": 20.0}}}
    cells = measured({("a", "x"): [1.0], ("a", "y"): [3.0]})
    mean, x, y = make_tables(cells, {"a": "a"}, peers(tmp_path, numbers))
    assert [row.label for row in mean.rows] == ["a", "D3DGS", "Other"]
    assert column(mean, "psnr")[1:] == [Statistic(25.0, None), Statistic(20.0, None)]
    assert column(x, "psnr")[1:] == [Statistic(24.0, 0.5)]
    assert [row.label for row in y.rows] == ["a", "D3DGS"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"D": {"x": {"psrn": 1}}}, "D, x: there is no metric psrn, expected psnr"),
        ({"D": {"x": {"psnr": "1"}}}, r"D, x: psnr must be a number or \[mean, standard deviation\], got '1'"),
        ({"D": {"x": {"psnr": [1, 2, 3]}}}, "psnr must be a number"),
        ({"D": {"x": 3}}, "D, x must be an object, got 3"),
        ({"D": 3}, "D must be an object, got 3"),
        ({"D": {"x": {"psnr": 10**400}}}, r"peers\.json is damaged: psnr has more than 64 bits"),
        ({"D": {"x": {"psnr": [1, -(10**400)]}}}, r"peers\.json is damaged: psnr has more than 64 bits"),
        ({"D": {"x": {"psnr": 1e16}}}, r"peers\.json: D, x: psnr must be a number or .*, got 1e\+16"),
    ],
)
def test_wrong_numbers_of_peers_are_named(tmp_path, values, message):
    with pytest.raises(ValueError, match=message):
        peers(tmp_path, values)


def on_terminal(table, columns):
    console = Console(file=io.StringIO(), width=columns, force_terminal=True)
    console.print(terminal(table))
    return console.file.getvalue()


@pytest.mark.parametrize("columns", [70, 80, 120])
def test_a_terminal_shows_every_word_of_a_table_in_one_piece(columns):
    others = {"ssim": 0.9168, "psnr_dynamic": 22.31, "num_static": 4_950, "num_dynamic": 2_464}
    labels = {"a": "[d] everything without its predecessor", "b": "b"}
    (table,) = make_tables(measured({("a", "as"): [27.0, 28.0], ("b", "as"): [29.0, 29.0]}, **others), labels, {})
    shown = re.sub(r"\x1b\[[0-9;]*m", "", on_terminal(table, columns))
    assert {"[d]", "everything", "without", "its", "predecessor", "27.50", "dynamic", "Gaussians", "seeds"} <= set(
        shown.split()
    )
    assert "…" not in shown
    assert "|" not in shown
    assert "**" not in shown


def test_a_terminal_shows_the_best_value_in_bold():
    (table,) = make_tables(measured({("a", "as"): [27.0], ("b", "as"): [29.0]}), LABELS, {})
    shown = on_terminal(table, 80)
    assert re.search(r"\x1b\[1m *29\.00", shown)
    assert not re.search(r"\x1b\[1m *27\.00", shown)
