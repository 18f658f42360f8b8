"""``warpgs render`` writes the images and the video of a trained scene along the chosen camera path."""

import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from tests.data.captures import edit_json
from tests.errors import error_line
from tests.video.test_writer import frames_of
from warpgs import rendering
from warpgs.cli import main
from warpgs.distortion import Distortion
from warpgs.editing.objects import write_objects
from warpgs.runs.config_file import read_config
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene
from warpgs.video import command, frames, render_run, writer
from warpgs.video.camera_paths import training_path
from warpgs.video.options import Render
from warpgs.visualize.images import to_bytes
from warpgs.visualize.objects import objects_image

pytestmark = pytest.mark.usefixtures("quickly")


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return shutil.copytree(finished_run, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture(scope="module")
def capture(run):
    return Run.open(run, "cpu").open_capture()


@pytest.fixture(scope="module")
def scene(run):
    return Run.open(run, "cpu").trained_scene()


def render(run, tmp_path, **options):
    frames = {} if options.get("path", "views") == "views" and "keyframes" not in options else {"frames": 3}
    defaults = {"out": tmp_path / "out", "quiet": True, "device": "cpu", **frames}
    return render_run.render_run(Render(run, **{**defaults, **options}))


def images_in(tmp_path):
    files = sorted((tmp_path / "out").glob("*.png"))
    return {path.stem: cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB) for path in files}


def first_image(run, tmp_path, **options):
    """The only image of a fixed camera."""
    render(run, tmp_path, path="fixed", frames=1, **options)
    return images_in(tmp_path)["00000"]


def expected(scene, camera):
    return to_bytes(scene.render(camera).joint.image)


def test_every_evaluation_view_is_written_under_its_name(run, capture, scene, tmp_path):
    summary = render(run, tmp_path)
    images = images_in(tmp_path)
    assert list(images) == sorted(capture.val)
    for name, image in images.items():
        assert (image == expected(scene, capture.cameras[name])).all()
    out = tmp_path / "out"
    assert summary == f"{len(capture.val)} images of 32 × 24 in {out} and {out / 'video.mp4'}"


def test_the_ground_truth_is_beside_the_image(run, capture, scene, tmp_path):
    render(run, tmp_path, truth=True)
    for name, image in images_in(tmp_path).items():
        assert (image[:, :32] == capture.frame(name).image.numpy()).all()
        assert (image[:, 32:] == expected(scene, capture.cameras[name])).all()


def test_the_ground_truth_is_resized_to_the_image(run, capture, tmp_path):
    render(run, tmp_path, truth=True, scale=0.5)
    image = next(iter(images_in(tmp_path).values()))
    truth = capture.frame(capture.val[0]).image.numpy()
    assert image.shape == (12, 32, 3)
    assert image[:, :16].mean() == pytest.approx(truth.mean(), abs=2)


def test_time_passes_for_a_fixed_camera(run, capture, scene, tmp_path):
    name = capture.train[0]
    render(run, tmp_path, path="fixed", view=name)
    for time, image in zip((0.0, 0.5, 1.0), images_in(tmp_path).values(), strict=True):
        camera = dataclasses.replace(capture.cameras[name], time=time)
        assert (image == expected(scene, camera)).all()


@pytest.mark.parametrize("path", ["frozen", "moving", "spiral", "bullet"])
def test_every_path_has_the_requested_number_of_frames(run, tmp_path, path):
    render(run, tmp_path, path=path, frames=4)
    assert list(images_in(tmp_path)) == ["00000", "00001", "00002", "00003"]
    assert len(frames_of(tmp_path / "out" / "video.mp4")) == 4


def cameras_of(run, monkeypatch, tmp_path, **options):
    """The cameras along a path, one per frame."""
    cameras = []
    original = TrainedScene.render

    def record(self, camera, *others, **flags):
        cameras.append(camera)
        return original(self, camera, *others, **flags)

    monkeypatch.setattr(TrainedScene, "render", record)
    render(run, tmp_path, **options)
    return cameras


@pytest.mark.parametrize(
    ("path", "time", "times"),
    [
        ("frozen", 0.3, [0.3, 0.3, 0.3]),
        ("moving", None, [0.0, 0.5, 1.0]),
        ("spiral", None, [0.0, 0.5, 1.0]),
        ("spiral", 0.2, [0.2, 0.2, 0.2]),
        ("bullet", 0.2, [0.2, 0.2, 1.0]),
    ],
)
def test_cameras_move_and_time_passes_unless_one_is_given(run, monkeypatch, tmp_path, path, time, times):
    cameras = cameras_of(run, monkeypatch, tmp_path, path=path, time=time)
    assert [c.time for c in cameras] == times
    assert (cameras[0].position - cameras[1].position).norm() > 0.01


