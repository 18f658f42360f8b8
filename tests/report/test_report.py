"""The report is one file that says what the runs' folders say, and nothing in them can speak in its name."""

import base64
import csv
import dataclasses
import html.parser
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.tiny import quickly  # noqa: F401
from warpgs.cli import main
from warpgs.config import PRESETS
from warpgs.data.loaders import load_capture
from warpgs.report.charts import HEIGHT, MAX_POINTS, WIDTH, Series, chart
from warpgs.report.command import Report, extremes
from warpgs.report.figures import config_rows, in_words
from warpgs.report.record import read_records
from warpgs.report.strips import WIDEST, available, data_uri

pytestmark = pytest.mark.usefixtures("quickly")

EVIL = "<img src=x onerror=alert(1)>&\"'"


@pytest.fixture(scope="module")
def made(finished_run, tmp_path_factory, quickly):  # noqa: F811
    """A run that was evaluated, too."""
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
    """What a browser sees of a page: its elements and its words."""

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
    Report(folders, out=out, device="cpu", **options).run()
    return Page(out.read_text())


def refusal(capsys, *arguments):
    """The one line that the command ends with."""
    assert main(["report", *map(str, arguments)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def edit_views(run, change):
    with open(run / "views.csv") as file:
        rows = list(csv.DictReader(file))
    change(rows)
    with open(run / "views.csv", "w") as file:
        writer = csv.DictWriter(file, rows[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def edit_json(path, **changes):
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


# What it says --------------------------------------------------------------------------------------------------------


def test_every_view_and_its_figures_are_there(tmp_path, run):
    page = report(tmp_path, run)
    for view in read_records([run])[0].views:
        assert view.name in page.words
        assert f"{view.figures['psnr']:.2f}" in page.text


def test_all_scalars_are_curves(tmp_path, run):
    page = report(tmp_path, run)
    labels = {attrs.get("aria-label") for tag, attrs in page.elements if tag == "svg"}
    assert {"loss/total", "psnr/train", "gaussians/static", "PSNR [dB] of each view"} <= labels


def test_timing_is_there(tmp_path, run):
    edit_json(run / "metrics.json", train_seconds=3725.4, iterations=32)
    assert "1:02:05" in report(tmp_path, run).words


def test_strips_are_pictures_of_truth_ours_and_error(tmp_path, run):
    page = report(tmp_path, run, views=1)
    truth, ours, error = page.images()[:3]
    sizes = {decoded(uri).shape for uri in (truth, ours, error)}
    assert sizes == {(24, 32, 3)}
    record = read_records([run])[0]
    name = extremes([record], 1)[0][0]
    frame = load_capture(record.config.data).frame(name)
    assert np.abs(decoded(truth).astype(float) - frame.image.numpy()).mean() < 8  # JPEG
    assert f"{name}" in page.words


def decoded(uri):
    kind, data = uri.split(",")
    assert kind == "data:image/jpeg;base64"
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def test_worst_views_are_those_of_lowest_psnr_and_no_view_is_both(run):
    records = read_records([run])
    worst, best = extremes(records, 2)
    psnr = {view.name: view.figures["psnr"] for view in records[0].views}
    ordered = sorted(psnr, key=psnr.__getitem__)
    assert worst == ordered[:2]
    assert best[0] == ordered[-1]
    assert not set(worst) & set(best)


def test_extremes_are_of_the_mean_over_runs(run, other):
    views = [view.name for view in read_records([run])[0].views]
    edit_views(run, lambda rows: [row.update(psnr="20") for row in rows])
    edit_views(other, lambda rows: [row.update(psnr=str(10 + views.index(row["name"]))) for row in rows])
    assert extremes(read_records([run, other]), 1) == ([views[0]], [views[-1]])


def test_runs_of_one_capture_are_side_by_side(tmp_path, run, other):
    page = report(tmp_path, run, other, views=1)
    assert page.text.count("Worst views") == 1
    assert len(page.images()) == 2 * 5  # worst and best; one truth, and two pictures of each run
    assert {"run", "other"} <= set(page.words)


def test_runs_of_different_views_have_galleries_of_their_own(tmp_path, run, other):
    edit_views(other, lambda rows: rows.pop())
    assert report(tmp_path, run, other, views=1).text.count("Worst views") == 2


def test_the_better_figure_is_marked(tmp_path, run, other):
    edit_json(run / "metrics.json", psnr=20.0, flicker=0.5)
    edit_json(other / "metrics.json", psnr=30.0, flicker=0.25)
    page = report(tmp_path, run, other, views=0)
    best = [k for k, (tag, attrs) in enumerate(page.elements) if tag == "td" and attrs.get("class") == "best"]
    assert best
    text = (tmp_path / "report.html").read_text()
    assert "<td class=best>30.00</td>" in text
    assert "<td class=best>0.25000</td>" in text


def test_settings_that_differ_are_listed(run, other):
    edit_json(other / "config.json", seed=7)
    records = read_records([run, other])
    assert config_rows([record.config for record in records]) == [("seed", ["0", "7"])]


def test_of_one_run_settings_other_than_the_presets_are_listed():
    config = dataclasses.replace(PRESETS["quick"], seed=3, out=Path("run"))
    assert config_rows([config]) == [("seed", ["3"])]


def test_without_views_no_picture_is_rendered_and_no_capture_read(tmp_path, run):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    assert report(tmp_path, run, views=0).images() == []


def test_without_the_capture_pictures_come_from_the_run_folder(tmp_path, run):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    page = report(tmp_path, run, views=1)
    assert "only views whose pictures the evaluation kept" in page.text
    assert {decoded(uri).shape for uri in page.images()} == {(24, 32, 3)}


def test_a_run_that_can_not_be_rendered_leaves_the_pictures_of_the_others(tmp_path, run, other):
    before = report(tmp_path, run, views=1).images()
    shutil.rmtree(other / "checkpoints")
    page = report(tmp_path, run, other, views=1)
    assert set(before) <= set(page.images())
    assert f"other: only views whose pictures the evaluation kept: {other} has no checkpoint yet" in page.text
    assert "run: only views" not in page.text


def test_without_capture_and_pictures_there_is_still_a_report(tmp_path, run):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    shutil.rmtree(run / "pictures")
    assert report(tmp_path, run).images() == []


def test_figures_of_another_iteration_than_the_pictures_are_pointed_out(tmp_path, run):
    edit_json(run / "metrics.json", iterations=20)
    assert "pictures are of iteration 32, figures of iteration 20" in report(tmp_path, run).text


def test_without_events_there_are_no_training_curves_and_it_says_so(tmp_path, run):
    shutil.rmtree(run / "events")
    page = report(tmp_path, run)
    assert "Without TensorBoard events: run" in page.text
    assert "PSNR [dB] of each view" in page.text


def test_a_run_without_evaluation_views_is_reported(tmp_path, run):
    (run / "views.csv").write_text((run / "views.csv").read_text().splitlines()[0] + "\n")
    edit_json(run / "metrics.json", psnr=None)
    assert report(tmp_path, run).images() == []


def test_runs_of_one_name_are_told_apart(tmp_path, run):
    twin = shutil.copytree(run, tmp_path / "twin" / "run")
    assert [record.label for record in read_records([run, twin])] == [str(run), str(twin)]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("psnr", 25.126, "25.13"),
        ("train_seconds", 59.6, "0:01:00"),
        ("peak_bytes", 3 * 10**9, "3.00 GB"),
        ("num_static", 12345, "12,345"),
        ("lpips", None, "not measured"),
        ("commit", "abc", "abc"),
    ],
)
def test_figures_are_said_in_units(name, value, words):
    assert in_words(name, value) == words


# One file, safe ------------------------------------------------------------------------------------------------------


def test_the_page_loads_nothing_and_runs_nothing(tmp_path, run):
    page = report(tmp_path, run)
    assert not page.tags() & {"script", "link", "iframe", "object", "embed", "base", "form"}
    addresses = [
        v for _, attrs in page.elements for k, v in attrs.items() if k in ("src", "href", "data", "xlink:href")
    ]
    assert all(address.startswith("data:image/jpeg;base64,") for address in addresses)
    policy = next(a["content"] for t, a in page.elements if t == "meta" and "http-equiv" in a)
    assert policy.startswith("default-src 'none'")


def test_nothing_in_a_run_folder_becomes_an_element_of_the_page(tmp_path, run, made):
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


def test_tags_of_curves_are_escaped():
    drawn = chart(EVIL, EVIL, [Series(EVIL, "red", [(0.0, 1.0), (1.0, 2.0)])])
    page = Page(drawn)
    assert page.tags() == {"svg", "text", "line", "polyline", "title"}
    assert EVIL in page.words


def test_no_picture_outside_of_the_run_folder_is_shown(run):
    shutil.copy(next((run / "pictures").iterdir()), run / "secret.png")
    edit_views(run, lambda rows: rows[0].update(name="../secret"))
    assert "../secret" not in available(read_records([run])[0])


def test_large_pictures_are_scaled_down():
    assert decoded(data_uri(np.zeros((100, 2 * WIDEST, 3), np.uint8))).shape == (50, WIDEST, 3)


# Curves --------------------------------------------------------------------------------------------------------------


def points_of(drawn):
    return [
        [tuple(map(float, at.split(","))) for at in attrs["points"].split()]
        for tag, attrs in Page(drawn).elements
        if tag == "polyline"
    ]


@pytest.mark.parametrize(
    "points",
    [
        [(0.0, 1.0)],
        [(0.0, 0.0), (5.0, 0.0)],
        [(3.0, -1e-9), (3.0, 1e9)],
        [(float(k), float(k % 7)) for k in range(5 * MAX_POINTS + 3)],
    ],
)
def test_a_curve_is_inside_its_chart(points):
    for curve in points_of(chart("c", "x", [Series("s", "red", points)])):
        assert all(0 <= x <= WIDTH and 0 <= y <= HEIGHT for x, y in curve)
        assert len(curve) <= MAX_POINTS


def test_higher_values_are_drawn_higher():
    ((_, low), (_, high)) = points_of(chart("c", "x", [Series("s", "red", [(0.0, 1.0), (1.0, 2.0)])]))[0]
    assert high < low


def test_curves_share_their_axes():
    one, two = points_of(chart("c", "x", [Series("a", "red", [(0, 0), (2, 2)]), Series("b", "blue", [(1, 1)])]))
    assert two[0] == pytest.approx(np.mean(one, axis=0))


def test_no_points_are_no_chart():
    assert chart("c", "x", [Series("s", "red", [])]) == ""


# What it refuses -----------------------------------------------------------------------------------------------------


def test_no_run_is_refused(capsys):
    assert "at least one run folder" in refusal(capsys)


def test_a_run_twice_is_refused(capsys, run):
    assert "is there twice" in refusal(capsys, run, run)


def test_what_is_no_run_is_refused(capsys, tmp_path):
    assert "is no run folder" in refusal(capsys, tmp_path)


@pytest.mark.parametrize("name", ["metrics.json", "views.csv"])
def test_a_run_that_was_not_evaluated_is_refused_with_the_way_out(capsys, run, name):
    (run / name).unlink()
    said = refusal(capsys, run)
    assert f"{run} has no {name}" in said
    assert "warpgs eval" in said


@pytest.mark.parametrize("name", ["metrics.json", "config.json"])
@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe\x00"])
def test_a_damaged_file_is_named(capsys, run, name, content):
    (run / name).write_bytes(content)
    assert f"{name} is damaged" in refusal(capsys, run)


@pytest.mark.parametrize("text", ["[]", "3", '{"psnr": [1]}'])
def test_metrics_that_are_none_are_named(capsys, run, text):
    (run / "metrics.json").write_text(text)
    assert "metrics.json is damaged: expected an object" in refusal(capsys, run)


@pytest.mark.parametrize("number", ["Infinity", "-Infinity", "NaN", "1" + 400 * "0", "1" + 5000 * "0"])
@pytest.mark.parametrize("name", ["train_seconds", "peak_bytes", "psnr"])
def test_metrics_that_no_run_has_are_named(capsys, run, name, number):
    (run / "metrics.json").write_text(f'{{"{name}": {number}}}')
    assert f"{run / 'metrics.json'} is damaged" in refusal(capsys, run, "--views", 0)


@pytest.mark.parametrize("name", ["psnr", "ssim", "time"])
@pytest.mark.parametrize("number", ["1.7e308", "-1.7e308", "-inf"])
def test_figures_that_no_view_has_are_named(capsys, run, name, number):
    edit_views(run, lambda rows: rows[1].update({name: number}))
    assert f"views.csv: line 3: {name} can't be" in refusal(capsys, run)


def test_a_perfect_view_is_reported(tmp_path, run):
    edit_views(run, lambda rows: rows[0].update(psnr="inf"))
    assert "inf dB" in report(tmp_path, run, views=1).text


@pytest.mark.parametrize("number", ["1" + 400 * "0", "1" + 5000 * "0", "Infinity"])
@pytest.mark.parametrize("name", ["resident_bytes", "seed", "optim.means"])
def test_settings_that_no_run_has_are_named(capsys, run, name, number):
    first, _, rest = name.partition(".")
    values = json.loads((run / "config.json").read_text())
    if rest:
        values[first][rest] = "HERE"
    else:
        values[first] = "HERE"
    (run / "config.json").write_text(json.dumps(values).replace('"HERE"', number))
    assert f"{run / 'config.json'}" in refusal(capsys, run, "--views", 0)


@pytest.mark.parametrize("name", ["metrics.json", "views.csv", "config.json"])
def test_a_device_is_not_read(capsys, run, name):
    """It would never end; its size is 0."""
    (run / name).unlink()
    (run / name).symlink_to("/dev/zero")
    assert f"{run / name} is no file" in refusal(capsys, run)


def test_views_without_a_column_are_of_another_version(capsys, run):
    (run / "views.csv").write_text("name,time\na,0\n")
    assert "columns of another version: it has no psnr" in refusal(capsys, run)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("name,time,psnr\na,0\n", "line 2 has 2 columns, not 3"),
        ("name,time,psnr\na,0,high\n", "line 2: psnr can't be 'high'"),
        ('name,time,psnr\n"a', "is damaged"),
        ("", "it has no name, time, psnr"),
    ],
)
def test_damaged_views_are_named_with_their_line(capsys, run, text, reason):
    (run / "views.csv").write_text(text)
    said = refusal(capsys, run)
    assert "views.csv" in said
    assert reason in said


