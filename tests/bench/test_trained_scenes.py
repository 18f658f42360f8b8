import dataclasses
import json

import pytest
import torch

from tests import tiny
from tests.export import scenes
from warpgs.bench import measure
from warpgs.bench.options import Bench
from warpgs.bench.trained_scenes import NUM_CAMERAS, circle, trained_views
from warpgs.cli import main
from warpgs.config import RenderSettings
from warpgs.formats.readers import read_cloud
from warpgs.formats.standard import write_standard
from warpgs.runs.opening import open_scene


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "object.ply"
    write_standard(path, scenes.cloud(200, 2))
    return path


def test_a_file_is_measured_at_every_size(ply, tmp_path, capsys):
    report = tmp_path / "report.json"
    options = ["--device", "cpu", "--repeats", "1", "--json", str(report), "--sizes", "32x24", "48x32"]
    assert main(["bench", *options, "--scene", str(ply)]) == 0
    results = json.loads(report.read_text())["results"]
    assert [(r["name"], r["width"], r["height"]) for r in results] == [("object.ply", 32, 24), ("object.ply", 48, 32)]
    for result in results:
        assert (result["num_gaussians"], result["cameras"], result["sh_degree"]) == (200, NUM_CAMERAS, 2)
        assert result["one_image"]["forward_backward_ms"] > 0
    output = capsys.readouterr().out
    assert "object.ply: 48x32, 200 Gaussians" in output
    assert "5 cameras\nintersections per tile: median" in output


def test_several_scenes_are_measured_one_after_the_other(ply, tmp_path, capsys):
    other = tmp_path / "other.ply"
    write_standard(other, scenes.cloud(50))
    arguments = ["--device", "cpu", "--repeats", "1", "--sizes", "16x16", "--scene", str(ply), "--scene", str(other)]
    assert main(["bench", *arguments]) == 0
    output = capsys.readouterr().out
    assert 0 < output.index("object.ply: 16x16") < output.index("other.ply: 16x16")
    assert "small" not in output


def test_cameras_on_a_circle_look_at_most_of_the_scene_from_all_sides():
    means = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0)) * 2 + torch.tensor([5.0, -3.0, 1.0])
    cameras = circle(means)
    positions = torch.stack([camera.position for camera in cameras])
    offset = positions.mean(0) - means.median(0).values
    assert float(offset[[0, 2]].abs().max()) < 1e-4
    assert float(offset[1]) < -1.0  # y points down: they are above the scene
    assert float(positions[:, 1].std()) < 1e-5
    for camera in cameras:
        assert float(camera.project(means)[3].float().mean()) > 0.75


def test_a_scene_fills_the_images_of_the_circle():
    means = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0))
    for camera in circle(means):
        rows, _, _, visible = camera.project(means)
        low, high = rows[visible].float().quantile(torch.tensor([0.01, 0.99]))
        assert high - low > 0.8 * camera.height


def test_the_views_of_a_file_share_its_gaussians(ply):
    (views,) = trained_views(ply, [(32, 24)], "cpu")
    assert len({splats.means.data_ptr() for splats in views.splats}) == 1
    assert torch.equal(views.splats[0].means, torch.from_numpy(read_cloud(ply).means))


def test_a_run_is_seen_by_its_training_cameras_at_their_times(tmp_path):
    run = tiny.finished(tmp_path)
    (views,) = trained_views(run, [(32, 24)], "cpu")
    opened = open_scene(run, "cpu")
    capture, scene = opened.open_corrected_capture(quiet=True), opened.trained_scene()
    expected = [capture.cameras[name] for name in capture.train]
    chosen = [expected[0], expected[-1]]
    for camera, splats, train in zip(
        (views.cameras[0], views.cameras[-1]), (views.splats[0], views.splats[-1]), chosen, strict=True
    ):
        assert camera.time == train.time
        assert torch.equal(camera.viewmat, train.viewmat)
        assert torch.equal(splats.means, scene.splats(train.time).means)


@pytest.mark.parametrize("antialias", [False, True])
def test_the_measured_images_are_those_of_the_scene(tmp_path, antialias):
    path = tmp_path / "object.ply"
    write_standard(path, dataclasses.replace(scenes.cloud(200, 1), antialias=antialias))
    (views,) = trained_views(path, [(48, 32)], "cpu")
    workloads = measure.make_workloads(Bench(device="cpu"), views, RenderSettings(antialias=views.antialias))
    scene = open_scene(path, "cpu").trained_scene()
    for workload, camera in zip(workloads["one_image"], views.cameras, strict=True):
        (image,) = workload.forward()
        assert float(image.max()) > 0.1
        assert torch.allclose(image, scene.render(camera, time=0.0).joint.image, atol=1e-6)


def test_a_damaged_scene_is_refused_with_one_line(ply, capsys):
    ply.write_bytes(ply.read_bytes()[:-100])
    assert main(["bench", "--device", "cpu", "--scene", str(ply)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "object.ply" in line
