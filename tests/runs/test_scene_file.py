"""Files of other programs are viewed, rendered and exported like runs."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from tests.export import scenes
from tests.export.test_readers import FILES, write
from warpgs.cli import main
from warpgs.editing.options import Editing, Edits
from warpgs.export.export_run import export_run
from warpgs.export.options import Export
from warpgs.formats.readers import read_cloud
from warpgs.formats.standard import read_standard, write_standard
from warpgs.runs import scene_file
from warpgs.runs.opening import open_run, open_scene
from warpgs.video.options import Render
from warpgs.video.render_run import render_run
from warpgs.viewer.browser_camera import start_camera
from warpgs.viewer.source import open_source

pytestmark = pytest.mark.usefixtures("quickly")


@pytest.fixture
def file(tmp_path):
    return write(tmp_path / "a.ply", scenes.cloud(80, 2))


@pytest.fixture
def sequence(tmp_path):
    """Three files whose Gaussians move, in an order that is not that of their text."""
    cloud, folder = scenes.cloud(50, 1), tmp_path / "frames"
    for k, number in enumerate((2, 9, 10)):
        write_standard(folder / f"scene_{number}.ply", cloud.replaced(means=cloud.means + np.float32(0.2 * k)))
    return folder


@pytest.mark.parametrize("name", FILES)
def test_a_file_shows_what_was_written(tmp_path, name):
    cloud = scenes.cloud(150, 1)
    path = write(tmp_path / name, cloud)
    shown = open_run(path, "cpu").render(scenes.camera()).joint.image.clamp(0, 1)
    assert scenes.psnr(shown, scenes.image(cloud)) > 38
    assert (shown - scenes.image(read_cloud(path))).abs().max() < 1e-5


@pytest.mark.parametrize("antialias", [False, True])
def test_a_file_is_rendered_with_the_anti_aliasing_it_was_trained_with(tmp_path, antialias):
    cloud = dataclasses.replace(scenes.cloud(60), antialias=antialias)
    cloud.log_scales[:] -= 2
    shown = open_run(write(tmp_path / "a.ply", cloud), "cpu").render(scenes.camera()).joint.image.clamp(0, 1)
    assert (shown - scenes.image(cloud)).abs().max() < 1e-5
    other = dataclasses.replace(cloud, antialias=not antialias)
    assert (shown - scenes.image(other)).abs().max() > 1e-3


def test_a_file_next_to_a_run_of_its_name_has_a_folder_of_its_own(file):
    assert open_scene(file, "cpu").folder.name == "a"
    file.with_suffix("").mkdir()
    (file.with_suffix("") / "config.json").touch()
    assert open_scene(file, "cpu").folder.name == "a-ply"


def test_as_many_files_stay_in_memory_as_if_all_were_as_large_as_the_largest(tmp_path, monkeypatch):
    monkeypatch.setattr(scene_file, "MAX_CACHE_BYTES", 1_000_000)
    for k, count in enumerate((1, 2_000, 2_000, 2_000, 2_000, 2_000, 2_000, 2_000, 2_000, 2_000)):
        write_standard(tmp_path / f"scene_{k}.ply", scenes.cloud(count))
    scene = open_run(tmp_path, "cpu")
    for k in range(10):
        scene.splats(k / 9)
    assert 2 <= scene._frame.cache_info().currsize <= 6
    assert sum(tensor.nbytes for tensor in scene._frame(9).dynamic.state_dict().values()) > 100_000


def test_a_file_is_the_same_at_all_times(file):
    scene = open_run(str(file), "cpu")
    first, last = (scene.render(scenes.camera(time=time)).joint.image for time in (0.0, 1.0))
    assert torch.equal(first, last)


def test_the_files_of_a_sequence_follow_the_numbers_in_their_names(sequence):
    scene = open_run(sequence, "cpu")
    for time, number in ((0.0, 2), (0.2, 2), (0.3, 9), (0.5, 9), (1.0, 10)):
        expected = read_standard(sequence / f"scene_{number}.ply")
        splats = scene.splats(time)
        assert (splats.means.numpy() == expected.means).all()
        assert splats.is_dynamic.all()


def test_files_of_a_sequence_may_have_different_gaussians(sequence):
    write_standard(sequence / "scene_9.ply", scenes.cloud(7, 0))
    scene = open_run(sequence, "cpu")
    assert [len(scene.splats(time).means) for time in (0.0, 0.5, 1.0)] == [50, 7, 50]


def test_a_run_is_opened_as_before(finished_run):
    assert open_scene(finished_run, "cpu").folder == finished_run
    assert open_scene(finished_run, "cpu").has_capture


@pytest.mark.parametrize(("name", "folder"), [("a.ply", "a"), ("a.v3.spz", "a"), ("a.compressed.ply", "a")])
def test_what_is_made_of_a_file_is_in_a_folder_of_its_name(tmp_path, name, folder):
    assert open_scene(write(tmp_path / name, scenes.cloud(3)), "cpu").folder == tmp_path / folder


def test_commands_open_a_scene_by_its_path(file, sequence, finished_run):
    """As the viewer's button that renders a video does."""
    for path in (file, sequence, finished_run):
        opened = open_scene(path, "cpu")
        assert opened.path == path
        assert repr(open_scene(opened.path, "cpu")) == repr(opened)