@pytest.mark.parametrize("path", render_run.PATHS_OF_OPTION["lens"])
def test_a_path_is_filmed_through_a_pinhole_or_the_lens_that_recorded_the_view(
    run, capture, monkeypatch, tmp_path, path
):
    def through_a_lens(self, quiet):
        return dataclasses.replace(capture, cameras={n: bent(c) for n, c in capture.cameras.items()})

    monkeypatch.setattr(Run, "open_corrected_capture", through_a_lens)
    for lens, distorted in ((None, False), ("pinhole", False), ("recorded", True)):
        with monkeypatch.context() as patch:
            cameras = cameras_of(run, patch, tmp_path, path=path, lens=lens)
        assert [camera.distortion is not None for camera in cameras] == [distorted] * 3


def bent(camera):
    """A camera with barrel distortion."""
    return dataclasses.replace(camera, distortion=Distortion.radial([-0.1], camera.K, camera.size))


def test_keyframes_are_followed(run, capture, scene, tmp_path):
    name = capture.val[0]
    (tmp_path / "fly.json").write_text(json.dumps({"keyframes": [{"view": name, "time": 0.5}]}))
    render(run, tmp_path, keyframes=tmp_path / "fly.json", frames=1)
    camera = dataclasses.replace(capture.cameras[name], time=0.5)
    assert (images_in(tmp_path)["00000"] == expected(scene, camera)).all()


def test_a_shorter_path_removes_the_images_of_a_longer_one(run, tmp_path):
    render(run, tmp_path, path="fixed", frames=4, write="png")
    (tmp_path / "out" / "00009.png").write_text("not written by an earlier path: there is a gap before it")
    render(run, tmp_path, path="fixed", frames=2, write="png")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["00000.png", "00001.png", "00009.png"]


def test_images_are_written_to_the_run_folder_by_default(run):
    render_run.render_run(Render(run, path="fixed", frames=1, quiet=True, device="cpu"))
    assert (run / "render" / "fixed" / "00000.png").is_file()


@pytest.mark.parametrize(("scale", "size"), [(2.0, (48, 64)), (0.5, (12, 16))])
def test_images_have_the_requested_size(run, tmp_path, scale, size):
    assert first_image(run, tmp_path, scale=scale).shape == (*size, 3)


def test_supersampling_averages_a_larger_image(run, tmp_path):
    large = first_image(run, tmp_path, scale=3.0).astype(float)
    small = first_image(run, tmp_path, supersample=3)
    assert small.shape == (24, 32, 3)
    assert np.abs(large.reshape(24, 3, 32, 3, 3).mean((1, 3)) - small).max() <= 1.0


def test_layers_are_side_by_side(run, tmp_path):
    *images, together = (first_image(run, tmp_path, layers=name) for name in ("joint", "static", "dynamic", "all"))
    assert (np.concatenate(images, 1) == together).all()
    assert (images[1] != images[2]).any()


def test_a_size_of_another_shape_crops_the_view(run, tmp_path):
    """32 × 24 at 20 × 48: twice as large, then 20 of 64 columns."""
    whole = first_image(run, tmp_path, scale=2.0)
    difference = np.abs(first_image(run, tmp_path, size="20x48").astype(int) - whole[:, 22:42])
    assert difference.mean() < 0.2  # the covariance of Gaussians at the border depends on the field of view
    assert difference.max() <= 4


def test_the_ground_truth_is_cropped_like_the_image(run, capture, tmp_path):
    render(run, tmp_path, truth=True, size="16x24")
    for name, image in images_in(tmp_path).items():
        assert image.shape == (24, 32, 3)
        assert (image[:, :16] == capture.frame(name).image.numpy()[:, 8:24]).all()


def test_alpha_is_grey(run, capture, scene, tmp_path):
    render(run, tmp_path, layers="alpha")
    for name, image in images_in(tmp_path).items():
        alpha = scene.render(capture.cameras[name]).joint.alpha
        assert (image == to_bytes(alpha[..., None].expand(-1, -1, 3))).all()


