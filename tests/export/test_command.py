"""``warpgs export``: the files of a run, and a line for what can't be exported."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

from tests import tiny
from tests.export import scenes
from tests.export.pages import read_page
from warpgs.cli import main
from warpgs.data.loaders import load_capture
from warpgs.export import command as command_module
from warpgs.export import opening, page
from warpgs.export.command import Export, export_run
from warpgs.export.compressed import read_compressed
from warpgs.export.standard import read_standard
from warpgs.runs import checkpoint
from warpgs.runs import run as runs
from warpgs.runs.trained import Player
from warpgs.video import camera_paths as paths

pytestmark = pytest.mark.usefixtures("quickly")
quickly = tiny.quickly


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return shutil.copytree(finished_run, tmp_path_factory.mktemp("runs") / "the run")


@pytest.fixture(scope="module")
def data(run):
    return read_config(run).data


def export(run, tmp_path, **options):
    return export_run(Export(run, out=tmp_path / "out", quiet=True, **options))


def names(tmp_path):
    return sorted(path.name for path in (tmp_path / "out").iterdir())


def view(data, time):
    capture = load_capture(data)
    return dataclasses.replace(capture.cameras[capture.val[0]], time=time)


def truth(run, camera):
    config = read_config(run)
    scene, facts = runs.newest_scene(run, config)
    return Player(scene, config, facts)(camera, False).joint.image.clamp(0, 1)


# Files --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("time", [0.0, 0.7])
def test_a_ply_file_looks_as_the_run_does_at_its_moment(run, data, tmp_path, time):
    assert "1 file of " in export(run, tmp_path, time=time)
    camera = view(data, time)
    assert (scenes.image(read_standard(tmp_path / "out" / "scene.ply"), camera) - truth(run, camera)).abs().max() < 1e-4


def test_a_compressed_file_nearly_does(run, data, tmp_path):
    export(run, tmp_path, format="compressed", time=0.4)
    camera = view(data, 0.4)
    image = scenes.image(read_compressed(tmp_path / "out" / "scene.compressed.ply"), camera)
    assert scenes.psnr(image, truth(run, camera)) > 35


def test_a_page_nearly_does(run, data, tmp_path):
    said = export(run, tmp_path, format="html", keys=3)
    assert "at 3 key times" in said
    assert "the cameras are those of" in said
    camera = view(data, 0.5)
    assert (
        scenes.psnr(scenes.image(read_page(tmp_path / "out" / "scene.html").at(0.5), camera), truth(run, camera)) > 45
    )


def test_branches_apart_are_together_the_scene(run, tmp_path):
    export(run, tmp_path, layers="apart")
    moments = Moments.of_run(run)
    static, dynamic = (len(read_standard(tmp_path / "out" / f"{name}.ply")) for name in ("static", "dynamic"))
    assert [static, dynamic] == [len(moments.scene.static), len(moments.scene.dynamic)]


@pytest.mark.parametrize("layers", ["static", "dynamic"])
def test_one_branch_alone_is_one_file(run, tmp_path, layers):
    export(run, tmp_path, layers=layers)
    assert names(tmp_path) == [f"{layers}.ply"]


def test_a_sequence_has_a_file_for_every_moment(run, tmp_path):
    assert "3 files" in export(run, tmp_path, frames=3, layers="dynamic")
    assert names(tmp_path) == [f"dynamic_0000{k}.ply" for k in range(3)]
    moments = Moments.of_run(run)
    for k in range(3):
        cloud = moments.at(k / 2)
        assert (read_standard(tmp_path / "out" / names(tmp_path)[k]).means == cloud.means[cloud.is_dynamic]).all()


def test_a_shorter_sequence_leaves_nothing_of_a_longer_one(run, tmp_path):
    export(run, tmp_path, frames=4, layers="dynamic")
    export(run, tmp_path, frames=2, layers="static")
    export(run, tmp_path, frames=2, layers="dynamic")
    assert names(tmp_path) == ["dynamic_00000.ply", "dynamic_00001.ply", "static_00000.ply", "static_00001.ply"]


def test_a_run_folder_without_a_name_gives_a_page_its_own(run, monkeypatch):
    monkeypatch.chdir(run)
    moments = Moments.of_run(Path())
    assert opening.opening(moments, None, keys=2, seconds=1.0).title == "the run"


@pytest.mark.parametrize("options", [{"max_gaussians": 9}, {}])
def test_a_page_opens_its_capture_once(run, tmp_path, monkeypatch, options):
    opened, open_capture = [], runs.open_capture
    monkeypatch.setattr(runs, "open_capture", lambda *told: opened.append(told) or open_capture(*told))
    export(run, tmp_path, format="html", keys=1, **options)
    assert len(opened) == 1


def test_a_page_of_too_many_gaussians_is_refused_before_anything_is_baked(run, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MAX_GAUSSIANS", 3)
    monkeypatch.setattr(command_module, "bake", lambda *_: pytest.fail("baked"))
    monkeypatch.setattr(command_module, "find_capture", lambda *_: pytest.fail("opened"))
    with pytest.raises(ValueError, match="a page holds at most 3 static Gaussians"):
        export(run, tmp_path, format="html")


def test_files_go_into_the_run_folder_by_default(run):
    export_run(Export(run, quiet=True))
    assert (run / "export" / "scene.ply").is_file()


def test_no_more_gaussians_are_written_than_asked_for(run, tmp_path):
    export(run, tmp_path, max_gaussians=12)
    assert len(read_standard(tmp_path / "out" / "scene.ply")) == 12


def test_a_page_begins_at_the_middle_view_and_follows_the_filming_camera(run, data):
    moments = Moments.of_run(run)
    capture, _ = opening.find_capture(moments, quiet=True)
    start = opening.opening(moments, capture, keys=4, seconds=2.0)
    assert start.viewmat == capture.cameras[capture.val[len(capture.val) // 2]].viewmat.tolist()
    assert len(start.track) == 4
    assert start.title == "the run"


# A capture that is elsewhere ----------------------------------------------------------------------------------------


@pytest.fixture
def stranded(run, tmp_path):
    """A run whose capture is not where it was."""
    folder = tmp_path / "stranded"
    (folder / "checkpoints").mkdir(parents=True)
    newest = checkpoint.list_checkpoints(run)[-1]
    (folder / "checkpoints" / newest.name).write_bytes(newest.read_bytes())
    values = json.loads((run / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({**values, "data": str(tmp_path / "gone")}))
    return folder


def test_ply_files_need_no_capture(stranded, tmp_path):
    export(stranded, tmp_path, frames=2)
    assert len(names(tmp_path)) == 2


def test_a_page_without_a_capture_begins_at_a_guess_that_sees_the_scene(stranded, tmp_path):
    assert "the cameras are guessed, because the capture is not at hand" in export(stranded, tmp_path, format="html")
    moments = Moments.of_run(stranded)
    camera = paths.default_camera(paths.Ball.around(moments.scene.static.means.detach()))
    inside = camera.project(moments.scene.static.means.detach())[3]
    assert inside.float().mean() > 0.7


def test_gaussians_are_left_out_without_a_capture(stranded, tmp_path):
    export(stranded, tmp_path, max_gaussians=9)
    assert len(read_standard(tmp_path / "out" / "scene.ply")) == 9


def test_a_capture_may_be_told_anew(stranded, data, tmp_path):
    assert "the cameras are those of" in export(stranded, tmp_path, format="html", keys=2, data=data)


# Refusals -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"time": 1.1}, "--time must be in"),
        ({"time": float("nan")}, "--time must be in"),
        ({"frames": 0}, "--frames must be between 1 and"),
        ({"format": "html", "keys": 0}, "--keys must be between 1 and 256"),
        ({"format": "html", "keys": 257}, "--keys must be between 1 and 256"),
        ({"format": "html", "seconds": 0.0}, "--seconds must be positive"),
        ({"format": "html", "frames": 3}, "--frames is for PLY files"),
        ({"format": "html", "time": 0.0}, "--time is for PLY files"),
        ({"frames": 3, "time": 0.5}, "leave out --time"),
        ({"keys": 30}, "--keys is for --format html"),
        ({"seconds": 5.0}, "--seconds is for --format html"),
        ({"max_megabytes": 256.0}, "--max-megabytes is for --format html"),
        ({"format": "html", "layers": "static"}, "--layers is for PLY files"),
        ({"max_gaussians": 0}, "--max-gaussians must be at least 1"),
        ({"format": "html", "max_megabytes": -1.0}, "--max-megabytes must be positive"),
        ({"format": "html", "max_megabytes": 0.001}, r"the page would hold .* use about --max-gaussians \d+"),
    ],
)
def test_what_can_not_be_done_is_refused_in_words_and_nothing_is_written(run, tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        export(run, tmp_path, **options)
    assert not (tmp_path / "out").exists()


def test_a_folder_of_data_that_is_not_there_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match=r"--data .*nowhere is no folder"):
        export(run, tmp_path, data=tmp_path / "nowhere")


def command(run, capsys, *options):
    """Exit code and what is said of an error."""
    return main(["export", str(run), *options]), capsys.readouterr().err


def test_a_folder_that_is_no_run_ends_the_command_with_a_line(tmp_path, capsys):
    code, said = command(tmp_path, capsys)
    assert code == 2
    assert said == f"warpgs: {tmp_path} is no run folder: it has no config.json\n"


def test_a_run_without_a_checkpoint_ends_the_command_with_a_line(stranded, capsys):
    for path in (stranded / "checkpoints").iterdir():
        path.unlink()
    code, said = command(stranded, capsys)
    assert code == 2
    assert said == f"warpgs: {stranded} has no checkpoint yet\n"


def test_a_damaged_checkpoint_ends_the_command_with_a_line(stranded, capsys):
    path = checkpoint.list_checkpoints(stranded)[-1]
    path.write_bytes(path.read_bytes()[:1000])
    code, said = command(stranded, capsys)
    assert code == 2
    assert said.startswith(f"warpgs: {path} is damaged")
    assert said.count("\n") == 1


def test_a_checkpoint_that_lacks_a_fact_ends_the_command_with_a_line(stranded, capsys):
    path = checkpoint.list_checkpoints(stranded)[-1]
    loaded = checkpoint.load(path)
    checkpoint.save(path, loaded.tensors, {k: v for k, v in loaded.facts.items() if k != "relit"})
    assert command(stranded, capsys) == (2, f"warpgs: {path} is damaged: it has no relit\n")


def test_a_run_of_another_version_ends_the_command_with_a_line(stranded, capsys):
    config = stranded / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "future": 1}))
    assert command(stranded, capsys) == (2, f"warpgs: {config} has fields of another version: future\n")


def test_a_folder_that_can_not_be_written_ends_the_command_with_a_line(run, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    code, said = command(run, capsys, "--out", str(tmp_path / "file"))
    assert code == 2
    assert "scene.ply could not be written" in said
