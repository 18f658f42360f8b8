"""The command, with a pool that only pretends to train."""

import dataclasses
import json
import re
import shutil
import signal
from pathlib import Path

import pytest

from tests.data.captures import edit_json
from warpgs.cli import main
from warpgs.runs.config_file import read_config, write_config
from warpgs.sweep import run_sweep as module
from warpgs.sweep.scheduler import ClusterGoneError, Result

TOML = """
title = "Mine"
preset = "quick"
seeds = 2
options.iterations = 32
[variants.full]
[variants.plain]
omit = ["app"]
"""


class Nodes:
    """What a pool knows of its nodes."""

    device = "cpu"

    def move(self, job, avoid):
        pass

    def nodes(self):
        return {"one", "two"}


@pytest.fixture
def sweep(tmp_path, monkeypatch, finished_run):
    """Runs the command; ``train(job)`` returns an error, and by default leaves a finished run behind."""

    def finish(job):
        folder = tmp_path / "out" / job.name
        if not folder.exists():
            shutil.copytree(finished_run, folder, ignore=shutil.ignore_patterns("checkpoints"))
        (folder / "metrics.json").write_text(
            json.dumps({"iterations": 32, "psnr": 20.0 + int(job.name[-1]), "train_seconds": 60.0, "peak_bytes": None})
        )
        (folder / "views.csv").write_text("name,time,psnr,ssim,lpips\nleft_000000,0,20,0.5,\n")

    class Pretended(Nodes):
        def __init__(self, *_):
            self.queue = []

        def submit(self, job, avoid=frozenset()):
            self.queue.append(job)

        def wait(self, seconds):
            job = self.queue.pop(0)
            trained.append(job.name)
            return [Result(job.name, train(job), node=run.node)]

        def stop(self):
            pass

        def close(self):
            run.at_close = sorted(path.name for path in (tmp_path / "out").glob("*.*"))

    train, trained = finish, []
    monkeypatch.setattr(module, "RayPool", Pretended)
    (tmp_path / "mine.toml").write_text(TOML)
    (tmp_path / "as").mkdir()
    (tmp_path / "as/dataset.json").touch()

    def run(*arguments, by=finish):
        nonlocal train
        train = by
        trained.clear()
        options = ["--data", str(tmp_path / "as"), "--out", str(tmp_path / "out")]
        return main(["sweep", str(tmp_path / "mine.toml"), *options, *arguments]), list(trained)

    run.finish, run.node = finish, ""
    return run


@pytest.mark.parametrize("error", [ImportError("a sweep needs Ray"), ConnectionError("there is no Ray cluster at h:1")])
def test_a_sweep_without_ray_is_one_line_and_leaves_no_folder(sweep, tmp_path, monkeypatch, capsys, error):
    def missing(*_):
        raise error

    monkeypatch.setattr(module, "RayPool", missing)
    assert sweep()[0] == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", f"warpgs sweep: {error}\n")
    assert not (tmp_path / "out").exists()


def test_all_cells_are_trained_and_all_files_written(sweep, tmp_path, capsys):
    assert sweep() == (0, ["as-full-seed0", "as-plain-seed0", "as-full-seed1", "as-plain-seed1"])
    printed = capsys.readouterr().out
    assert "| full | 20.50 ± 0.71 | 1.0 ± 0.0 | 2 |" in printed
    text = (tmp_path / "out/table.md").read_text()
    assert f"warpgs train --preset quick --data {tmp_path}/as --out {tmp_path}/out/as-full-seed0" in text
    assert r"20.50 $\pm$ 0.71" in (tmp_path / "out/table.tex").read_text()
    assert (tmp_path / "out/cells.csv").read_text().count("finished") == 4
    assert "20.50 ± 0.71" in (tmp_path / "out/report.html").read_text()


