"""Playback: captured frames equal rendered frames. (On a real GPU: tests/training/test_cuda_training.py.)"""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch

from tests.export import scenes
from tests.scenes import shifted
from warpgs.config import RenderSettings
from warpgs.distortion import Distortion
from warpgs.rendering import render
from warpgs.runs.trained import MAX_GRAPHS, TrainedScene
from warpgs.runtime import graphs


@pytest.fixture
def captured(monkeypatch):
    """Sizes in the order of their capture; without a GPU a graph is a function that is called again."""
    sizes = []

    def capture(step):
        sizes.append(tuple(step()[0].shape[1::-1]))
        return step

    monkeypatch.setattr(graphs, "capture", capture)
    monkeypatch.setattr(TrainedScene, "uses_graphs", True)
    return sizes


@pytest.fixture
def trained():
    return scenes.trained_scene()


def test_what_plays_a_scene_imports_no_loader_and_no_ray_tracer():
    code = (
        "import sys, warpgs.runs.run, warpgs.video.render_run\n"
        "print(*(name for name in sys.modules if name.startswith('warpgs.')))"
    )
    imported = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "warpgs.runs.trained" in imported
    assert [name for name in imported if name.startswith("warpgs.captures.") or "loaders" in name] == []
    assert [name for name in imported if name.startswith("warpgs.synthetic.") or "raytrace" in name] == []


def test_a_trained_scene_prints_as_what_it_is(trained):
    static, dynamic = len(trained.scene.static), len(trained.scene.dynamic)
    gaussians = f"{static:,} static and {dynamic:,} dynamic Gaussians"
    assert repr(trained) == f"<TrainedScene: {gaussians}, iteration {trained.metadata.iteration:,}, on cpu>"


def test_one_graph_plays_every_camera_of_a_size(trained, captured):
    for k in range(3):
        camera = shifted(scenes.camera(), 0.1 * k, 0.1 * k)
        assert torch.equal(trained.play(camera), trained.render(camera).joint.image)
    assert captured == [(64, 48)]


def test_a_camera_with_distortion_plays_as_it_is_rendered(trained, captured):
    pinhole = scenes.camera()
    lens = Distortion.radial([-0.2], pinhole.K, pinhole.size)
    camera = dataclasses.replace(pinhole, distortion=lens)
    trained.play(pinhole)
    assert torch.equal(trained.play(camera), trained.render(camera).joint.image)
    assert not torch.equal(trained.play(camera), trained.play(pinhole))


def test_a_camera_with_a_rolling_shutter_plays_as_it_is_rendered(trained, captured):
    still = scenes.camera()
    camera = dataclasses.replace(still, motion=torch.tensor([[0.0, 0.1, 0.0], [0.2, 0.0, 0.0]]))
    trained.play(still)
    assert torch.equal(trained.play(camera), trained.render(camera).joint.image)
    assert not torch.equal(trained.play(camera), trained.play(still))


def test_each_row_shows_what_moves_where_it_is_then(trained):
    camera = dataclasses.replace(scenes.camera(time=0.5), motion=torch.zeros(2, 3), duration=0.2)
    times = [0.5 + ((row + 0.5) / camera.height - 0.5) * camera.duration for row in range(camera.height)]
    rows = [trained.render(camera.pinhole, time=time).joint.image[row] for row, time in enumerate(times)]
    rolling, still = (trained.render(seen).joint.image for seen in (camera, camera.pinhole))
    expected = torch.stack(rows)
    assert (rolling - expected).square().mean() < (still - expected).square().mean() / 10


def test_a_time_of_numpy_is_rendered_like_one_of_python(trained):
    expected = trained.render(scenes.camera(), time=0.25).joint.image
    (time,) = np.linspace(0.25, 1.0, 1)
    assert torch.equal(trained.render(scenes.camera(), time=time).joint.image, expected)
    assert torch.equal(trained.splats(time).means, trained.splats(0.25).means)


def test_images_are_rendered_as_the_config_says(trained):
    config = dataclasses.replace(trained.config, antialias=True, max_alpha=0.3)
    own = TrainedScene(trained.scene, config, trained.metadata).render(scenes.camera()).joint.image
    settings = RenderSettings(antialias=True, max_alpha=0.3)
    assert torch.equal(own, render(trained.splats(0.0), scenes.camera(), settings=settings).joint.image)
    for other in (RenderSettings(antialias=True), RenderSettings(max_alpha=0.3)):
        assert not torch.equal(own, render(trained.splats(0.0), scenes.camera(), settings=other).joint.image)


def test_depth_is_that_along_the_z_axis_weighted_by_contribution_and_0_where_nothing_is(trained):
    trained.metadata = dataclasses.replace(trained.metadata, use_deformation=False)
    for gaussians, z in ((trained.scene.static, 1.0), (trained.scene.dynamic, -1.0)):  # the camera is at -3
        gaussians.means[:, 2] = z
    joint, static, dynamic = trained.render(scenes.camera(), branches=True, depth=True)[:3]
    for layer, depth in ((static, 4.0), (dynamic, 2.0)):
        assert 0 < int((layer.alpha == 0).sum()) < layer.alpha.numel()
        assert torch.allclose(layer.depth, depth * (layer.alpha > 0))
    mean = (2.0 * dynamic.alpha + 4.0 * (joint.alpha - dynamic.alpha)) / joint.alpha.clamp_min(1e-6)
    assert torch.allclose(joint.depth, mean, rtol=1e-4)
    plain = trained.render(scenes.camera()).joint
    assert plain.depth is None
    assert torch.equal(plain.image, joint.image)


def test_each_size_is_captured_once(trained, captured):
    sizes = [(64, 48), (32, 24)]
    assert not trained.is_captured(sizes[0])
    for size in sizes * 2:
        assert trained.play(scenes.camera(*size)).shape == (size[1], size[0], 3)
    assert captured == sizes
    assert all(trained.is_captured(size) for size in sizes)


def test_the_oldest_of_too_many_graphs_is_dropped(trained, captured):
    sizes = [(32 + 2 * k, 24) for k in range(MAX_GRAPHS + 1)]
    for size in sizes:
        trained.play(scenes.camera(*size))
    assert [trained.is_captured(size) for size in sizes] == [False] + [True] * MAX_GRAPHS


def test_nothing_is_captured_on_the_cpu(trained):
    camera = scenes.camera(time=0.4)
    for _ in range(2):
        assert torch.equal(trained.play(camera), trained.render(camera).joint.image)
    assert not trained.is_captured(camera.size)


def test_a_given_time_replaces_that_of_the_camera(trained):
    at_time = trained.render(scenes.camera(time=0.7)).joint.image
    assert torch.equal(trained.render(scenes.camera(), time=0.7).joint.image, at_time)
    assert not torch.equal(trained.render(scenes.camera()).joint.image, at_time)


def test_without_the_residual_static_gaussians_have_their_own_colors(trained):
    plain, changed = trained.splats(0.5, residual=False), trained.splats(0.5)
    num = len(trained.scene.static)
    assert torch.equal(plain.sh[:num], trained.scene.static.sh)
    assert not torch.equal(changed.sh[:num, 0], plain.sh[:num, 0])
    assert torch.equal(changed.means, plain.means)