def test_objects_are_those_of_the_run(run, capture, scene, tmp_path):
    ids = torch.arange(len(scene.scene.dynamic)) % 3
    write_objects(scene, run, ids.int().numpy())
    render(run, tmp_path, layers="objects")
    objects = torch.cat([torch.zeros(len(scene.scene.static), dtype=torch.int64), ids])
    for name, image in images_in(tmp_path).items():
        camera = capture.cameras[name]
        splats = dataclasses.replace(scene.splats(camera.time), objects=objects)
        assert (image == objects_image(splats, camera, scene.config.render_settings)).all()
        assert (image[..., 0] > image[..., 1]).any()


def test_depth_has_the_same_colors_in_all_frames(run, monkeypatch, tmp_path):
    bounds, original = [], frames.depth_image
    monkeypatch.setattr(rendering, "MIN_ALPHA", 0.05)
    monkeypatch.setattr(frames, "depth_image", lambda *a, **k: bounds.append(k["bounds"]) or original(*a, **k))
    render(run, tmp_path, path="moving", layers="depth", frames=4)
    assert len(bounds) == 4
    assert len(set(bounds)) == 1
    assert 0 < bounds[0][0] < bounds[0][1]
    assert len({image.tobytes() for image in images_in(tmp_path).values()}) > 1


@pytest.mark.parametrize("layers", ["joint", "dynamic"])
def test_a_transparent_image_over_black_is_the_opaque_one(run, tmp_path, layers):
    opaque = first_image(run, tmp_path, write="png", layers=layers)
    render(run, tmp_path, path="fixed", frames=1, write="png", layers=layers, transparent=True)
    b, g, r, alpha = np.moveaxis(cv2.imread(str(tmp_path / "out" / "00000.png"), cv2.IMREAD_UNCHANGED), 2, 0)
    assert alpha.min() < 128
    assert np.abs(np.stack([r, g, b], 2) * (alpha[..., None] / 255.0) - opaque).max() <= 2


@pytest.mark.parametrize("suffix", ["gif", "webp"])
@pytest.mark.parametrize("transparent", [False, True])
def test_an_animation_shows_every_frame_and_repeats(run, tmp_path, suffix, transparent):
    options = {"path": "moving", "frames": 3, "layers": "static", "transparent": transparent}
    render(run, tmp_path, write="png", **options)
    render(run, tmp_path, write=suffix, rate=10.0, **options)
    expected = [Image.open(path).convert("RGBA") for path in sorted((tmp_path / "out").glob("*.png"))]
    with Image.open(tmp_path / "out" / f"video.{suffix}") as file:
        assert file.info["loop"] == 0
        assert file.n_frames == 3
        for k, truth in enumerate(map(np.asarray, expected)):
            file.seek(k)
            shown = np.asarray(file.convert("RGBA")).astype(int)
            assert file.info["duration"] == pytest.approx(100, abs=1)
            solid = (truth[..., 3] > 250) & (shown[..., 3] > 0)
            assert np.abs(shown - truth)[solid].sum() < 8 * max(1, solid.sum())
            assert ((shown[..., 3] == 255) == (truth[..., 3] > 127))[(truth[..., 3] < 20) | (truth[..., 3] > 250)].all()


@pytest.mark.parametrize(
    ("write", "suffixes", "places"),
    [
        ("png", {".png"}, ["out"]),
        ("mp4", {".mp4"}, ["out/video.mp4"]),
        ("gif", {".gif"}, ["out/video.gif"]),
        ("both", {".png", ".mp4"}, ["out", "out/video.mp4"]),
    ],
)
def test_only_the_requested_files_are_written(run, tmp_path, write, suffixes, places):
    summary = render(run, tmp_path, path="fixed", write=write)
    assert {path.suffix for path in (tmp_path / "out").iterdir()} == suffixes
    assert summary.endswith(" in " + " and ".join(str(tmp_path / place) for place in places))


@pytest.mark.parametrize("quiet", [True, False])
def test_progress_is_hidden_only_if_quiet(run, tmp_path, monkeypatch, quiet):
    calls = []
    monkeypatch.setattr(frames, "progress", lambda steps, name, quiet: calls.append(quiet) or steps)
    render(run, tmp_path, path="fixed", quiet=quiet)
    assert calls == [quiet]