def test_a_terminal_gets_tables_and_the_file_markdown(sweep, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("TERM", "dumb")
    assert sweep()[0] == 0
    printed = capsys.readouterr().out
    assert "20.50 ± 0.71" in printed
    assert "4 of 4 trainings finished" in printed
    assert "| full |" not in printed
    assert "# Mine" not in printed
    assert "| full | 20.50 ± 0.71 |" in (tmp_path / "out/table.md").read_text()


def test_a_sweep_that_stops_writes_its_tables_before_ray_ends_which_takes_seconds(sweep):
    def stop(job):
        raise KeyboardInterrupt

    sweep(by=stop)
    assert {"table.md", "table.tex", "table.csv", "cells.csv", "report.html"} < set(sweep.at_close)


def test_the_same_command_trains_nothing_again_and_more_seeds_train_those(sweep):
    sweep()
    assert sweep() == (0, [])
    assert sweep("--seeds", "3") == (0, ["as-full-seed2", "as-plain-seed2"])


def test_a_failed_cell_is_reported_with_the_table_of_the_others(sweep, tmp_path, capsys):
    def fail(job):
        return "warpgs train: broken" if job.name == "as-plain-seed0" else sweep.finish(job)

    code, trained = sweep(by=fail)
    assert code == 1
    assert trained.count("as-plain-seed0") == 2
    printed = capsys.readouterr().out
    assert "[4/4] as-plain-seed0 failed: warpgs train: broken" in printed
    assert "| plain | 21.00 | 1.0 | 1 of 2 |" in printed
    assert "3 of 4 trainings finished" in printed
    assert "as-plain-seed0: warpgs train: broken" in printed
    assert (tmp_path / "out/table.tex").read_text().endswith("\n\nas-plain-seed0: warpgs train: broken\n")


def test_a_node_that_gets_no_more_cells_is_named_once(sweep, capsys):
    sweep.node = "one"
    assert sweep(by=lambda job: "node7: full")[0] == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("node ")]
    cells = "as-full-seed0, as-plain-seed0"
    assert lines == [f"node one gets no more cells: {cells} failed on it in a row (node7: full)"]


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "warpgs sweep: stopped; the same command continues"),
        (ClusterGoneError("the Ray cluster at h:1 is gone"), 2, "warpgs sweep: the Ray cluster at h:1 is gone;"),
        (OSError("studio cannot be kept in /cache: No space left"), 2, "sweep: studio cannot be kept in /cache"),
    ],
)
def test_a_sweep_that_stops_says_so_prints_what_is_there_and_goes_on(sweep, capsys, error, code, message):
    def stop(job):
        if job.name == "as-plain-seed0":
            raise error
        return sweep.finish(job)

    assert sweep(by=stop) == (code, ["as-full-seed0", "as-plain-seed0"])
    captured = capsys.readouterr()
    assert message in captured.out + captured.err
    assert "| full | 20.00 | 1.0 | 1 of 2 |" in captured.out
    assert sweep() == (0, ["as-plain-seed0", "as-full-seed1", "as-plain-seed1"])


def test_sigterm_stops_a_sweep_as_ctrl_c_does(sweep, tmp_path, capsys):
    def stop(job):
        if job.name == "as-plain-seed0":
            signal.raise_signal(signal.SIGTERM)
        return sweep.finish(job)

    assert sweep(by=stop) == (130, ["as-full-seed0", "as-plain-seed0"])
    assert capsys.readouterr().err == "warpgs sweep: stopped; the same command continues\n"
    assert "| full | 20.00 | 1.0 | 1 of 2 |" in (tmp_path / "out/table.md").read_text()


needs_dev_full = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full: every write to it fails")


@needs_dev_full
@pytest.mark.parametrize("file", ["table.md", "cells.csv", "report.html"])
def test_a_full_disk_stops_no_training_and_the_table_is_printed(sweep, tmp_path, capsys, monkeypatch, file):
    def on_a_full_disk(write):
        def attempt(out, *others):
            (out / f"{file}.partial").unlink(missing_ok=True)
            (out / f"{file}.partial").symlink_to("/dev/full")
            write(out, *others)

        return attempt

    for name in ("write_tables", "write_report"):
        monkeypatch.setattr(module, name, on_a_full_disk(getattr(module, name)))
    code, trained = sweep()
    assert (code, len(trained)) == (2, 4)
    printed = capsys.readouterr()
    assert "| full | 20.50 ± 0.71 | 1.0 ± 0.0 | 2 |" in printed.out
    assert printed.err == f"warpgs sweep: {tmp_path}/out/{file} could not be written: No space left on device\n"


@needs_dev_full
def test_tables_of_a_finished_sweep_are_printed_on_a_full_disk(sweep, tmp_path, capsys):
    sweep()
    capsys.readouterr()
    for name in ("sweep.json", "table.md"):
        (tmp_path / f"out/{name}.partial").symlink_to("/dev/full")
    assert sweep("--tables-only") == (2, [])
    printed = capsys.readouterr()
    assert "| full | 20.50 ± 0.71 | 1.0 ± 0.0 | 2 |" in printed.out
    assert printed.err == f"warpgs sweep: {tmp_path}/out/table.md could not be written: No space left on device\n"


