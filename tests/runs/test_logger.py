"""Progress on the console and TensorBoard events."""

import errno
import re
import shutil

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from warpgs.runs import logger
from warpgs.runs.logger import TrainingLogger
from warpgs.runs.progress import Status

TERMS = {"static": 0.25, "depth": 0.5}


def status(iteration, **changes):
    values = {"stage": "stage1", "loss": 0.75, "psnr": 21.5, "terms": TERMS, "num_static": 12_345, "num_dynamic": 67}
    return Status(iteration=iteration, **{**values, **changes})


@pytest.fixture
def clock(monkeypatch):
    """The current time, which a test sets [s]."""
    now = [1000.0]
    monkeypatch.setattr(logger.time, "monotonic", lambda: now[0])
    return now


def events(folder):
    accumulator = EventAccumulator(str(folder))
    accumulator.Reload()
    return {tag: [(e.step, e.value) for e in accumulator.Scalars(tag)] for tag in accumulator.Tags()["scalars"]}


def test_a_report_is_one_line(tmp_path, capsys):
    with TrainingLogger(tmp_path, 500, 0) as log:
        log.report(status(50))
    output = capsys.readouterr().out
    assert output.count("\n") == 1
    for part in ("50/500", "stage1", "loss 0.7500", "train PSNR 21.50", "static 12,345", "dynamic 67"):
        assert part in output


@pytest.mark.parametrize(
    ("start", "reports", "speed", "later"),
    [
        (0, {100.0: 100, 20.0: 200}, "1.0", "5.0 it/s  0:01:00"),
        (400, {5.0: 450, 20.0: 460}, "10.0", "0.5 it/s  0:01:20"),
    ],
)
def test_speed_and_remaining_time_cover_the_iterations_since_the_last_report(
    tmp_path, capsys, clock, start, reports, speed, later
):
    with TrainingLogger(tmp_path, 500, start) as log:
        for seconds, iteration in reports.items():
            clock[0] += seconds
            log.report(status(iteration))
    first, second = capsys.readouterr().out.splitlines()
    assert first.endswith(f" {speed} it/s")  # which includes the compilation of kernels
    assert f"{later} left" in second


def test_the_remaining_time_follows_the_mean_speed_of_several_reports(tmp_path, capsys, clock):
    with TrainingLogger(tmp_path, 1000, 0) as log:
        for seconds, iteration in ((99.0, 100), (10.0, 200), (50.0, 300), (12.0, 400)):
            clock[0] += seconds
            log.report(status(iteration))
    assert "8.3 it/s  0:02:24 left" in capsys.readouterr().out.splitlines()[-1]  # 600 iterations at 300 in 72 s


def test_kernels_that_are_compiled_later_do_not_count_as_the_speed_of_what_is_left(tmp_path, capsys, clock):
    with TrainingLogger(tmp_path, 1000, 0) as log:
        for seconds, iteration in ((99.0, 100), (20.0, 200), (20.0, 300), (300.0, 400), (20.0, 500)):
            clock[0] += seconds
            log.report(status(iteration))
    # Five times the median is the most that counts: 500 iterations at 400 in 160 s.
    assert "5.0 it/s  0:03:20 left" in capsys.readouterr().out.splitlines()[-1]


def test_the_remaining_time_counts_iterations_by_their_cost(tmp_path, capsys, clock):
    with TrainingLogger(tmp_path, 400, 0, remaining_cost=lambda done: 400 - done + min(400 - done, 200)) as log:
        for seconds, iteration in ((99.0, 100), (20.0, 200), (40.0, 300)):
            clock[0] += seconds
            log.report(status(iteration))
    *_, before, after = capsys.readouterr().out.splitlines()
    assert "0:01:20 left" in before
    assert "0:00:40 left" in after


def test_after_a_return_to_a_checkpoint_the_speed_is_that_of_the_iterations_since(tmp_path, capsys, clock):
    with TrainingLogger(tmp_path, 500, 0) as log:
        for seconds, iteration in {20.0: 100, 40.0: 200}.items():
            clock[0] += seconds
            log.report(status(iteration))
        log.begin(50)
        for seconds, iteration in {30.0: 80, 60.0: 200}.items():
            clock[0] += seconds
            log.report(status(iteration))
    *_, third, last = capsys.readouterr().out.splitlines()
    assert third.endswith(" 1.0 it/s")
    assert "2.0 it/s  0:02:30 left" in last