def test_bullet_time_follows_the_training_camera_unless_a_view_is_given(run, capture, monkeypatch, tmp_path):
    options = {"path": "bullet", "frames": 5}
    with monkeypatch.context() as patch:
        path = cameras_of(run, patch, tmp_path, **options)
    with monkeypatch.context() as patch:
        path_at_view = cameras_of(run, patch, tmp_path, **options, view=capture.train[1])
    training = training_path(capture, render_run.FRAMES)
    for k in (0, -1):
        assert path[k].time == training[k].time
        assert (path[k].position - training[k].position).norm() < 1e-5
        assert (path_at_view[k].position - capture.cameras[capture.train[1]].position).norm() < 1e-5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"path": "fixed", "frames": 0}, "--frames must be between 1 and"),
        ({"frames": 3}, "--frames is for .* not for views"),
        ({"view": "a"}, "--view is for fixed, spiral, bullet, cameras, not for views"),
        ({"path": "frozen", "view": "a"}, "--view is for .* not for frozen"),
        ({"path": "fixed", "time": 0.0}, "--time is for frozen, spiral, bullet, not for fixed"),
        ({"path": "moving", "time": 0.5}, "--time is for .* not for moving"),
        ({"lens": "recorded"}, "--lens is for fixed, frozen, moving, spiral, bullet, not for views"),
        ({"keyframes": Path("a.json"), "time": 0.5}, "--time is for .* not for keyframes"),
        ({"keyframes": Path("a.json"), "view": "a"}, "--view is for .* not for keyframes"),
        ({"keyframes": Path("a.json"), "truth": True}, "--truth is for views, not for keyframes"),
        ({"keyframes": Path("a.json"), "path": "views"}, "omit --path"),
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
        ({"size": "1080"}, "--size must be WIDTHxHEIGHT with sides of 1 to 16,384 pixels, got '1080'"),
        ({"size": "0x20"}, "--size must be WIDTHxHEIGHT"),
        ({"size": "20x99999"}, "--size must be WIDTHxHEIGHT"),
        ({"size": "20x20", "scale": 0.5}, "omit --scale"),
        ({"transparent": True}, "MP4 has no transparency: add --write png"),
        (
            {"transparent": True, "write": "png", "layers": "depth"},
            "--transparent is for joint, static, dynamic and all",
        ),
        ({"rate": 60.0, "write": "gif"}, "--rate must be between 0.01 and 50, got 60"),
        ({"scale": 5000.0}, "must be between 0 and 32768 pixels"),
    ],
)
def test_invalid_options_are_refused_and_nothing_is_written(run, tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        render(run, tmp_path, **options)
    assert not (tmp_path / "out").exists()


def test_a_path_that_leaves_the_scene_is_refused(run, tmp_path):
    far = {"position": [0, 0, -1000], "target": [0, 0, 0], "time": 0}
    (tmp_path / "far.json").write_text(json.dumps({"keyframes": [far]}))
    with pytest.raises(ValueError, match=r"far\.json leaves the scene: camera 0 at"):
        render(run, tmp_path, keyframes=tmp_path / "far.json")


def test_views_of_a_capture_without_evaluation_views_are_refused(run, capture, tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "open_capture", lambda self, quiet: capture)
    monkeypatch.setattr(capture, "val", ())
    with pytest.raises(ValueError, match="has no evaluation views; choose another --path"):
        render(run, tmp_path)


def test_without_an_encoder_the_error_suggests_png(run, tmp_path, monkeypatch):
    class Video(writer.Video):
        def add(self, image):
            raise OSError(f"{self.path} could not be opened as a video")

    monkeypatch.setattr(writer, "Video", Video)
    with pytest.raises(OSError, match=r"video\.mp4 could not be opened as a video; --write png needs no encoder"):
        render(run, tmp_path, path="fixed")
    render(run, tmp_path, path="fixed", write="png")
    assert len(images_in(tmp_path)) == 3


def test_the_error_names_a_moved_capture_and_data_replaces_it(run, capture, tmp_path, capsys):
    moved, data = shutil.copytree(run, tmp_path / "moved"), read_config(run).data
    edit_json(moved / "config.json", data=str(tmp_path / "gone"))
    assert str(tmp_path / "gone") in error_line(capsys, "render", moved, "--device", "cpu")
    assert f"{len(capture.val)} images" in render(moved, tmp_path, data=data)


def test_too_little_memory_ends_a_command_with_one_line_of_advice(run, monkeypatch, capsys):
    def fail(_):
        raise MemoryError("no")

    monkeypatch.setattr(command, "render_run", fail)
    assert main(["render", str(run)]) == 2
    message = capsys.readouterr().err
    assert message.startswith("warpgs render: out of memory (")
    assert "smaller images or fewer Gaussians" in message
    assert message.count("\n") == 1
