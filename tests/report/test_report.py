"""The report is one file with the content of the run folders, all of which is escaped."""

import base64
import csv
import dataclasses
import html.parser
import json
import os
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data.captures import edit_json
from tests.errors import error_line
from warpgs.captures.opening import load_capture
from warpgs.cli import main
from warpgs.command_line.version import version
from warpgs.config import TrainConfig
from warpgs.config.presets import PRESETS
from warpgs.evaluation import evaluate_run
from warpgs.report import command
from warpgs.report.charts import HEIGHT, MAX_POINTS, MAX_VALUES, WIDTH, Series, chart
from warpgs.report.evaluated_run import read_runs
from warpgs.report.image_strips import MAX_WIDTH, data_uri, saved_strips, saved_views
from warpgs.report.metrics_table import config_rows, formatted
from warpgs.report.options import Report
from warpgs.report.page import Gallery, page
from warpgs.report.write_report import extremes

pytestmark = pytest.mark.usefixtures("quickly")

EVIL = "<img src=x onerror=alert(1)>&\"'"


@pytest.fixture(scope="module")
def made(finished_run, tmp_path_factory, quickly):
    """An evaluated run."""
    run = shutil.copytree(finished_run, tmp_path_factory.mktemp("made") / "run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evaluate_run, "VIDEO_FRAMES", 2)
        evaluate_run.evaluate_run(run, device="cpu", quiet=True)
    return run


@pytest.fixture
def run(made, tmp_path):
    return shutil.copytree(made, tmp_path / "run")


@pytest.fixture
def other(made, tmp_path):
    return shutil.copytree(made, tmp_path / "other")


class Page(html.parser.HTMLParser):
    """The elements and the words of a page."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.words = [], []
        self.feed(text)
        self.text = " ".join(self.words)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data):
        self.words.append(data.strip())

    def images(self):
        return [attrs["src"] for tag, attrs in self.elements if tag == "img"]

    def tags(self):
        return {tag for tag, _ in self.elements}


def report(tmp_path, *folders, **options):
    out = tmp_path / "report.html"
    command.run(Report(folders, out=out, device="cpu", **options))
    return Page(out.read_text())


def edit_views(run, change):
    with open(run / "views.csv") as file:
        rows = list(csv.DictReader(file))
    change(rows)
    with open(run / "views.csv", "w") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def test_the_report_lists_the_metrics_of_every_view(tmp_path, run):
    page = report(tmp_path, run)
    for view in read_runs([run])[0].views:
        assert view.name in page.words
        assert f"{view.values['psnr']:.2f}" in page.text


def test_a_page_says_when_and_by_which_version_it_was_written():
    (written,) = [words for words in Page(page([], [], "a title")).words if words.startswith("written")]
    assert re.fullmatch(rf"written \d{{4}}-\d\d-\d\d \d\d:\d\d UTC by warpgs {re.escape(version())}", written)


def test_the_report_has_a_chart_of_every_scalar(tmp_path, run):
    page = report(tmp_path, run)
    labels = {attrs.get("aria-label") for tag, attrs in page.elements if tag == "svg"}
    assert {"loss/total", "psnr/train", "gaussians/static", "PSNR [dB] of each view"} <= labels


def test_the_report_shows_the_training_time(tmp_path, run):
    edit_json(run / "metrics.json", train_seconds=3725.4, iterations=32)
    assert "1:02:05" in report(tmp_path, run).words


def test_strips_show_truth_all_layers_and_error(tmp_path, run):
    page = report(tmp_path, run, views=1)
    truth, *_ = images = page.images()[:5]
    assert {decoded(uri).shape for uri in images} == {(24, 32, 3)}
    assert len(set(images)) == 5
    evaluated = read_runs([run])[0]
    name = extremes([evaluated], 1)[0][0]
    frame = load_capture(evaluated.config.data).frame(name)
    assert np.abs(decoded(truth).astype(float) - frame.image.numpy()).mean() < 8  # JPEG
    assert name in page.words


def decoded(uri):
    mime_type, data = uri.split(",")
    assert mime_type == "data:image/jpeg;base64"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def test_worst_and_best_views_are_ordered_by_psnr_and_disjoint(run):
    runs = read_runs([run])
    worst, best = extremes(runs, 2)
    psnr = {view.name: view.values["psnr"] for view in runs[0].views}
    ordered = sorted(psnr, key=psnr.__getitem__)
    assert worst == ordered[:2]
    assert best[0] == ordered[-1]
    assert not set(worst) & set(best)


def test_views_of_several_runs_are_ordered_by_mean_psnr(run, other):
    views = [view.name for view in read_runs([run])[0].views]
    edit_views(run, lambda rows: [row.update(psnr="20") for row in rows])
    edit_views(other, lambda rows: [row.update(psnr=str(10 + views.index(row["name"]))) for row in rows])
    assert extremes(read_runs([run, other]), 1) == ([views[0]], [views[-1]])


def test_runs_of_one_capture_are_shown_side_by_side(tmp_path, run, other):
    page = report(tmp_path, run, other, views=1)
    assert page.text.count("Worst views") == 1
    assert len(page.images()) == 2 * 9  # worst and best; one truth, and four images of each run
    assert {"run", "other"} <= set(page.words)


def test_runs_with_different_views_have_separate_galleries(tmp_path, run, other):
    edit_views(other, lambda rows: rows.pop())
    page = report(tmp_path, run, other, views=1)
    assert page.text.count("Worst views") == 2
    for label in ("run", "other"):
        assert f"Worst and best views of {label}" in page.text


def test_values_of_different_captures_are_not_compared(tmp_path, run, other):
    edit_views(other, lambda rows: rows.pop())
    assert "evaluated on different captures or views" in report(tmp_path, run, other, views=0).text
    assert "class=best" not in (tmp_path / "report.html").read_text()


def test_the_only_value_of_a_metric_is_not_the_better_one(tmp_path, run, other):
    edit_json(run / "metrics.json", ms_ssim=0.987)
    edit_json(other / "metrics.json", ms_ssim=None)
    assert "different captures" not in report(tmp_path, run, other, views=0).text
    assert "<td>0.9870</td>" in (tmp_path / "report.html").read_text()


def test_the_capture_of_the_built_in_scene_has_its_name():
    configs = [TrainConfig(), TrainConfig(data=Path("captures/as"))]
    assert ("data", ["builtin:room", "captures/as"]) in config_rows(configs)


def test_the_better_metric_is_marked(tmp_path, run, other):
    edit_json(run / "metrics.json", psnr=20.0, flicker=0.5)
    edit_json(other / "metrics.json", psnr=30.0, flicker=0.25)
    page = report(tmp_path, run, other, views=0)
    best = [k for k, (tag, attrs) in enumerate(page.elements) if tag == "td" and attrs.get("class") == "best"]
    assert best
    text = (tmp_path / "report.html").read_text()
    assert "<td class=best>30.00</td>" in text
    assert "<td class=best>0.25000</td>" in text


def test_settings_that_differ_are_listed(run, other):
    edit_json(other / "config.json", seed=7, lpips_net="alex")
    runs = read_runs([run, other])
    assert config_rows([evaluated.config for evaluated in runs]) == [("seed", ["0", "7"])]


def test_for_one_run_settings_that_differ_from_the_preset_are_listed():
    config = dataclasses.replace(PRESETS["quick"], seed=3, out=Path("run"))
    assert config_rows([config]) == [("seed", ["3"])]
    assert config_rows([TrainConfig(seed=3)]) == [("seed", ["3"])]


def test_without_views_nothing_is_rendered_and_no_capture_is_read(tmp_path, run):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    assert report(tmp_path, run, views=0).images() == []


def test_without_the_capture_saved_images_are_shown(tmp_path, run):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    page = report(tmp_path, run, views=1)
    assert "only views whose images the evaluation saved" in page.text
    assert {decoded(uri).shape for uri in page.images()} == {(24, 32, 3)}


def test_a_run_that_cannot_be_rendered_does_not_affect_the_others(tmp_path, run, other):
    before = report(tmp_path, run, views=1).images()
    shutil.rmtree(other / "checkpoints")
    page = report(tmp_path, run, other, views=1)
    assert set(before) <= set(page.images())
    assert f"other: only views whose images the evaluation saved: {other} has no checkpoint yet" in page.text
    assert "run: only views" not in page.text


def test_a_report_needs_neither_capture_nor_images(tmp_path, run):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    shutil.rmtree(run / "images")
    assert report(tmp_path, run).images() == []


def test_images_and_metrics_of_different_iterations_are_pointed_out(tmp_path, run):
    edit_json(run / "metrics.json", iterations=20)
    assert "the images are of iteration 32, the metrics of iteration 20" in report(tmp_path, run).text


def test_missing_events_are_pointed_out(tmp_path, run):
    shutil.rmtree(run / "events")
    page = report(tmp_path, run)
    assert "Without TensorBoard events: run" in page.text
    assert "PSNR [dB] of each view" in page.text


def test_a_run_without_evaluation_views_is_reported(tmp_path, run):
    (run / "views.csv").write_text((run / "views.csv").read_text().splitlines()[0] + "\n")
    values = json.loads((run / "metrics.json").read_text())
    (run / "metrics.json").write_text(json.dumps({**values, "psnr": None}))
    assert report(tmp_path, run).images() == []


def test_runs_with_the_same_name_are_labelled_by_their_folders(tmp_path, run):
    twin = shutil.copytree(run, tmp_path / "twin" / "run")
    assert [evaluated.label for evaluated in read_runs([run, twin])] == [str(run), str(twin)]


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("psnr", 25.126, "25.13"),
        ("train_seconds", 59.6, "0:01:00"),
        ("peak_bytes", 3 * 10**9, "3.00"),
        ("num_static", 12345, "12,345"),
        ("lpips", None, "not measured"),
        ("commit", "abc", "abc"),
    ],
)
def test_metrics_are_formatted_with_units(name, value, text):
    assert formatted(name, value) == text


def test_the_page_loads_nothing_and_runs_nothing(tmp_path, run):
    page = report(tmp_path, run)
    assert not page.tags() & {"script", "link", "iframe", "object", "embed", "base", "form"}
    links = ("src", "href", "data", "xlink:href")
    addresses = [attrs[name] for _, attrs in page.elements for name in links if name in attrs]
    assert all(address.startswith("data:image/jpeg;base64,") for address in addresses)
    policy = next(a["content"] for t, a in page.elements if t == "meta" and "http-equiv" in a)
    assert policy.startswith("default-src 'none'")


def test_texts_from_a_run_folder_are_escaped(tmp_path, run, made):
    plain = report(tmp_path, run, views=0)
    evil = shutil.copytree(made, tmp_path / EVIL.replace("/", ""))
    edit_json(evil / "metrics.json", commit=EVIL, lpips_net=EVIL)
    edit_json(evil / "config.json", data=f"/{EVIL}")
    edit_views(evil, lambda rows: rows[0].update(name=EVIL))
    text = (evil / "views.csv").read_text()
    (evil / "views.csv").write_text(text.replace("psnr_static", "<script>x</script>", 1))
    page = report(tmp_path, evil, views=0)
    assert page.tags() == plain.tags()
    assert not [attrs for _, attrs in page.elements if "onerror" in attrs]
    assert EVIL in page.words


def test_a_report_shows_what_was_noted_before_the_first_step(tmp_path, run):
    notes = ["depth is off by 1.0% at the sparse points", "the capture has no masks"]
    edit_json(run / "metrics.json", notes=notes)
    assert "; ".join(notes) in report(tmp_path, run, views=0).words


def test_tags_of_curves_are_escaped():
    svg = chart(EVIL, EVIL, [Series(EVIL, "red", [(0.0, 1.0), (1.0, 2.0)])])
    page = Page(svg)
    assert page.tags() == {"svg", "text", "line", "polyline", "circle", "title"}
    assert EVIL in page.words


def test_images_outside_of_the_run_folder_are_not_shown(run):
    shutil.copy(next((run / "images").iterdir()), run / "secret.png")
    edit_views(run, lambda rows: rows[0].update(name="../secret"))
    assert "../secret" not in saved_views(read_runs([run])[0])


def test_large_images_are_scaled_down():
    assert decoded(data_uri(np.zeros((100, 2 * MAX_WIDTH, 3), np.uint8))).shape == (50, MAX_WIDTH, 3)


def points_of(svg):
    curves = [attrs["points"].split() for tag, attrs in Page(svg).elements if tag == "polyline"]
    return [[tuple(map(float, at.split(","))) for at in curve] for curve in curves]


LONG = [(float(k), float(k % 7)) for k in range(5 * MAX_POINTS + 3)]


@pytest.mark.parametrize("points", [[(0.0, 1.0)], [(0.0, 0.0), (5.0, 0.0)], [(3.0, -1e-9), (3.0, 1e9)], LONG])
def test_a_curve_lies_inside_its_chart(points):
    for curve in points_of(chart("c", "x", [Series("s", "red", points)])):
        assert all(0 <= x <= WIDTH and 0 <= y <= HEIGHT for x, y in curve)
        assert len(curve) <= MAX_POINTS


@pytest.mark.parametrize("dots", [False, True])
def test_values_are_shown_under_the_pointer(dots):
    svg = chart("psnr/train", "iteration", [Series("run", "red", [(50.0, 21.5), (100.0, 23.25)])], dots)
    assert "<title>run, iteration 50: 21.5</title>" in svg
    assert "<title>run, iteration 100: 23.25</title>" in svg


def test_long_curves_show_the_values_of_some_points():
    svg = chart("c", "x", [Series("s", "red", [(float(k), float(k)) for k in range(3000)])])
    assert 30 < svg.count("<circle") <= MAX_VALUES


def test_every_image_can_be_enlarged_without_a_script(tmp_path, run):
    page = report(tmp_path, run, views=1)
    boxes = [attrs for tag, attrs in page.elements if tag == "input" and attrs.get("type") == "checkbox"]
    assert len(boxes) == len(page.images()) > 4
    assert all(attrs["aria-label"].startswith("enlarge: ") for attrs in boxes)
    assert "script" not in page.tags()


def test_larger_values_are_plotted_higher():
    ((_, low), (_, high)) = points_of(chart("c", "x", [Series("s", "red", [(0.0, 1.0), (1.0, 2.0)])]))[0]
    assert high < low


def test_curves_share_their_axes():
    one, two = points_of(chart("c", "x", [Series("a", "red", [(0, 0), (2, 2)]), Series("b", "blue", [(1, 1)])]))
    assert two[0] == pytest.approx(np.mean(one, axis=0))


def test_without_points_there_is_no_chart():
    assert chart("c", "x", [Series("s", "red", [])]) == ""


def test_a_report_without_runs_is_refused(capsys):
    assert "at least one run folder" in error_line(capsys, "report")


def test_a_run_given_twice_is_refused(capsys, run):
    assert "is given twice" in error_line(capsys, "report", run, run)


@pytest.mark.parametrize("name", ["metrics.json", "views.csv"])
def test_a_run_that_was_not_evaluated_is_refused_with_the_remedy(capsys, run, name):
    (run / name).unlink()
    error = error_line(capsys, "report", run)
    assert f"{run} has no {name}" in error
    assert "warpgs eval" in error


NOT_JSON = [(name, data) for name in ("metrics.json", "config.json") for data in (b"", b"{", b"\xff\xfe\x00")]


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        *((name, data, f"{name} is not valid JSON") for name, data in NOT_JSON),
        ("metrics.json", b"[]", "metrics.json must hold a JSON object, got list"),
        ("metrics.json", b"3", "metrics.json must hold a JSON object, got int"),
        ("metrics.json", b'{"psnr": [1]}', "metrics.json is damaged: expected an object with numbers and strings"),
        ("views.csv", b"name,time,psnr\na,0\n", "line 2 has 2 columns, not 3"),
        ("views.csv", b"name,time,psnr\na,0,high\n", "line 2: psnr cannot be 'high'"),
        ("views.csv", b'name,time,psnr\n"a', "is damaged"),
        ("views.csv", b"", "it has no name, time, psnr"),
        ("views.csv", b"name,time\na,0\n", "columns of another version: it has no psnr"),
    ],
)
def test_a_damaged_file_is_refused_with_its_name_and_what_is_wrong(capsys, run, name, data, message):
    (run / name).write_bytes(data)
    error = error_line(capsys, "report", run)
    assert name in error
    assert message in error


def test_a_text_in_place_of_a_metric_is_refused(capsys, run):
    (run / "metrics.json").write_text('{"device": "A", "psnr": "B"}')
    assert f"{run / 'metrics.json'} is damaged: 'psnr' cannot be 'B'" in error_line(capsys, "report", run, "--views", 0)


@pytest.mark.parametrize("number", ["Infinity", "-Infinity", "NaN", "1" + 400 * "0", "1" + 5000 * "0"])
@pytest.mark.parametrize("name", ["train_seconds", "peak_bytes", "psnr"])
def test_impossible_metrics_of_a_run_are_refused(capsys, run, name, number):
    (run / "metrics.json").write_text(f'{{"{name}": {number}}}')
    reason = "is not valid JSON" if len(number) > 5000 else "is damaged"  # Python parses no longer integers
    assert f"{run / 'metrics.json'} {reason}" in error_line(capsys, "report", run, "--views", 0)


@pytest.mark.parametrize("name", ["psnr", "ssim", "time"])
@pytest.mark.parametrize("number", ["1.7e308", "-1.7e308", "-inf"])
def test_impossible_metrics_of_a_view_are_refused(capsys, run, name, number):
    edit_views(run, lambda rows: rows[1].update({name: number}))
    assert f"views.csv: line 3: {name} cannot be" in error_line(capsys, "report", run)


def test_a_perfect_view_is_reported(tmp_path, run):
    edit_views(run, lambda rows: rows[0].update(psnr="inf"))
    assert "inf dB" in report(tmp_path, run, views=1).text


@pytest.mark.parametrize("number", ["1" + 400 * "0", "1" + 5000 * "0", "Infinity"])
@pytest.mark.parametrize("name", ["resident_bytes", "seed", "optim.means"])
def test_impossible_settings_are_refused(capsys, run, name, number):
    first, _, rest = name.partition(".")
    values = json.loads((run / "config.json").read_text())
    if rest:
        values[first][rest] = "HERE"
    else:
        values[first] = "HERE"
    (run / "config.json").write_text(json.dumps(values).replace('"HERE"', number))
    assert f"{run / 'config.json'}" in error_line(capsys, "report", run, "--views", 0)


@pytest.mark.parametrize("name", ["metrics.json", "views.csv", "config.json"])
def test_a_device_is_not_read(capsys, run, name):
    """Reading it would never end, although its size is 0."""
    (run / name).unlink()
    (run / name).symlink_to("/dev/zero")
    assert f"{run / name} is not a file" in error_line(capsys, "report", run)


@pytest.mark.parametrize("damaged", [lambda data: data[:-20], lambda data: b"nonsense" * 100], ids=["cut", "nonsense"])
def test_truncated_events_are_read_up_to_their_end_and_invalid_ones_ignored(tmp_path, run, damaged):
    path = next((run / "events").iterdir())
    path.write_bytes(damaged(path.read_bytes()))
    assert "PSNR [dB] of each view" in report(tmp_path, run, views=0).text


def test_a_fifo_among_the_events_is_refused(capsys, run):
    os.mkfifo(run / "events" / "events.out.tfevents.9")
    assert "tfevents.9 is not a file" in error_line(capsys, "report", run)


def test_a_saved_image_that_is_damaged_or_of_absurd_size_is_not_shown(tmp_path, run):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    paths = sorted(run.glob("images/**/*.png"))
    assert paths
    for path in paths:
        path.write_bytes(path.read_bytes()[:-20])
    assert report(tmp_path, run, views=1).images() == []


def test_an_output_that_cannot_be_written_is_reported_in_one_line(capsys, run, tmp_path):
    (tmp_path / "taken").mkdir()
    assert "taken could not be written" in error_line(capsys, "report", run, "--out", tmp_path / "taken", "--views", 0)


def test_a_negative_number_of_views_is_refused(capsys, run):
    assert "--views must not be negative" in error_line(capsys, "report", run, "--views", -1)


def test_the_report_of_one_run_is_written_into_its_folder(run, capsys):
    assert main(["report", str(run), "--views", "0"]) == 0
    assert f"{run / 'report.html'}: " in capsys.readouterr().out
    assert (run / "report.html").is_file()


def test_a_report_of_several_runs_shows_the_mean_that_it_orders_by_and_says_a_note_once(tmp_path, run):
    def shift(rows):
        for row in rows:
            row["psnr"] = float(row["psnr"]) + 2.0

    folders = [run, *(shutil.copytree(run, tmp_path / name) for name in ("second", "third"))]
    edit_views(folders[1], shift)
    runs = read_runs(folders)
    worst, _ = extremes(runs, 1, saved_views(runs[0]))
    strips = [saved_strips(own, worst, "nothing is rendered") for own in runs]
    shown = Page(page(runs, [Gallery([0, 1, 2], worst, [], strips)]))
    known = [view.values["psnr"] for own in runs for view in own.views if view.name == worst[0]]
    assert f"mean {sum(known) / 3:.2f} dB" in shown.text
    assert "Ordered by the mean PSNR of the runs." in shown.text
    assert shown.text.count("only views whose images the evaluation saved: nothing is rendered") == 1
    strips[2] = saved_strips(runs[2], worst, "it is lost")
    shown = Page(page(runs, [Gallery([0, 1, 2], worst, [], strips)]))
    assert "run, second: only views whose images the evaluation saved: nothing is rendered" in shown.text
    assert "third: only views whose images the evaluation saved: it is lost" in shown.text


def test_every_table_of_a_report_scrolls_inside_of_the_page(tmp_path, run):
    page = report(tmp_path, run)
    containers = [attrs.get("class") for tag, attrs in page.elements if tag == "div"]
    tables = [tag for tag, _ in page.elements if tag == "table"]
    assert sum(name in ("wide", "strips") for name in containers) == len(tables) > 2