def test_lines_have_a_minimum_distance_in_time(tmp_path, capsys, clock):
    with TrainingLogger(tmp_path, 500, 0) as log:
        for iteration in range(10, 70, 10):
            log.report(status(iteration))
            clock[0] += logger.LINE_EVERY / 4
    assert [line.split("/")[0] for line in capsys.readouterr().out.splitlines()] == ["10", "60"]


def test_the_last_iteration_always_has_a_line_and_a_speed_even_without_time_since_the_last(tmp_path, capsys, clock):
    with TrainingLogger(tmp_path, 500, 0) as log:
        log.report(status(499))
        log.report(status(500))
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("500/500")
    assert "it/s" in last


@pytest.mark.parametrize("text", ["[bold]plain[/bold]", "path/[1]/x", "x" * 500])
def test_logged_text_is_printed_verbatim_on_one_line(tmp_path, capsys, text):
    with TrainingLogger(tmp_path, 500, 0) as log:
        log.log(text)
    assert capsys.readouterr().out == f"{text}\n"


def test_events_hold_every_report(tmp_path, clock):
    with TrainingLogger(tmp_path, 500, 0) as log:
        for iteration in (50, 100):
            clock[0] += 5.0
            log.report(status(iteration, psnr=iteration / 10))
    assert events(tmp_path) == {
        "loss/total": [(50, 0.75), (100, 0.75)],
        "loss/static": [(50, 0.25), (100, 0.25)],
        "loss/depth": [(50, 0.5), (100, 0.5)],
        "psnr/train": [(50, 5.0), (100, 10.0)],
        "gaussians/static": [(50, 12_345.0), (100, 12_345.0)],
        "gaussians/dynamic": [(50, 67.0), (100, 67.0)],
        "speed/iterations per second": [(50, 10.0), (100, 10.0)],
    }


def test_events_are_written_when_training_fails(tmp_path):
    def fail():
        with TrainingLogger(tmp_path, 500, 0) as log:
            log.report(status(50))
            raise ValueError("wrong")

    with pytest.raises(ValueError, match="wrong"):
        fail()
    assert events(tmp_path)["loss/total"] == [(50, 0.75)]


def test_a_run_that_goes_on_from_a_checkpoint_replaces_the_events_after_it(tmp_path):
    for start, loss in ((0, 0.75), (100, 0.5)):
        with TrainingLogger(tmp_path, 500, start, quiet=True) as log:
            for iteration in range(start + 50, 201, 50):
                log.report(status(iteration, loss=loss))
    assert events(tmp_path)["loss/total"] == [(50, 0.75), (100, 0.75), (150, 0.5), (200, 0.5)]


def test_a_disk_that_is_full_is_one_error_that_names_the_event_file(tmp_path, monkeypatch):
    def fail(data):
        raise OSError(errno.ENOSPC, "No space left on device")

    with TrainingLogger(tmp_path, 500, 0, quiet=True) as log:
        monkeypatch.setattr(log._events._records, "write", fail)
        with pytest.raises(OSError, match=r"events\.out\.\S+ could not be written: No space left on device$") as raised:
            log.report(status(50))
    assert raised.value.errno == errno.ENOSPC


def test_events_follow_a_folder_that_is_moved(tmp_path):
    with TrainingLogger(tmp_path / "run/events", 500, 0, quiet=True) as log:
        (tmp_path / "run").rename(tmp_path / "moved")
        log.report(status(50))
    assert events(tmp_path / "moved/events")["loss/total"] == [(50, 0.75)]
    assert not (tmp_path / "run").exists()


def test_of_a_folder_that_is_moved_no_events_are_said_to_be_deleted(tmp_path, capsys):
    with TrainingLogger(tmp_path / "run/events", 500, 0) as log:
        (tmp_path / "run").rename(tmp_path / "moved")
        log.report(status(50))
    assert "deleted" not in capsys.readouterr().out


def test_a_folder_of_events_that_is_deleted_is_reported(tmp_path, capsys):
    with TrainingLogger(tmp_path / "run/events", 500, 0) as log:
        shutil.rmtree(tmp_path / "run/events")
        log.report(status(50))
    assert "was deleted: TensorBoard shows nothing" in capsys.readouterr().out


def test_deleted_events_are_reported_once(tmp_path, capsys):
    with TrainingLogger(tmp_path, 500, 0) as log:
        (path,) = tmp_path.iterdir()
        path.unlink()
        for iteration in (50, 100):
            log.report(status(iteration))
    assert capsys.readouterr().out.count(f"warning: {path} was deleted") == 1


