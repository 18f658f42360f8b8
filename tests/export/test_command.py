"""``warpgs export``: the files of a run, and one-line errors."""

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch

from tests.data.captures import edit_json
from tests.export import scenes
from tests.export.pages import read_page
from tests.export.test_gltf import decoded as gltf_of
from warpgs.captures import opening
from warpgs.captures.opening import load_capture
from warpgs.cli import main
from warpgs.data.capture import Capture
from warpgs.editing.options import Editing, Edits
from warpgs.export import page
from warpgs.export.clouds import Clouds
from warpgs.export.export_run import export_run
from warpgs.export.job import Writer
from warpgs.export.options import Export
from warpgs.export.start_camera import start_view
from warpgs.export.writers import WRITERS
from warpgs.formats.compressed import read_compressed
from warpgs.formats.standard import read_standard
from warpgs.runs import checkpoint
from warpgs.runs.config_file import read_config
from warpgs.runs.run import Run
from warpgs.video import camera_paths, orientation
from warpgs.video.filmed import position_and_axis

pytestmark = pytest.mark.usefixtures("quickly")


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return shutil.copytree(finished_run, tmp_path_factory.mktemp("runs") / "the run")


@pytest.fixture(scope="module")
def data(run):
    return read_config(run).data


def export(run, tmp_path, **options):
    """Exports in the scene's coordinates, if the format has this option."""
    writer = WRITERS.get(options.get("format", "ply"))
    up = {"up": "scene"} if writer and "up" in writer.options else {}
    return export_run(Export(run, **{"out": tmp_path / "out", "quiet": True, **up, **options}))


def names(tmp_path):
    return sorted(path.name for path in (tmp_path / "out").iterdir())


def clouds_of(run):
    return Clouds(Run.open(run, "cpu").trained_scene())


def view(data, time):
    capture = load_capture(data)
    return dataclasses.replace(capture.cameras[capture.val[0]], time=time)


def truth(run, camera):
    return Run.open(run, "cpu").trained_scene().render(camera).joint.image.clamp(0, 1)


@pytest.mark.parametrize("time", [0.0, 0.7])
def test_a_ply_file_looks_like_the_run_at_its_time(run, data, tmp_path, time):
    assert f"{tmp_path / 'out' / 'scene.ply'}: " in export(run, tmp_path, time=time)
    camera = view(data, time)
    assert (scenes.image(read_standard(tmp_path / "out" / "scene.ply"), camera) - truth(run, camera)).abs().max() < 1e-4


def test_a_compressed_file_renders_close_to_the_run(run, data, tmp_path):
    export(run, tmp_path, format="compressed", time=0.4)
    camera = view(data, 0.4)
    image = scenes.image(read_compressed(tmp_path / "out" / "scene.compressed.ply"), camera)
    assert scenes.psnr(image, truth(run, camera)) > 35


def test_a_page_renders_close_to_the_run(run, data, tmp_path):
    summary = export(run, tmp_path, format="html", keys=3)
    assert "at 3 key times" in summary
    assert "cameras of " in summary
    camera = view(data, 0.5)
    page = read_page(tmp_path / "out" / "scene.html")
    assert scenes.psnr(scenes.image(page.at(0.5), camera), truth(run, camera)) > 38
    assert len(set(page.static.octaves.tolist())) > 1  # from how visible they are in the training cameras


def test_the_files_of_both_branches_hold_the_whole_scene(run, tmp_path):
    export(run, tmp_path, layers="apart")
    scene = clouds_of(run).scene.scene
    static, dynamic = (len(read_standard(tmp_path / "out" / f"{name}.ply")) for name in ("static", "dynamic"))
    assert [static, dynamic] == [len(scene.static), len(scene.dynamic)]


@pytest.mark.parametrize("layers", ["static", "dynamic"])
def test_one_branch_is_written_to_one_file(run, tmp_path, layers):
    export(run, tmp_path, layers=layers)
    assert names(tmp_path) == [f"{layers}.ply"]


def test_a_sequence_has_one_file_per_time(run, tmp_path):
    assert "3 files" in export(run, tmp_path, frames=3, layers="dynamic")
    assert names(tmp_path) == [f"dynamic_0000{k}.ply" for k in range(3)]
    clouds = clouds_of(run)
    for k in range(3):
        cloud = clouds.at(k / 2)
        assert (read_standard(tmp_path / "out" / names(tmp_path)[k]).means == cloud.means[cloud.is_dynamic]).all()


def test_a_shorter_sequence_replaces_a_longer_one_of_the_same_layer(run, tmp_path):
    export(run, tmp_path, frames=4, layers="dynamic")
    export(run, tmp_path, frames=2, layers="static")
    export(run, tmp_path, frames=2, layers="dynamic")
    assert names(tmp_path) == ["dynamic_00000.ply", "dynamic_00001.ply", "static_00000.ply", "static_00001.ply"]


