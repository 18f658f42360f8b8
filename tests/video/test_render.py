"""``warpgs render``: the pictures are those of the run along the path that was asked for."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from tests import tiny
from tests.video.test_mp4 import frames_of
from warpgs import visualize as pictures
from warpgs.cli import main
from warpgs.runs import checkpoint
from warpgs.runs import run as runs
from warpgs.runs.trained import Player
from warpgs.video import command as film
from warpgs.video import mp4
from warpgs.video.command import Render, render_run

pytestmark = pytest.mark.usefixtures("quickly")
quickly = tiny.quickly


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return shutil.copytree(finished_run, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def capture(run):
    return runs.open_capture(read_config(run))


@pytest.fixture(scope="module")
def render_at(run):
    config = read_config(run)
    scene, facts = runs.newest_scene(run, config)
    return Player(scene, config, facts)


def render(run, tmp_path, **options):
    of_a_path = {} if options.get("path", "views") == "views" and "keyframes" not in options else {"frames": 3}
    return render_run(Render(run, **{"out": tmp_path / "out", "quiet": True, "device": "cpu", **of_a_path, **options}))


def pictures_of(tmp_path):
    files = sorted((tmp_path / "out").glob("*.png"))
    return {path.stem: cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in files}


def shown(render_at, camera):
    return pictures.to_bytes(render_at(camera, False).joint.image)


# Pictures -----------------------------------------------------------------------------------------------------------


def test_every_evaluation_view_is_drawn_under_its_name(run, capture, render_at, tmp_path):
    said = render(run, tmp_path)
    drawn = pictures_of(tmp_path)
    assert list(drawn) == sorted(capture.val)
    for name, picture in drawn.items():
        assert (picture == shown(render_at, capture.cameras[name])).all()
    assert said == f"{len(capture.val)} pictures of 32 × 24 in {tmp_path / 'out'}"


def test_the_truth_is_beside_the_image(run, capture, render_at, tmp_path):
    render(run, tmp_path, truth=True)
    for name, picture in pictures_of(tmp_path).items():
        assert (picture[:, :32] == capture.frame(name).image.numpy()).all()
        assert (picture[:, 32:] == shown(render_at, capture.cameras[name])).all()


def test_the_truth_follows_the_size_of_the_image(run, capture, tmp_path):
    render(run, tmp_path, truth=True, scale=0.5)
    picture = next(iter(pictures_of(tmp_path).values()))
    truth = capture.frame(capture.val[0]).image.numpy()
    assert picture.shape == (12, 32, 3)
    assert picture[:, :16].mean() == pytest.approx(truth.mean(), abs=2)


def test_a_fixed_camera_sees_time_go_by(run, capture, render_at, tmp_path):
    name = capture.train[0]
    render(run, tmp_path, path="fixed", view=name)
    for time, picture in zip((0.0, 0.5, 1.0), pictures_of(tmp_path).values(), strict=True):
        camera = dataclasses.replace(capture.cameras[name], time=time)
        assert (picture == shown(render_at, camera)).all()


@pytest.mark.parametrize("path", ["frozen", "moving", "spiral", "bullet"])
def test_every_path_gives_as_many_pictures_as_asked_for(run, tmp_path, path):
    render(run, tmp_path, path=path, frames=4)
    assert list(pictures_of(tmp_path)) == ["00000", "00001", "00002", "00003"]
    assert len(frames_of(tmp_path / "out" / "video.mp4")) == 4


def cameras_of(run, monkeypatch, tmp_path, **options):
    """The cameras that a path has, without drawing through them."""
    seen = []

    def note(self, camera, name):
        seen.append(camera)
        return torch.zeros(2, 2, 3)

    monkeypatch.setattr(film._Film, "picture", note)
    render(run, tmp_path, **options)
    return seen


def test_a_frozen_path_moves_the_camera_and_not_time(run, monkeypatch, tmp_path):
    cameras = cameras_of(run, monkeypatch, tmp_path, path="frozen", time=0.3, frames=5)
    assert {c.time for c in cameras} == {0.3}
    assert (cameras[0].position - cameras[1].position).norm() > 0.01


def test_a_moving_path_moves_both(run, monkeypatch, tmp_path):
    cameras = cameras_of(run, monkeypatch, tmp_path, path="moving", frames=5)
    assert [c.time for c in cameras] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert (cameras[0].position - cameras[1].position).norm() > 0.01


@pytest.mark.parametrize(("time", "times"), [(None, [0.0, 0.5, 1.0]), (0.2, [0.2, 0.2, 0.2])])
def test_a_spiral_runs_through_time_unless_it_is_told_a_moment(run, monkeypatch, tmp_path, time, times):
    cameras = cameras_of(run, monkeypatch, tmp_path, path="spiral", time=time)
    assert [c.time for c in cameras] == times


def test_keyframes_are_followed(run, capture, render_at, tmp_path):
    name = capture.val[0]
    (tmp_path / "fly.json").write_text(json.dumps({"keyframes": [{"view": name, "time": 0.5}]}))
    render(run, tmp_path, keyframes=tmp_path / "fly.json", frames=1)
    camera = dataclasses.replace(capture.cameras[name], time=0.5)
    assert (pictures_of(tmp_path)["00000"] == shown(render_at, camera)).all()


def test_a_shorter_film_leaves_no_picture_of_a_longer_one(run, tmp_path):
    render(run, tmp_path, path="fixed", frames=4, write="png")
    (tmp_path / "out" / "00009.png").write_text("of somebody else: there is a gap before it")
    render(run, tmp_path, path="fixed", frames=2, write="png")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["00000.png", "00001.png", "00009.png"]


def test_pictures_are_in_the_run_folder_by_default(run):
    render_run(Render(run, path="fixed", frames=1, quiet=True, device="cpu"))
    assert (run / "render" / "fixed" / "00000.png").is_file()


# Sizes, layers, files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scale", "size"), [(2.0, (48, 64)), (0.5, (12, 16))])
def test_pictures_have_the_size_asked_for(run, tmp_path, scale, size):
    render(run, tmp_path, scale=scale, path="fixed", frames=1)
    assert pictures_of(tmp_path)["00000"].shape == (*size, 3)


def test_supersampling_averages_a_larger_picture(run, tmp_path):
    render(run, tmp_path, path="fixed", frames=1, scale=3.0)
    large = pictures_of(tmp_path)["00000"].astype(float)
    render(run, tmp_path, path="fixed", frames=1, supersample=3)
    small = pictures_of(tmp_path)["00000"]
    assert small.shape == (24, 32, 3)
    assert np.abs(large.reshape(24, 3, 32, 3, 3).mean((1, 3)) - small).max() <= 1.0


def test_layers_are_side_by_side(run, tmp_path):
    drawn = []
    for layers in ("joint", "static", "dynamic", "all"):
        render(run, tmp_path, path="fixed", frames=1, layers=layers)
        drawn.append(pictures_of(tmp_path)["00000"])
    assert (np.concatenate(drawn[:3], 1) == drawn[3]).all()
    assert (drawn[1] != drawn[2]).any()


@pytest.mark.parametrize(("write", "kinds"), [("png", {".png"}), ("mp4", {".mp4"}), ("both", {".png", ".mp4"})])
def test_only_the_files_asked_for_are_written(run, tmp_path, write, kinds):
    render(run, tmp_path, path="fixed", write=write)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == kinds


@pytest.mark.parametrize("quiet", [True, False])
def test_progress_is_shown_unless_it_should_be_quiet(run, tmp_path, monkeypatch, quiet):
    told = []
    monkeypatch.setattr(film, "progress", lambda steps, name, quiet: told.append(quiet) or steps)
    render(run, tmp_path, path="fixed", quiet=quiet)
    assert told == [quiet]


# Refusals -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"path": "fixed", "frames": 0}, "--frames must be between 1 and"),
        ({"frames": 3}, "--frames is for .* not for views"),
        ({"view": "a"}, "--view is for fixed and spiral and bullet, not for views"),
        ({"path": "frozen", "view": "a"}, "--view is for .* not for frozen"),
        ({"path": "fixed", "time": 0.0}, "--time is for frozen and spiral and bullet, not for fixed"),
        ({"path": "moving", "time": 0.5}, "--time is for .* not for moving"),
        ({"keyframes": Path("a.json"), "time": 0.5}, "--time is for .* not for keyframes"),
        ({"keyframes": Path("a.json"), "view": "a"}, "--view is for .* not for keyframes"),
        ({"keyframes": Path("a.json"), "truth": True}, "--truth is for views, not for keyframes"),
        ({"keyframes": Path("a.json"), "path": "views"}, "leave out --path"),
        ({"supersample": 0}, "--supersample must be between 1 and 8"),
        ({"supersample": 9}, "--supersample must be between 1 and 8"),
        ({"path": "frozen", "time": -0.1}, "--time must be in"),
        ({"scale": 0.0}, "--scale must be positive"),
        ({"scale": float("inf")}, "--scale must be positive"),
        ({"rate": -5.0}, "--rate must be between 0.01 and 1000"),
        ({"rate": 1e300}, "--rate must be between"),
        ({"rate": 1e-300}, "--rate must be between"),
        ({"rate": float("nan")}, "--rate must be between"),
        ({"truth": True, "path": "spiral"}, "--truth is for views, not for spiral"),
        ({"path": "fixed", "view": "none"}, "has no view 'none'"),
        ({"scale": 0.001}, "has no pixels"),
        ({"scale": 5000.0}, "must be between 0 and 32768 pixels"),
    ],
)
def test_what_can_not_be_done_is_refused_in_words_and_nothing_is_written(run, tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        render(run, tmp_path, **options)
    assert not (tmp_path / "out").exists()


def test_a_path_that_leaves_the_scene_is_refused(run, tmp_path):
    far = {"position": [0, 0, -1000], "target": [0, 0, 0], "time": 0}
    (tmp_path / "far.json").write_text(json.dumps({"keyframes": [far]}))
    with pytest.raises(ValueError, match=r"far\.json leaves the scene: camera 0 at"):
        render(run, tmp_path, keyframes=tmp_path / "far.json")


def test_views_of_a_capture_without_any_are_refused(run, capture, tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "open_capture", lambda config, quiet: capture)
    monkeypatch.setattr(capture, "val", ())
    with pytest.raises(ValueError, match="has no evaluation views; choose another --path"):
        render(run, tmp_path)


def test_without_an_encoder_the_way_out_is_told(run, tmp_path, monkeypatch):
    class Video(mp4.Video):
        def add(self, image):
            raise OSError(f"{self.path} could not be opened as a video")

    monkeypatch.setattr(mp4, "Video", Video)
    with pytest.raises(OSError, match=r"video\.mp4 could not be opened as a video; --write png needs no encoder"):
        render(run, tmp_path, path="fixed")
    render(run, tmp_path, path="fixed", write="png")
    assert len(pictures_of(tmp_path)) == 3


def test_a_folder_that_is_no_run_ends_the_command_with_a_line(tmp_path, capsys):
    assert main(["render", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"warpgs: {tmp_path} is no run folder: it has no config.json\n"


@pytest.fixture
def stranded(run, tmp_path):
    """A copy, to take things from."""
    return shutil.copytree(run, tmp_path / "stranded")


def line(capsys, run):
    """The one line that the command ends with."""
    assert main(["render", str(run), "--device", "cpu"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_a_run_without_a_checkpoint_ends_the_command_with_a_line(stranded, capsys):
    shutil.rmtree(stranded / "checkpoints")
    assert line(capsys, stranded) == f"warpgs: {stranded} has no checkpoint yet\n"


def test_a_damaged_checkpoint_ends_the_command_with_a_line(stranded, capsys):
    path = checkpoint.list_checkpoints(stranded)[-1]
    path.write_bytes(path.read_bytes()[:1000])
    assert f"warpgs: {path} is damaged" in line(capsys, stranded)


@pytest.mark.parametrize(("change", "words"), [('"sead": 1, ', "fields of another version: sead"), ("[" * 100_000, "")])
def test_a_config_of_another_version_or_damaged_ends_the_command_with_a_line(stranded, capsys, change, words):
    text = (stranded / "config.json").read_text()
    (stranded / "config.json").write_text("{" + change + text[1:])
    said = line(capsys, stranded)
    assert said.startswith(f"warpgs: {stranded / 'config.json'} ")
    assert words in said


def test_a_capture_that_was_moved_is_told_and_can_be_named(stranded, capture, tmp_path, capsys):
    config = json.loads((stranded / "config.json").read_text())
    here = config["data"]
    (stranded / "config.json").write_text(json.dumps({**config, "data": str(tmp_path / "gone")}))
    assert str(tmp_path / "gone") in line(capsys, stranded)
    assert f"{len(capture.val)} pictures" in render(stranded, tmp_path, data=Path(here))


LACKS = [torch.OutOfMemoryError("CUDA out of memory."), MemoryError("no"), RuntimeError("can't allocate memory:\n9")]


@pytest.mark.parametrize("error", LACKS)
def test_too_little_memory_ends_a_command_with_a_line_that_says_what_to_do(run, monkeypatch, capsys, error):
    def fail(_):
        raise error

    monkeypatch.setattr(film, "render_run", fail)
    assert main(["render", str(run)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("warpgs: out of memory (")
    assert "smaller pictures, fewer Gaussians" in said
    assert said.count("\n") == 1


def test_any_other_error_is_one_of_the_program(run, monkeypatch):
    def fail(_):
        raise RuntimeError("a bug")

    monkeypatch.setattr(film, "render_run", fail)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["render", str(run)])


def test_ctrl_c_ends_a_command_with_a_line(run, monkeypatch, capsys):
    def stop(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(film, "render_run", stop)
    assert main(["render", str(run)]) == 130
    assert capsys.readouterr().err == "warpgs: stopped\n"