def test_a_config_of_another_version_is_refused(capsys, run):
    edit_json(run / "config.json", future=1)
    assert "fields of another version: future" in refusal(capsys, run)


def test_events_that_are_cut_off_are_read_as_far_as_they_go(tmp_path, run):
    path = next((run / "events").iterdir())
    path.write_bytes(path.read_bytes()[:-20])
    assert "PSNR [dB] of each view" in report(tmp_path, run, views=0).text


def test_events_that_are_none_do_not_keep_a_report_from_being_made(tmp_path, run):
    path = next((run / "events").iterdir())
    path.write_bytes(b"nonsense" * 100)
    assert "PSNR [dB] of each view" in report(tmp_path, run, views=0).text


def test_a_place_that_cannot_be_written_is_one_line(capsys, run, tmp_path):
    (tmp_path / "taken").mkdir()
    assert "taken could not be written" in refusal(capsys, run, "--out", tmp_path / "taken", "--views", 0)


def test_a_negative_number_of_views_is_refused(capsys, run):
    assert "--views must not be negative" in refusal(capsys, run, "--views", -1)


def test_the_report_of_one_run_goes_into_its_folder(run, capsys):
    assert main(["report", str(run), "--views", "0"]) == 0
    assert f"{run / 'report.html'}: " in capsys.readouterr().out
    assert (run / "report.html").is_file()