@pytest.mark.parametrize("path", ["fixed", "spiral", "bullet", "frozen", "moving"])
def test_paths_lead_around_a_file(file, tmp_path, path):
    render_run(Render(file, path=path, frames=3, write="png", device="cpu", quiet=True))
    images = sorted((tmp_path / "a" / "render" / path).glob("*.png"))
    assert len(images) == 3
    assert all(image.stat().st_size > 5_000 for image in images)


def test_a_file_is_filmed_along_a_spiral_by_default(file, tmp_path):
    assert "120 images" in render_run(Render(file, write="png", device="cpu", quiet=True, scale=0.05))
    assert (tmp_path / "a" / "render" / "spiral" / "00119.png").is_file()


def test_a_file_is_exported_in_another_format_with_edits(file, tmp_path):
    editing = Editing(Edits(max_gaussians=30), save_edits=True)
    summary = export_run(Export(file, format="spz3", editing=editing, quiet=True))
    assert "-y is taken as up (otherwise give --up), because a.ply has no capture, which --data gives" in summary
    assert "edits keep 30 of 80 Gaussians" in summary
    assert "in training" not in summary
    assert (tmp_path / "a" / "edits.json").is_file()
    back, cloud = read_cloud(tmp_path / "a" / "export" / "scene.v3.spz"), read_cloud(file)
    nearest = np.linalg.norm(back.means[:, None] - cloud.means[None], axis=2).min(1)
    assert len(back) == 30
    assert nearest.max() < 1e-4


def test_a_ply_file_is_exported_as_it_was(file, tmp_path):
    export_run(Export(file, out=tmp_path / "out", quiet=True))
    back, cloud = read_standard(tmp_path / "out" / "scene.ply"), read_standard(file)
    assert (back.means == cloud.means).all()
    assert (back.sh == cloud.sh).all()
    assert back.log_scales == pytest.approx(cloud.log_scales, abs=1e-5)


def test_a_capture_in_the_coordinates_of_a_file_gives_its_cameras(finished_run, tmp_path):
    """The views at the time of the file look as those of the run."""
    run = open_scene(finished_run, "cpu")
    capture = run.open_capture(True)
    time = capture.cameras[capture.val[0]].time
    main(
        ["export", str(finished_run), "--up", "scene", "--time", f"{time}", "--out", str(tmp_path / "a.ply"), "--quiet"]
    )
    for name, path in (("file", tmp_path / "a.ply"), ("run", finished_run)):
        render_run(Render(path, out=tmp_path / name, write="png", device="cpu", quiet=True, data=run.config.data))
    images = [cv2.imread(str(tmp_path / name / f"{capture.val[0]}.png")).astype(int) for name in ("file", "run")]
    assert images[0].std() > 3
    assert np.abs(images[0] - images[1]).max() <= 1


@pytest.mark.parametrize("form", ["html", "usd", "4dgs"])
def test_a_sequence_is_exported_as_a_scene_that_moves(sequence, tmp_path, form):
    pytest.importorskip({"usd": "pxr", "4dgs": "fourdgs", "html": "json"}[form])
    summary = export_run(Export(sequence, format=form, keys=3, out=tmp_path / "out", quiet=True))
    assert "0 static and 50 dynamic Gaussians at 3 key times" in summary


@pytest.mark.parametrize("form", ["html", "usd", "4dgs"])
def test_a_sequence_of_other_gaussians_cannot_move_in_one_file(sequence, tmp_path, form):
    write_standard(sequence / "scene_9.ply", scenes.cloud(7, 0))
    with pytest.raises(ValueError, match=f"--format {form} needs the same number of Gaussians in all files"):
        export_run(Export(sequence, format=form, keys=3, out=tmp_path / "out", quiet=True))
    assert "3 files" in export_run(Export(sequence, frames=3, out=tmp_path / "out", quiet=True))
    assert [len(read_standard(path)) for path in sorted((tmp_path / "out").iterdir())] == [50, 7, 50]


def test_a_sequence_cannot_be_edited(sequence):
    with pytest.raises(ValueError, match="a sequence of files cannot be edited"):
        export_run(Export(sequence, editing=Editing(Edits(min_opacity=0.5)), quiet=True))


def test_the_viewer_shows_a_file(file):
    source = open_source(file, "cpu", False)
    assert len(source.current().scene.static) == 80
    start = start_camera(source, None)
    assert np.linalg.norm(start.position - start.target) > 1
    with pytest.raises(ValueError, match=r"a\.ply has no capture"):
        source.run.open_corrected_capture()


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["a.txt"], r"a\.txt: expected a run folder or a file that ends with \.ply, \.sog, \.spz, \.glb, \.splat"),
        ([], "is not a run folder: it has no config.json"),
        (["static_1.ply", "dynamic_1.ply"], r"files of several scenes, dynamic_\*\.ply, static_\*\.ply: keep one"),
    ],
)
def test_what_is_neither_a_run_nor_a_scene_is_refused(tmp_path, names, message):
    for name in names:
        (tmp_path / name).write_text("")
    path = tmp_path / names[0] if len(names) == 1 else tmp_path
    with pytest.raises(ValueError, match=message):
        open_scene(path, "cpu")


def test_a_damaged_file_ends_the_command_with_one_line(tmp_path, capsys):
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    assert main(["export", str(tmp_path / "a.ply")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_what_trains_and_measures_takes_runs_alone(file, capsys):
    assert main(["eval", str(file)]) == 2
    assert "is not a run folder" in capsys.readouterr().err
