"""Rolling shutters in the projection: values and gradients in double precision, and where points are truly seen."""

import itertools
import math

import pytest
import torch

from tests.ops.alone import project
from tests.ops.test_lenses import PANORAMA, VIEWS, gaussians, scattered
from tests.ops.test_projection import (
    assert_same_gradients,
    assert_same_values,
    gradients,
    in_double,
    inputs,
    random_gradient_rows,
)
from tests.reference import lenses, shutter
from tests.reference import rows as rows_reference
from tests.reference.projection import project as reference
from tests.scenes import make_camera, relative_error
from warpgs.ops.projection import Geometry, View

CAMERA = make_camera()
MOTION = torch.tensor([[0.12, -0.18, 0.08], [0.25, 0.15, -0.12]])
PINHOLE = View(CAMERA.viewmat, CAMERA.K, *CAMERA.size, motion=MOTION)
CASES = {
    "pinhole": PINHOLE,
    **{lens: view._replace(motion=MOTION) for lens, view in {**VIEWS, "panorama": PANORAMA}.items()},
}


def case(lens):
    return Geometry(*inputs()) if lens == "pinhole" else scattered(CASES[lens])


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("lens", CASES)
def test_values_equal_the_reference(lens, antialias):
    view, geometry = CASES[lens], case(lens)
    geometry.means[0, :2] += 2e-4  # the reference's fisheye is 0 / 0 on the axis
    splats = project(geometry, view, antialias=antialias)
    expected = reference(Geometry(*(t.double() for t in geometry)), in_double(view), antialias=antialias)
    assert expected[-1].sum() > 20
    assert_same_values(splats, expected, 3e-6)


@pytest.mark.parametrize("lens", CASES)
def test_gradients_equal_the_reference(lens):
    geometry = case(lens)
    geometry.means[0, :2] += 2e-4
    rows = random_gradient_rows(len(geometry.means))
    visible = assert_same_gradients(geometry, CASES[lens], rows, lens == "radial", of_camera=True)
    assert visible.sum() > 20


def true_points(t: torch.Tensor, view: View) -> torch.Tensor:
    """[N, 2] points of the image at the rows that see [N, 3] points, by bisection."""
    low, high = torch.full_like(t[:, 0], -1.0), torch.ones_like(t[:, 0])
    for _ in range(60):
        s = 0.5 * (low + high)
        y = lenses.point_and_jacobian(shutter.at_row(t, view, s), view)[0][:, 1]
        is_later = y > (s + 0.5) * view.height
        low, high = torch.where(is_later, s, low), torch.where(is_later, high, s)
    return lenses.point_and_jacobian(shutter.at_row(t, view, s), view)[0]


@pytest.mark.parametrize("lens", CASES)
def test_points_are_where_their_row_sees_them(lens):
    view = in_double(CASES[lens])
    geometry = Geometry(*(t.double() for t in case(lens)))
    means2d, *_, visible = reference(geometry, view)
    true = true_points(geometry.means @ view.viewmat[:3, :3].T + view.viewmat[:3, 3], view)
    still = reference(geometry, view._replace(motion=None))[0]
    inside = visible & ((true > 0) & (true < torch.tensor([view.width, view.height]))).all(1)
    assert inside.sum() > 10
    assert (still - true)[inside].norm(dim=1).max() > 2.0
    assert (means2d - true)[inside].norm(dim=1).max() < 0.05


@pytest.mark.parametrize("lens", CASES)
def test_the_shape_of_a_splat_is_that_of_points_that_their_own_rows_see(lens):
    view = in_double(CASES[lens])
    t = gaussians(torch.tensor([[0.2, -0.3, 1.5], [-0.4, 0.2, 1.8], [0.1, 0.1, 2.0]])).means.double()
    J = shutter.point_and_jacobian(t, view)[1]
    for axis, step in enumerate(1e-5 * torch.eye(3, dtype=torch.float64)):
        difference = (true_points(t + step, view) - true_points(t - step, view)) / 2e-5
        torch.testing.assert_close(J[:, :, axis], difference, rtol=2e-3, atol=2e-2)


def test_gradients_of_the_motion_are_differences_of_values():
    geometry, rows = Geometry(*inputs()), random_gradient_rows(150, "means2d")
    motion = MOTION.clone().requires_grad_()
    v_motion = gradients(geometry, PINHOLE._replace(motion=motion), rows).motion
    doubles = Geometry(*(t.double() for t in geometry))
    _, conics, _, opacities, visible = reference(doubles, in_double(PINHOLE))
    v_means2d = rows_reference.splat_gradients(conics, opacities, rows[0, :, 2:].double())[0][visible]

    def value(motion):
        return (reference(doubles, in_double(PINHOLE._replace(motion=motion)))[0][visible] * v_means2d).sum()

    for index in itertools.product(range(2), range(3)):
        step = torch.zeros(2, 3, dtype=torch.float64)
        step[index] = 1e-5
        difference = (value(MOTION + step) - value(MOTION - step)) / 2e-5
        assert v_motion[index].item() == pytest.approx(difference.item(), rel=1e-3, abs=1e-3)


@pytest.mark.parametrize("lens", CASES)
def test_a_camera_at_rest_sees_what_a_global_shutter_sees(lens):
    geometry, view = case(lens), CASES[lens]
    rolling = project(geometry, view._replace(motion=torch.zeros(2, 3)))
    for actual, expected in zip(rolling, project(geometry, view._replace(motion=None)), strict=True):
        torch.testing.assert_close(actual, expected)


def test_a_rotation_of_a_right_angle_is_resolved():
    motion = torch.tensor([[0.0, 0.0, math.pi / 2], [0.0, 0.0, 0.0]])
    view = View(torch.eye(4), CAMERA.K, *CAMERA.size, motion=motion)
    geometry = gaussians(torch.tensor([[0.3, 0.2, 2.0], [-0.2, -0.25, 2.0]]), 0.02)
    values = reference(Geometry(*(t.double() for t in geometry)), in_double(view))
    assert relative_error(project(geometry, view).means2d, values[0]) < 1e-6


def test_gaussians_behind_the_camera_at_their_row_are_culled():
    toward = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]])
    view = View(torch.eye(4), CAMERA.K, *CAMERA.size, motion=toward)
    geometry = gaussians(torch.tensor([[0.0, 0.25, 0.6], [0.0, -0.25, 0.6]]), 0.01)
    assert project(geometry, view).radii.gt(0).all(1).tolist() == [False, True]