def test_results_of_other_options_are_never_mixed_in(sweep, capsys):
    sweep()
    assert sweep("--iterations", "64") == (2, [])
    assert "as-full-seed0 was trained with other options" in capsys.readouterr().err


def test_finished_cells_that_lack_what_is_asked_for_are_evaluated_again(sweep, tmp_path, capsys):
    def evaluate(job):
        assert job.is_trained
        path = tmp_path / "out" / job.name / "metrics.json"
        lpips = {"lpips": 0.25, "lpips_net": "vgg"} if "--lpips" in job.evaluation else {}
        kept = {name: json.loads(path.read_text())[name] for name in ("psnr", "iterations", "train_seconds")}
        path.write_text(json.dumps({**kept, **lpips}))

    weights = tmp_path / "weights"
    weights.mkdir()
    for name in ("vgg16.pth", "lpips_v0.1_vgg_lin.pth"):
        (weights / name).touch()
    sweep()
    options = ["--lpips", str(weights)]
    capsys.readouterr()
    code, evaluated = sweep(*options, by=evaluate)
    assert (code, len(evaluated)) == (0, 4)
    assert "| full | 20.50 ± 0.71 | 0.2500 ± 0.0000 | 1.0 ± 0.0 | 2 |" in capsys.readouterr().out
    assert sweep(*options) == sweep() == (0, [])
    for text in ((tmp_path / "out/sweep.json").read_text(), (tmp_path / "out/table.md").read_text()):
        assert text.count(f"--lpips {weights}") == 4


def test_networks_of_lpips_are_not_mixed_without_a_note(sweep, tmp_path, capsys):
    sweep()
    for name, net in (("as-full-seed0", "alex"), ("as-plain-seed0", "vgg")):
        edit_json(tmp_path / "out" / name / "metrics.json", lpips=0.5, lpips_net=net)
    capsys.readouterr()
    sweep("--tables-only")
    assert "LPIPS is of different networks (alex in 1, vgg in 1 trainings)" in capsys.readouterr().out


@pytest.mark.parametrize("options", [["--lpips", "weights"], ["--lpips-net", "alex"]])
def test_tables_alone_evaluate_nothing(sweep, capsys, options):
    sweep()
    assert sweep("--tables-only", *options) == (2, [])
    assert "--tables-only evaluates nothing" in capsys.readouterr().err


def test_weights_in_the_environment_are_checked_only_if_needed(sweep, monkeypatch, tmp_path, capsys):
    sweep()
    monkeypatch.setenv("WARPGS_LPIPS", str(tmp_path / "nowhere"))
    assert sweep("--tables-only") == (0, [])
    assert sweep() == (2, [])
    assert f"{tmp_path}/nowhere does not hold the weights of LPIPS" in capsys.readouterr().err


def test_a_cell_that_ends_without_results_has_failed(sweep, capsys):
    assert sweep(by=lambda job: None)[0] == 1
    assert "as-full-seed0 failed: " in capsys.readouterr().out


def test_a_dry_run_trains_nothing(sweep, tmp_path, capsys):
    assert sweep("--dry-run") == (0, [])
    assert not (tmp_path / "out").exists()
    assert len(capsys.readouterr().out.splitlines()) == 4


def test_variants_that_train_the_same_are_named(sweep, tmp_path, capsys):
    (tmp_path / "mine.toml").write_text(f"{TOML}[variants.again]\nomit = ['app']\n")
    assert sweep("--dry-run")[0] == 0
    assert capsys.readouterr().err == "warning: variants with the same options, which train the same: plain, again\n"


def test_folders_that_are_no_captures_are_named_but_not_in_the_script_of_a_dry_run(sweep, tmp_path, capsys):
    (tmp_path / "captures/broken").mkdir(parents=True)
    (tmp_path / "as").rename(tmp_path / "captures/as")
    options = ["--data", str(tmp_path / "captures")]
    warning = f"warning: {tmp_path}/captures: skipped folders that are not captures: broken\n"
    assert sweep(*options, "--dry-run")[0] == 0
    printed = capsys.readouterr()
    assert (printed.err, printed.out.count("\n")) == (warning, 4)
    assert sweep(*options)[0] == 0
    assert capsys.readouterr().out.startswith(warning)