def test_a_page_has_the_name_of_the_run_folder_as_its_title(run, monkeypatch):
    monkeypatch.chdir(run)
    assert start_view(clouds_of(Path()), None, keys=2, seconds=1.0).title == "the run"


def test_a_page_has_a_title_and_a_picture_at_an_address(run, tmp_path):
    assert "scene.preview.png: " in export(run, tmp_path, format="html", keys=1, title="Mine", url="https://a.org")
    assert names(tmp_path) == ["scene.html", "scene.preview.png"]
    text = (tmp_path / "out/scene.html").read_text()
    assert "<title>Mine</title>" in text
    assert 'content="https://a.org/scene.preview.png"' in text


@pytest.mark.parametrize("options", [{"editing": Editing(Edits(max_gaussians=9))}, {}])
def test_a_page_opens_its_capture_once(run, tmp_path, monkeypatch, options):
    opened, read = [], opening.open_capture
    monkeypatch.setattr(opening, "open_capture", lambda *arguments: opened.append(arguments) or read(*arguments))
    export(run, tmp_path, format="html", keys=1, **options)
    assert len(opened) == 1


def test_a_page_with_too_many_gaussians_is_refused_before_anything_is_baked(run, tmp_path, monkeypatch):
    monkeypatch.setattr(page, "MAX_GAUSSIANS", 3)
    monkeypatch.setattr(page, "bake", lambda *_: pytest.fail("baked"))
    monkeypatch.setattr(opening, "open_capture", lambda *_: pytest.fail("opened"))
    with pytest.raises(ValueError, match="a page holds at most 3 static Gaussians"):
        export(run, tmp_path, format="html")


def test_files_are_written_into_the_run_folder_by_default(run):
    export_run(Export(run, quiet=True))
    assert (run / "export" / "scene.ply").is_file()


def test_max_gaussians_limits_the_number_of_gaussians(run, tmp_path):
    export(run, tmp_path, editing=Editing(Edits(max_gaussians=12)))
    assert len(read_standard(tmp_path / "out" / "scene.ply")) == 12


def test_a_page_follows_the_training_cameras(run, data):
    capture = Run.open(run, "cpu").open_capture(quiet=True)
    start = start_view(clouds_of(run), capture, keys=4, seconds=2.0)
    path = camera_paths.training_path(capture, 4)
    assert start.track == [camera.viewmat.tolist() for camera in path]
    assert start.viewmat == path[2].viewmat.tolist()
    assert start.intrinsics[0] == float(path[2].K[0, 0])
    assert start.title == "the run"
    assert start.up == tuple(orientation.vertical(capture))
    assert start.metres is None
    known = dataclasses.replace(capture, metres=2.5)
    assert start_view(clouds_of(run), known, keys=1, seconds=2.0).metres == 2.5
    assert all(start.filmed.outside(*position_and_axis(camera)) < 1 for camera in path)


