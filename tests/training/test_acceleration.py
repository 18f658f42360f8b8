"""The acceleration of dynamic Gaussians: what it measures, and of which Gaussians."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch

from tests import plain, tiny
from tests.scenes import along_z, as_gaussians, generator, make_camera, make_splats, select
from warpgs.model.poses import PoseCorrections
from warpgs.model.scene import InTraining, SplitScene
from warpgs.ops.dropout import MAX_SEED
from warpgs.training import acceleration as module
from warpgs.training.acceleration import MAX_SAMPLES, acceleration, sampled_points
from warpgs.training.losses import LossInputs

pytestmark = pytest.mark.usefixtures("quickly")

CAMERA = along_z(400.0, (480, 270))


def sample_paths(scene, time, interval, seed):
    """The [3, K, 3] paths of a step."""
    points = sampled_points(scene, time, interval, seed)
    return scene.splats_in_training(InTraining(points=points), time, True, True, None, None)[1].view(3, -1, 3)


def measured(paths, camera=CAMERA, num_static=0):
    """The term for [3, K, 3] paths in a view of 100 pixels."""
    view = SimpleNamespace(
        camera=camera, image=torch.zeros(10, 10, 3), static_mask=torch.arange(100).view(10, 10) < num_static
    )
    points = None if paths is None else paths.flatten(0, 1)
    return acceleration(LossInputs(plain.loss(), view, None, None, None, None, None, points))


def accelerated(pixels, depth=2.0):
    """A path at a depth whose second difference is a number of pixels of ``CAMERA``."""
    end = torch.tensor([0.5 * pixels * depth / 400.0, 0.0, 0.0])
    middle = torch.tensor([0.3, -0.2, depth])
    return torch.stack([middle + end, middle, middle + end])[:, None]


def scene_of(num_dynamic):
    splats = make_splats(60)
    gaussians = (
        as_gaussians(select(splats, torch.arange(60) < 10)),
        as_gaussians(select(splats, torch.arange(60) < num_dynamic)),
    )
    return SplitScene(*gaussians, tiny.MODEL, torch.zeros(3), torch.ones(3))


def test_motion_at_constant_speed_costs_nothing():
    paths = torch.stack([torch.tensor([[0.1 * k, 0.2 * k, 2.0 + 0.1 * k]]) for k in range(3)])
    assert measured(paths).item() == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("pixels", [0.01, 0.5, 1.0, 30.0])
@pytest.mark.parametrize("depth", [0.2, 2.0, 50.0])
def test_accelerations_are_measured_in_pixels_at_the_depth_of_the_gaussian(pixels, depth):
    expected = pixels**2 / math.sqrt(pixels**2 + 1.0)
    assert measured(accelerated(pixels, depth)).item() == pytest.approx(expected, rel=2e-3, abs=1e-6)


def test_pixels_that_are_not_square_count_by_the_mean_of_their_sides():
    camera = dataclasses.replace(CAMERA, K=CAMERA.K * torch.tensor([[1.0], [0.5], [1.0]]))
    assert measured(accelerated(2.0), camera).item() == pytest.approx(measured(accelerated(1.5)).item(), rel=1e-4)


def test_the_term_is_the_mean_over_gaussians():
    paths = torch.cat([accelerated(p) for p in (1.0, 2.0, 5.0)], 1)
    parts = [measured(accelerated(p)).item() for p in (1.0, 2.0, 5.0)]
    assert measured(paths).item() == pytest.approx(sum(parts) / 3, rel=1e-5)


def test_the_term_is_proportional_to_the_dynamic_part_of_the_image():
    paths = accelerated(3.0)
    assert measured(paths, num_static=90).item() == pytest.approx(0.1 * measured(paths).item(), rel=1e-5)
    assert measured(paths, num_static=100).item() == 0.0


@pytest.mark.parametrize("depths", [(-2.0, 0.0), (-0.001, -100.0)])
def test_gaussians_behind_or_at_the_camera_count_as_0_and_get_no_gradient(depths):
    hidden = [accelerated(1.0, depth) + torch.tensor([0.1, 0.0, 0.0]).view(3, 1, 1) for depth in depths]
    paths = torch.cat([accelerated(1.0), *hidden], 1).requires_grad_()
    value = measured(paths)
    value.backward()
    assert value.item() == pytest.approx(measured(accelerated(1.0)).item() / 3, rel=1e-5)
    assert paths.grad[:, 0].any()
    assert not paths.grad[:, 1:].any()


def test_depth_gets_no_gradient_by_making_pixels_larger():
    paths = accelerated(2.0).requires_grad_()
    measured(paths).backward()
    assert paths.grad[:, 0, 2].abs().max() < 1e-6 * paths.grad.abs().max()


def test_cameras_get_no_gradient_by_moving_away():
    poses = PoseCorrections(torch.zeros(1, dtype=torch.int64), 1.0)
    measured(accelerated(2.0).requires_grad_(), poses.moved(CAMERA, torch.tensor([0]))).backward()
    assert all(parameter.grad is None for parameter in poses.parameters())


def test_without_dynamic_gaussians_the_term_is_0():
    scene = scene_of(0)
    time = torch.tensor([0.5])
    points = sampled_points(scene, time, 0.1, torch.tensor([7.0]))
    assert len(points.means) == 0
    assert scene.splats_in_training(InTraining(points=points), time, True, True, None, None)[1] is None
    assert measured(None, make_camera()).item() == 0.0


def test_without_dynamic_gaussians_the_deformation_is_not_trained(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path / "run", dataclasses.replace(tiny.CONFIG, assume="static"))
    assert tiny.train(trainer)
    assert not len(trainer.scene.dynamic)
    state = trainer.step.optimizer.state
    assert not any(state.get(parameter) for parameter in trainer.scene.deformation.parameters())


def test_paths_are_one_frame_apart_and_at_most_half_a_frame_from_the_time(monkeypatch):
    scene, times = scene_of(5), []

    def deformed(means, time):
        times.append(time[5:])  # those after the five Gaussians' own
        return torch.zeros(len(means), 10)

    monkeypatch.setattr(scene, "deformation", torch.nn.Identity())
    monkeypatch.setattr(scene.deformation, "forward", deformed)
    for seed in (0, MAX_SEED // 3, MAX_SEED - 1):
        sample_paths(scene, torch.tensor([0.4]), 0.1, torch.tensor([float(seed)]))
    before, moment, after = torch.stack(times).view(3, 3, 5).unbind(1)
    assert all(torch.equal(time, time[:, :1].expand(3, 5)) for time in (before, moment, after))
    before, moment, after = before[:, 0], moment[:, 0], after[:, 0]
    torch.testing.assert_close(moment - before, torch.full((3,), 0.1))
    torch.testing.assert_close(after - moment, torch.full((3,), 0.1))
    torch.testing.assert_close(moment, 0.4 + 0.1 * torch.tensor([-0.5, 1 / 3 - 0.5, 0.5]))


def test_paths_are_positions_deformed_at_their_times():
    scene, time = scene_of(5), torch.tensor([0.4])
    with torch.no_grad():
        scene.deformation.trunk.values.copy_(torch.randn(scene.deformation.trunk.values.shape, generator=generator(1)))
    paths = sample_paths(scene, time, 0.1, torch.tensor([float(MAX_SEED // 2)]))  # no Gaussian but the order changes
    means = scene.dynamic.means.detach()
    for path, shift in zip(paths, (-0.1, 0.0, 0.1), strict=True):
        expected = means + scene.deformation(means, time + shift)[:, :3]
        torch.testing.assert_close(path[:, 0].sort().values, expected[:, 0].sort().values)


def test_all_gaussians_are_sampled_equally_often(monkeypatch):
    monkeypatch.setattr(module, "MAX_SAMPLES", 4)
    scene = scene_of(7)
    scene.deformation.trunk.values.data.zero_()
    counts = torch.zeros(7)
    for seed in range(7):
        positions = sample_paths(scene, torch.tensor([0.5]), 0.1, torch.tensor([float(seed)]))[1]
        counts += (positions[:, None] == scene.dynamic.means[None]).all(2).sum(0)
    assert counts.tolist() == [4.0] * 7


def test_only_the_deformation_gets_gradients():
    scene = scene_of(5)
    scene.deformation.trunk.values.data.copy_(torch.randn(scene.deformation.trunk.values.shape, generator=generator(1)))
    measured(sample_paths(scene, torch.tensor([0.5]), 0.1, torch.tensor([3.0])), make_camera()).backward()
    assert scene.deformation.trunk.values.grad.abs().max() > 0.0
    assert all(parameter.grad is None for parameter in scene.dynamic.parameters())


def test_the_interval_is_the_median_time_between_training_views(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    times = sorted({trainer.capture.cameras[name].time for name in trainer.capture.train})
    gaps = torch.tensor(times).diff()
    assert trainer.views.interval == pytest.approx(gaps.median().item(), rel=1e-5)


def test_descending_the_term_straightens_paths():
    scene, time, seed = scene_of(5), torch.tensor([0.5]), torch.tensor([3.0])
    values = scene.deformation.trunk.values
    values.data.copy_(torch.randn(values.shape, generator=generator(1)))
    # Gradients that are 0 but for rounding must not become steps: ε is far above them.
    optimizer = torch.optim.Adam([values], 1e-2, eps=1e-4)
    terms = []
    for _ in range(100):
        optimizer.zero_grad()
        terms.append(measured(sample_paths(scene, time, 0.1, seed), make_camera()))
        terms[-1].backward()
        optimizer.step()
    assert terms[-1] < 0.2 * terms[0]


def test_a_step_adds_the_term_where_the_deformation_is_in_use(data, tmp_path):
    trainer = tiny.trainer(data, tmp_path)
    trainer._add_dynamic_gaussians()
    added = {}
    for iteration in (0, trainer.protocol.stage2.start):
        plan = trainer.protocol.at(iteration)
        trainer.step(plan, trainer._sample(plan))
        added[plan.phase.use_deformation] = "acceleration" in trainer.step.take_means().terms
    assert added == {False: False, True: True}


def test_a_weight_of_0_skips_the_term(data, tmp_path):
    loss = dataclasses.replace(tiny.CONFIG.loss, acceleration=0.0)
    trainer = tiny.trainer(data, tmp_path, dataclasses.replace(tiny.CONFIG, loss=loss))
    trainer._add_dynamic_gaussians()
    plan = trainer.protocol.at(trainer.protocol.stage2.start)
    trainer.step(plan, trainer._sample(plan))
    assert "acceleration" not in trainer.step.take_means().terms


def test_a_step_evaluates_the_deformation_once(data, tmp_path, monkeypatch):
    trainer = tiny.trainer(data, tmp_path)
    trainer._add_dynamic_gaussians()
    deformation, calls = trainer.scene.deformation, []
    forward = deformation.forward
    monkeypatch.setattr(deformation, "forward", lambda *args: (calls.append(len(args[0])), forward(*args))[1])
    plan, number = trainer.protocol.at(trainer.protocol.stage2.start), len(trainer.scene.dynamic)
    trainer.step(plan, trainer._sample(plan))
    assert 0 < number < MAX_SAMPLES
    assert calls == [4 * number]  # at the time of the view, and at the three of the sample, which has them all