def test_a_missing_capture_fails_only_its_own_cells_and_is_named_before_the_first_training(sweep, tmp_path, capsys):
    data = ["--data", str(tmp_path / "as"), str(tmp_path / "az")]
    assert sweep(*data) == (1, ["as-full-seed0", "as-plain-seed0", "as-full-seed1", "as-plain-seed1"])
    printed = capsys.readouterr().out
    problem = f"{tmp_path}/az does not exist"
    assert printed.startswith(f"warning: {problem}\n[5/8] as-full-seed0 finished\n")
    assert "| full | 20.50 ± 0.71 | 1.0 ± 0.0 | 2 |" in printed
    note = f"az-full-seed0, az-plain-seed0, az-full-seed1, az-plain-seed1: {problem}\n"
    assert note in printed
    assert note in (tmp_path / "out/table.md").read_text()
    assert sweep(*data) == sweep(*data, "--tables-only") == (1, [])
    assert capsys.readouterr().out.count(note) == 2
    (tmp_path / "az").mkdir()
    (tmp_path / "az/dataset.json").touch()
    assert sweep(*data) == (0, ["az-full-seed0", "az-plain-seed0", "az-full-seed1", "az-plain-seed1"])


def test_tables_alone_do_not_warn_of_missing_captures(sweep, tmp_path, capsys):
    data = ["--data", str(tmp_path / "as"), str(tmp_path / "az")]
    assert sweep(*data)[0] == 1
    shutil.rmtree(tmp_path / "as")
    capsys.readouterr()
    assert sweep(*data, "--seeds", "3", "--tables-only") == (1, [])
    assert "warning" not in "".join(capsys.readouterr())