def test_a_page_of_training_cameras_that_jump_starts_at_the_middle_view(run, data, monkeypatch):
    capture = Run.open(run, "cpu").open_capture(quiet=True)
    monkeypatch.setattr(camera_paths, "jumps", lambda _: True)
    start = start_view(clouds_of(run), capture, keys=4, seconds=2.0)
    assert start.viewmat == capture.cameras[capture.val[len(capture.val) // 2]].viewmat.tolist()
    assert start.track == []


@pytest.mark.parametrize(
    ("num_static", "num_dynamic", "away", "chosen"),
    [
        (40, 20, False, slice(40, None)),
        (40, 0, False, slice(None)),
        (0, 20, False, slice(None)),
        (40, 20, True, slice(0, 40)),
    ],
    ids=["what moves", "static alone", "dynamic alone", "what moves is out of view"],
)
def test_a_page_orbits_what_moves_in_its_first_view_else_what_is_there(num_static, num_dynamic, away, chosen):
    clouds = scenes.clouds(num_static, num_dynamic)
    if away:
        clouds.scene.scene.dynamic.means.add_(torch.tensor([0.0, 0.0, -20.0]))
    camera = dataclasses.replace(scenes.camera(), time=0.5)
    capture = Capture("test", {"0": camera}, ["0"], [], torch.zeros(0, 3), None, lambda name: None)
    _, _, depth, inside = camera.project(torch.from_numpy(clouds.at(0.5).means)[chosen])
    assert inside.any()
    pivot = start_view(clouds, capture, keys=2, seconds=1.0).pivot
    assert pivot == pytest.approx(float(depth[inside].median()))


def test_a_page_shows_images_as_the_config_says(run):
    clouds = clouds_of(run)
    clouds.scene.config = dataclasses.replace(clouds.scene.config, antialias=True, max_alpha=0.5)
    start = start_view(clouds, None, keys=2, seconds=1.0)
    assert (start.antialias, start.max_alpha) == (True, 0.5)


@pytest.mark.parametrize(
    ("file", "options"),
    [
        ("a.ply", {}),
        ("a.ply", {"format": "compressed"}),
        ("a.html", {"format": "html", "keys": 2}),
        ("a.glb", {"format": "glb"}),
    ],
)
def test_a_file_can_be_given_instead_of_a_folder(run, tmp_path, file, options):
    path = tmp_path / "new" / file
    assert export(run, tmp_path, out=path, **options).startswith(f"{path}: ")
    assert {written.name for written in path.parent.iterdir()} - {"a.preview.png"} == {file}
    assert path.is_file()


def test_a_folder_may_be_called_like_a_file(run, tmp_path):
    (folder := tmp_path / "a.ply").mkdir()
    export(run, tmp_path, out=folder, layers="apart")
    assert sorted(path.name for path in folder.iterdir()) == ["dynamic.ply", "static.ply"]


def test_a_new_folder_may_have_a_dot_in_its_name(run, tmp_path):
    export(run, tmp_path, out=tmp_path / "run.2")
    assert (tmp_path / "run.2" / "scene.ply").is_file()


@pytest.mark.parametrize("file", ["a.usd", "a.gltf", "a.htm", "a.mp4"])
def test_a_new_file_of_no_format_is_refused_with_the_suffixes_of_all(run, tmp_path, file):
    message = rf"end with \{Path(file).suffix}, only \.ply, \.sog, \.spz, \.glb, \.usdc, \.4dgs, \.html; to export"
    with pytest.raises(ValueError, match=message):
        export(run, tmp_path, out=tmp_path / file)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / file).mkdir()
    export(run, tmp_path, out=tmp_path / file)
    assert (tmp_path / file / "scene.ply").is_file()


def write_count(job):
    path = job.folder / "count.txt"
    path.parent.mkdir()
    path.write_text(f"{len(job.clouds.at(job.options.time or 0.0))}")
    return f"written to {path}"


def test_another_format_takes_one_entry(run, tmp_path, monkeypatch):
    monkeypatch.setitem(WRITERS, "count", Writer(write_count, ("time",)))
    assert export(run, tmp_path, format="count", time=0.5, editing=Editing(Edits(max_gaussians=7))).startswith(
        "written to "
    )
    assert (tmp_path / "out" / "count.txt").read_text() == "7"
    with pytest.raises(ValueError, match=r"--frames is for --format .*, not for count"):
        export(run, tmp_path, format="count", frames=2)


def test_an_unknown_format_is_refused_with_the_names_of_all_before_the_run_is_opened(tmp_path):
    with pytest.raises(ValueError, match=f"--format must be one of {', '.join(WRITERS)}, got 'splat'"):
        export(tmp_path / "no run", tmp_path, format="splat")


def test_the_help_names_every_format(capsys):
    with pytest.raises(SystemExit):
        main(["export", "--help"])
    shown = capsys.readouterr().out
    assert all(f"{name}: " in shown for name in WRITERS)


@pytest.fixture
def stranded(run, tmp_path):
    """A run whose capture was moved."""
    folder = tmp_path / "stranded"
    (folder / "checkpoints").mkdir(parents=True)
    newest = checkpoint.list_checkpoints(run)[-1]
    (folder / "checkpoints" / newest.name).write_bytes(newest.read_bytes())
    shutil.copy(run / "config.json", folder)
    edit_json(folder / "config.json", data=str(tmp_path / "gone"))
    return folder


def test_files_stand_upright(run, data, tmp_path):
    """Rotated cameras see the same; what is up for the cameras points to -y."""
    summary = export(run, tmp_path, up="capture")
    assert "in scene coordinates is up, from the training cameras" in summary
    up = orientation.vertical(load_capture(data))
    rotation = torch.from_numpy(orientation.upright(up)).float()
    assert (rotation @ torch.from_numpy(up).float()).tolist() == pytest.approx([0, -1, 0], abs=1e-6)
    camera = view(data, 0.0)
    viewmat = camera.viewmat.clone()
    viewmat[:3, :3] = viewmat[:3, :3] @ rotation.T
    image = scenes.image(read_standard(tmp_path / "out" / "scene.ply"), dataclasses.replace(camera, viewmat=viewmat))
    assert (image - truth(run, camera)).abs().max() < 1e-4
    assert (scenes.image(read_standard(tmp_path / "out" / "scene.ply"), camera) - image).abs().max() > 0.05


def test_an_axis_can_be_up(run, tmp_path):
    assert "z of the scene is up" in export(run, tmp_path, up="z")
    means = clouds_of(run).at(0.0).means
    back = read_standard(tmp_path / "out" / "scene.ply").means
    assert -back[:, 1] == pytest.approx(means[:, 2], abs=1e-5)


def test_y_is_up_in_gltf(run, tmp_path):
    export(run, tmp_path, format="glb", up="-y")
    assert gltf_of(tmp_path / "out" / "scene.glb").means == pytest.approx(clouds_of(run).at(0.0).means * [1, -1, -1])


@pytest.mark.parametrize(("background", "color"), [("black", "#000000"), ([0.2, 0.4, 1.0], "#3366ff")])
def test_the_summary_names_the_background_of_training_unless_the_file_has_it(run, tmp_path, background, color):
    folder = shutil.copytree(run, tmp_path / "run")
    edit_json(folder / "config.json", background=background)
    assert f"was {color} in training" in export(folder, tmp_path, time=0.5)
    assert "in training" not in export(folder, tmp_path, format="html", keys=1)


def test_without_a_capture_the_summary_says_what_is_up(stranded, tmp_path):
    assert "\n-y is taken as up (otherwise give --up), because the capture" in export(stranded, tmp_path, up="capture")


def test_ply_files_need_no_capture(stranded, tmp_path):
    export(stranded, tmp_path, frames=2)
    assert len(names(tmp_path)) == 2


def test_a_page_without_a_capture_starts_at_a_default_camera_that_sees_the_scene(stranded, tmp_path):
    summary = export(stranded, tmp_path, format="html")
    assert "default cameras, because the capture cannot be opened" in summary
    means = clouds_of(stranded).scene.scene.static.means
    camera = camera_paths.default_camera(camera_paths.BoundingSphere.around(means))
    assert camera.project(means)[3].float().mean() > 0.7


def test_max_gaussians_works_without_a_capture(stranded, tmp_path):
    export(stranded, tmp_path, editing=Editing(Edits(max_gaussians=9)))
    assert len(read_standard(tmp_path / "out" / "scene.ply")) == 9


def test_data_replaces_the_folder_of_the_capture(stranded, data, tmp_path):
    assert "cameras of " in export(stranded, tmp_path, format="html", keys=2, data=data)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"time": 1.1}, "--time must be in"),
        ({"time": float("nan")}, "--time must be in"),
        ({"frames": 0}, "--frames must be between 1 and"),
        ({"format": "html", "keys": 0}, "--keys must be between 1 and 256"),
        ({"format": "html", "keys": 257}, "--keys must be between 1 and 256"),
        ({"format": "html", "seconds": 0.0}, "--seconds must be positive"),
        ({"format": "html", "frames": 3}, "--frames is for --format .*, not for html"),
        ({"format": "html", "time": 0.0}, "--time is for --format .*, not for html"),
        ({"frames": 3, "time": 0.5}, "omit --time"),
        ({"keys": 30}, "--keys is for --format mesh, usd, 4dgs, html, not for ply"),
        ({"seconds": 5.0}, "--seconds is for --format mesh, usd, 4dgs, html, not for ply"),
        ({"max_megabytes": 256.0}, "--max-megabytes is for --format html, not for ply"),
        ({"format": "html", "layers": "static"}, "--layers is for --format .*, not for html"),
        ({"out": Path("a.ply"), "format": "spz"}, "--out a.ply is a file of --format ply and compressed, not of spz"),
        ({"out": Path("a.html")}, "--out a.html is a file of --format html, not of ply"),
        ({"out": Path("a.ply"), "frames": 2}, "--frames writes several files: --out must be a folder, not a file as a"),
        ({"out": Path("a.ply"), "layers": "apart"}, "--layers apart writes several files: --out must be a folder"),
        ({"editing": Editing(Edits(max_gaussians=0))}, "--max-gaussians must be at least 1"),
        ({"format": "html", "url": "a.org"}, "--url must be the address of a folder, such as .*, got 'a.org'"),
        ({"title": "a"}, "--title is for --format html, not for ply"),
        ({"format": "html", "max_megabytes": -1.0}, "--max-megabytes must be positive"),
        ({"format": "html", "max_megabytes": 0.001}, r"the page would hold .* use about --max-gaussians \d+"),
        ({"format": "html", "title": "a" * 201}, "--title must have at most 200 characters, got 201"),
    ],
)
def test_wrong_options_are_refused_and_nothing_is_written(run, tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        export(run, tmp_path, **options)
    assert not (tmp_path / "out").exists()


def test_a_missing_data_folder_is_refused(run, tmp_path):
    with pytest.raises(ValueError, match=r"--data .*nowhere is not a folder"):
        export(run, tmp_path, data=tmp_path / "nowhere")


def test_a_folder_that_cannot_be_written_ends_the_command_with_one_line(run, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["export", str(run), "--out", str(tmp_path / "file")]) == 2
    assert "scene.ply could not be written" in capsys.readouterr().err