def test_a_terminal_shows_a_bar_instead_of_lines(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "200")
    with TrainingLogger(tmp_path, 500, 100) as log:
        log.report(status(150))
        log.log("a line above the bar")
    output = capsys.readouterr().out
    assert "150/500" in output
    assert "a line above the bar" in output
    assert "it/s  " not in output


@pytest.mark.parametrize(("reports", "shown"), [(1, "-:--:--"), (2, "0:00:40")])
def test_the_bar_shows_no_time_left_before_kernels_are_compiled_and_then_that_of_the_speed_since(
    capsys, monkeypatch, clock, reports, shown
):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    with TrainingLogger(None, 500, 0) as log:
        for seconds, iteration in ((300.0, 50), (5.0, 100))[:reports]:
            clock[0] += seconds
            log.report(status(iteration))
    assert re.findall(r"\d:\d\d:\d\d|-:--:--", capsys.readouterr().out)[-1] == shown


@pytest.mark.parametrize("columns", [80, 125, 126])
def test_a_terminal_shows_every_number_in_full(capsys, monkeypatch, clock, columns):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    with TrainingLogger(None, 72_000, 0) as log:
        clock[0] += 6.0  # more than 10,000 iterations per second
        log.report(status(64_850, num_static=1_144_067, num_dynamic=520_150))
    last = re.split(r"[\r\n]", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", capsys.readouterr().out).rstrip())[-1]
    assert "64850/72000" in last
    assert "it/s" in last
    assert re.search(r"\d:\d\d:\d\d|-:--:--", last)
    assert ("1,144,067" if columns == 126 else "1,664,217 Gaussians") in last
    assert "…" not in last
    assert len(last) <= columns


@pytest.mark.parametrize("is_terminal", [False, True])
def test_a_quiet_logger_writes_events_only(tmp_path, capsys, monkeypatch, is_terminal):
    monkeypatch.setattr("sys.stdout.isatty", lambda: is_terminal)
    with TrainingLogger(tmp_path, 500, 0, quiet=True) as log:
        log.report(status(500))
        log.log("nothing")
    assert capsys.readouterr().out == ""
    assert events(tmp_path)["loss/total"] == [(500, 0.75)]


def test_without_a_folder_there_are_no_events(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with TrainingLogger(None, 500, 0, quiet=True) as log:
        log.report(status(50))
        log.add_image("image", np.zeros((2, 2, 3), np.uint8), 50)
    assert list(tmp_path.iterdir()) == []


def test_a_fit_between_iterations_is_shown_by_name_and_its_time_is_none_of_their_speed(capsys, clock):
    with TrainingLogger(None, 500, 0) as log:
        clock[0] += 10.0
        log.report(status(50))
        with log.fitting("fitting what moves") as show:
            for percent in (25, 26, 75, 100):
                clock[0] += 20.0 if percent != 26 else 1.0
                show(percent / 100)
        clock[0] += 10.0
        log.report(status(100))
    assert capsys.readouterr().out.splitlines()[1:] == [
        "fitting what moves: 25%  0:01:00 left",
        "fitting what moves: 75%  0:00:14 left",
        "fitting what moves: 100%  0:00:00 left",
    ]
    assert log._recent[-1] == (50, 10.0)


def test_a_terminal_shows_the_bar_of_a_fit_instead_of_that_of_the_iterations(capsys, monkeypatch, clock):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    with TrainingLogger(None, 500, 0) as log:
        with log.fitting("fitting what moves") as show:
            clock[0] += 30.0
            show(0.25)
            log._bar.refresh()
            during = capsys.readouterr().out
        log._bar.refresh()
        after = capsys.readouterr().out
    assert re.search(r"fitting what moves.* 25/100.*%.*0:01:30", during)
    assert "0/500" not in during.rpartition("fitting what moves")[2]
    assert "0/500" in after


def test_the_bar_of_the_iterations_stays_while_nothing_is_fitted(capsys, monkeypatch):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("rich.console.Console.is_terminal", True)
    with TrainingLogger(None, 500, 0) as log, log.fitting("fitting what moves"):
        log._bar.refresh()
        during = capsys.readouterr().out
    assert "0/500" in during
    assert "fitting what moves" not in during + capsys.readouterr().out