def test_a_sweep_of_missing_captures_alone_is_refused_in_one_line(sweep, tmp_path, capsys):
    for options in ([], ["--dry-run"]):
        assert sweep("--data", str(tmp_path / "cup"), str(tmp_path / "bell"), *options) == (2, [])
        assert capsys.readouterr() == ("", f"warpgs sweep: {tmp_path}/cup does not exist\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("options", [[], ["--tables-only"]])
def test_a_finished_sweep_does_not_need_its_captures(sweep, tmp_path, capsys, options):
    sweep()
    shutil.rmtree(tmp_path / "as")
    capsys.readouterr()
    assert sweep(*options) == (0, [])
    printed = capsys.readouterr().out
    assert "| full | 20.50 ± 0.71 | 1.0 ± 0.0 | 2 |" in printed
    assert "does not exist" not in printed


@pytest.mark.parametrize(
    ("gone", "emptied"),
    [
        ("captures", []),
        ("captures", ["captures"]),
        ("captures", ["captures/bell", "captures/notes"]),
        ("captures/bell", []),
        ("captures/bell", ["captures/bell"]),
    ],
)
def test_tables_alone_do_not_need_the_folder_of_captures(sweep, tmp_path, capsys, gone, emptied):
    for name in ("bell", "cup"):
        (tmp_path / "captures" / name).mkdir(parents=True)
        (tmp_path / "captures" / name / "dataset.json").touch()
    data = ["--data", str(tmp_path / "captures")]
    assert sweep(*data)[0] == 0
    before = (tmp_path / "out/table.md").read_text()
    shutil.rmtree(tmp_path / gone)
    for path in emptied:
        (tmp_path / path).mkdir(parents=True)
    capsys.readouterr()
    assert sweep(*data, "--tables-only") == sweep(*data) == (0, [])
    assert (tmp_path / "out/table.md").read_text() == before
    skipped = [line for line in capsys.readouterr().out.splitlines() if "skipped" in line]
    assert all(line.endswith("captures: notes") for line in skipped)
    assert bool(skipped) == ("captures/notes" in emptied)


def test_a_capture_that_was_removed_before_a_training_on_it_finished_is_forgotten(sweep, tmp_path, capsys):
    for name in ("bad", "cup"):
        (tmp_path / "captures" / name).mkdir(parents=True)
        (tmp_path / "captures" / name / "dataset.json").touch()
    data = ["--data", str(tmp_path / "captures")]
    assert sweep(*data, by=lambda job: "broken" if job.name.startswith("bad") else sweep.finish(job))[0] == 1
    shutil.rmtree(tmp_path / "captures/bad")
    capsys.readouterr()
    assert sweep(*data) == (0, [])
    assert "bad" not in capsys.readouterr().out


def test_cells_whose_capture_was_deleted_fail_and_keep_what_was_measured(sweep, tmp_path, capsys):
    sweep()
    shutil.rmtree(tmp_path / "as")
    capsys.readouterr()
    assert sweep("--seeds", "3") == (1, [])
    printed = capsys.readouterr().out
    assert "| full | 20.50 ± 0.71 | 1.0 ± 0.0 | 2 of 3 |" in printed
    assert f"as-plain-seed2: {tmp_path}/as does not exist\n" in printed


def test_tables_alone_keep_the_reasons_and_the_exit_code(sweep, tmp_path, capsys):
    def fail(job):
        return 'node7: a, "b" is [bad]' if job.name == "as-plain-seed0" else sweep.finish(job)

    assert sweep(by=fail)[0] == 1
    note = 'as-plain-seed0: node7: a, "b" is [bad]'
    assert note in (before := (tmp_path / "out/table.md").read_text())
    for _ in range(2):
        assert sweep("--tables-only") == (1, [])
        assert (tmp_path / "out/table.md").read_text() == before
        assert note in capsys.readouterr().out
    assert sweep() == (0, ["as-plain-seed0"])
    assert sweep("--tables-only") == (0, [])
    assert "node7" not in (tmp_path / "out/table.md").read_text()


@pytest.mark.parametrize("state", ["missing", "empty", "of another sweep"])
def test_tables_alone_of_a_folder_without_the_sweep_are_refused(sweep, tmp_path, capsys, state):
    if state != "missing":
        (tmp_path / "out").mkdir()
    if state == "of another sweep":
        (tmp_path / "out/sweep.json").write_text('{"bell-full-seed0": "warpgs train"}')
    before = sorted(tmp_path.rglob("*"))
    assert sweep("--tables-only") == (2, [])
    assert f"{tmp_path}/out has no training of this sweep" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_numbers_of_others_stand_beside(sweep, tmp_path, capsys):
    (tmp_path / "peers.json").write_text(json.dumps({"D3DGS": {"as": {"psnr": 25.8}}}))
    assert sweep("--compare", str(tmp_path / "peers.json"))[0] == 0
    printed = capsys.readouterr().out
    assert "| D3DGS | **25.80** |" in printed
    assert "warning" not in printed


def test_numbers_of_others_on_an_unknown_capture_are_named(sweep, tmp_path, capsys):
    path = tmp_path / "peers.json"
    path.write_text(json.dumps({"D3DGS": {"sa": {"psnr": 25.8}, "mean": {"psnr": 24.0}}}))
    assert sweep("--compare", str(path))[0] == 0
    assert f"warning: {path}: the sweep has no capture sa, only as\n" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--preset", "worst"], "--preset must be one of paper"),
        (["--seeds", "0"], "--seeds must be 1 to 1000, got 0"),
        (["--per-gpu", "0"], "--per-gpu must be 1 to 1000, got 0"),
        (["--iterations", "1"], "iterations must be a number of at least 3, got 1"),
    ],
)
def test_wrong_options_are_one_line(sweep, capsys, arguments, message):
    assert sweep(*arguments) == (2, [])
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_a_folder_without_weights_of_lpips_is_refused_before_anything_is_trained(sweep, tmp_path, capsys):
    assert sweep("--lpips", str(tmp_path)) == (2, [])
    assert f"{tmp_path} does not hold the weights of LPIPS" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_wrong_type_names_the_file_and_the_whole_option(sweep, tmp_path, capsys):
    (tmp_path / "mine.toml").write_text("variants.a.optim.means = 'x'")
    assert sweep() == (2, [])
    assert capsys.readouterr().err == f"warpgs sweep: {tmp_path}/mine.toml: variant a: optim.means cannot be 'x'\n"


def test_a_built_in_capture_keeps_its_name_in_the_config_of_a_run(finished_run, tmp_path):
    config = dataclasses.replace(read_config(finished_run), data=Path("builtin:room"))
    write_config(tmp_path, config)
    assert read_config(tmp_path).data == Path("builtin:room")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("sweep.json", '{"as-full-seed0": 3}', r"sweep\.json is damaged: it has no command of as-full-seed0"),
        ("sweep.json", '{"as-full-seed0": "warpgs \'"}', r"sweep\.json is damaged: it has no command of"),
        ("cells.csv", "cell,state,error\n" + 200_000 * "a", r"cells\.csv is damaged: field larger than field limit"),
    ],
)
def test_a_damaged_file_of_the_sweep_is_refused_by_name(sweep, tmp_path, capsys, name, content, message):
    assert sweep("--seeds", "1")[0] == 0
    (tmp_path / "out" / name).write_text(content)
    assert sweep("--seeds", "1", "--tables-only")[0] == 2
    assert re.search(message, capsys.readouterr().err)
