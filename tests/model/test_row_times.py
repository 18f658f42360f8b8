"""Dynamic Gaussians at the times of the rows of a rolling shutter that see them."""

import dataclasses
import math

import pytest
import torch
from scipy.interpolate import BSpline

from tests import plain
from tests.scenes import as_gaussians, generator, make_splats
from warpgs.cameras import Camera, intrinsic_matrix
from warpgs.model.scene import SplitScene
from warpgs.rendering import render

SIZE, FOCAL, DEPTH = (64, 96), 80.0, 4.0
DURATION, TIME = 0.2, 0.5
STATIC = torch.zeros(2, 3)
CAMERA = Camera(
    torch.eye(4),
    torch.from_numpy(intrinsic_matrix((FOCAL, FOCAL), (SIZE[0] / 2, SIZE[1] / 2))).float(),
    *SIZE,
    TIME,
    motion=STATIC,
    duration=DURATION,
)
ACROSS, ASLANT = (1.0, 0.0, 0.0), (0.6, 0.4, 0.2)
MIDDLE_TIME = torch.tensor([TIME])


def moving(velocity, num: int = 1) -> SplitScene:
    """A scene without static Gaussians, whose dynamic ones move at a constant velocity from where they are at TIME."""
    config = plain.model(deformation="splines", position_bands=2, time_bands=2, depth=2, width=8)
    low, high = torch.tensor([[-0.5, -1.6, DEPTH], [0.5, 1.6, DEPTH + 0.5]])
    spread = low + (high - low) * torch.rand(num, 3, generator=generator())
    splats = dataclasses.replace(make_splats(num), means=spread, scales=torch.full((num, 3), 0.02))
    scene = SplitScene(as_gaussians(make_splats(0)), as_gaussians(splats), config, torch.zeros(3), torch.ones(3))
    scene.deformation.resize(1, 5)
    times = torch.arange(-1, 4) / 2.0  # of control points of a straight path
    scene.deformation.paths.data[0] = (times[:, None] - TIME) * torch.tensor(velocity)
    return scene


def true_row_and_point(mean: torch.Tensor, velocity) -> tuple[float, float]:
    """Where a point that moves is seen through CAMERA at rest, by bisection of the row's time in double precision."""
    mean, velocity = mean.double(), torch.tensor(velocity, dtype=torch.float64)

    def seen(s: float) -> tuple[float, float]:
        x, y, z = (mean + s * DURATION * velocity).tolist()
        return FOCAL * x / z + SIZE[0] / 2, FOCAL * y / z + SIZE[1] / 2

    low, high = -1.0, 1.0
    for _ in range(60):
        s = 0.5 * (low + high)
        low, high = (s, high) if seen(s)[1] > (s + 0.5) * SIZE[1] else (low, s)
    return seen(low)


@pytest.mark.parametrize(("velocity", "tolerance"), [(ACROSS, 2e-5), (ASLANT, 0.02)])
def test_a_moving_gaussian_lands_where_its_row_sees_it(velocity, tolerance):
    """One that moves across rows is there but for the square of its way over the height of the image."""
    scene = moving(velocity, 20)
    delayed = scene.splats(MIDDLE_TIME, time_noise=scene.with_delays(CAMERA, MIDDLE_TIME)).means
    means = scene.dynamic.means.detach()
    found, still = (CAMERA.place(points)[0].double() for points in (delayed, means))
    truth = torch.tensor([true_row_and_point(mean, velocity) for mean in means], dtype=torch.float64)
    assert (still - truth).norm(dim=1).max() > 0.9
    assert (found - truth).norm(dim=1).max() < tolerance


def test_the_image_shows_it_there():
    scene = moving(ACROSS)
    scene.dynamic.means.data.copy_(torch.tensor([[0.05, 1.8, DEPTH]]))
    scene.dynamic.logit_opacities.data.fill_(math.log(9.0))
    splats = scene.splats(MIDDLE_TIME, time_noise=scene.with_delays(CAMERA, MIDDLE_TIME))
    alpha = render(splats, CAMERA).joint.alpha.detach()
    x = torch.arange(SIZE[0]) + 0.5
    y = torch.arange(SIZE[1]) + 0.5
    total = alpha.double().sum()
    found = ((alpha.sum(0) * x).sum() / total, (alpha.sum(1) * y).sum() / total)
    expected = true_row_and_point(scene.dynamic.means[0].detach(), ACROSS)
    assert [float(value) for value in found] == pytest.approx(expected, abs=0.02)


def test_gradients_of_paths_equal_those_in_double_precision_and_differences():
    scene, weights = moving(ASLANT, 30), torch.randn(30, 3, generator=generator())
    paths = scene.deformation.paths
    delays = scene.with_delays(CAMERA, MIDDLE_TIME)
    (scene.splats(MIDDLE_TIME, time_noise=delays).means * weights).sum().backward()

    knots = (torch.arange(-3, 6) / 2.0).double().numpy()
    bases = torch.from_numpy(BSpline.design_matrix((delays.double() + TIME).numpy(), knots, 3).toarray())
    expected = bases.T @ weights.double()
    torch.testing.assert_close(paths.grad[0].double(), expected, rtol=1e-5, atol=1e-5)

    def value(change: float) -> float:
        """With the rows that see them before the change."""
        with torch.no_grad():
            paths[0, 2, 1] += change
            means = scene.splats(MIDDLE_TIME, time_noise=delays).means
            paths[0, 2, 1] -= change
            return float((means.double() * weights).sum())

    assert float(paths.grad[0, 2, 1]) == pytest.approx((value(0.25) - value(-0.25)) / 0.5, rel=1e-4)


def test_noise_moves_the_times_of_all_rows():
    scene, noise = moving(ACROSS, 5), torch.tensor([0.05])
    delays = scene.with_delays(CAMERA, MIDDLE_TIME)
    torch.testing.assert_close(scene.with_delays(CAMERA, MIDDLE_TIME, noise), delays + noise)


@pytest.mark.parametrize("changes", [{"motion": None}, {"duration": 0.0}])
def test_without_a_readout_there_is_nothing_to_compute(changes, monkeypatch):
    scene, noise = moving(ACROSS, 5), torch.tensor([0.05])
    monkeypatch.setattr(scene.deformation, "forward", lambda *_: pytest.fail("evaluated"))
    camera = dataclasses.replace(CAMERA, **changes)
    assert scene.with_delays(camera, MIDDLE_TIME, noise) is noise
    assert scene.with_delays(camera, MIDDLE_TIME) is None


def test_rows_read_from_the_last_to_the_first_are_earlier_below():
    delays = CAMERA.delays(torch.tensor([[0.0, 1.2, DEPTH], [0.0, -1.2, DEPTH]]))
    expected = DURATION * torch.tensor([0.25, -0.25])
    torch.testing.assert_close(delays, expected)
    upward = dataclasses.replace(CAMERA, duration=-DURATION)
    torch.testing.assert_close(upward.delays(torch.tensor([[0.0, 1.2, DEPTH]])), -expected[:1])


@pytest.mark.parametrize("duration", [1.5, math.nan])
def test_a_duration_longer_than_the_capture_is_refused(duration):
    with pytest.raises(ValueError, match=f"duration must be from -1 to 1, as times are in .* got {duration}"):
        dataclasses.replace(CAMERA, duration=duration)
