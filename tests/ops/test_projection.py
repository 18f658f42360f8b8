"""EWA projection: values, gradients, culling."""

import pytest
import torch

from tests.ops.alone import project
from tests.reference.projection import project as reference
from tests.scenes import GEOMETRY, make_camera, make_splats, random_like, relative_error, weighted_sum
from warpgs.ops.projection import Geometry, View

CAMERA = make_camera()
NUM = 150


def inputs(requires_grad: bool = False):
    splats = make_splats(NUM)
    return [getattr(splats, name).clone().requires_grad_(requires_grad) for name in GEOMETRY]


def project_here(*tensors, near=0.01, antialias=False):
    view = View(CAMERA.viewmat, CAMERA.K, *CAMERA.size)
    return project(Geometry(*tensors), view, near=near, antialias=antialias)


def reference_here(*tensors, near=0.01, antialias=False):
    view = View(CAMERA.viewmat.double(), CAMERA.K.double(), *CAMERA.size)
    return reference(Geometry(*tensors), view, near=near, antialias=antialias)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("near", [0.01, 3.5])
def test_values_equal_the_reference(antialias, near):
    splats = project_here(*inputs(), near=near, antialias=antialias)
    *values, visible = reference_here(*(t.double() for t in inputs()), near=near, antialias=antialias)
    assert 10 < visible.sum() < NUM
    assert torch.equal(splats.radii.gt(0).all(-1), visible)
    for actual, expected in zip(splats[:4], values, strict=True):
        assert relative_error(actual[visible], expected[visible]) < 1e-6


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("output", range(4))
def test_the_gradient_of_each_output_equals_the_reference(output, antialias):
    ours, theirs = inputs(True), [t.double().requires_grad_() for t in inputs()]
    splats = project_here(*ours, antialias=antialias)
    *values, visible = reference_here(*theirs, antialias=antialias)
    (v_output,) = random_like([splats[output]])
    weighted_sum([splats[output]], [v_output]).backward()
    weighted_sum([values[output][visible]], [v_output[visible]]).backward()
    for actual, expected in zip(ours, theirs, strict=True):
        wanted = torch.zeros_like(expected) if expected.grad is None else expected.grad
        assert (actual.grad - wanted).norm() <= 1e-5 * wanted.norm()


def test_slopes_outside_the_margin_use_the_clamped_jacobian():
    means = torch.tensor([[-3.0, 0.1, 2.0], [3.0, 0.3, 2.0], [0.1, -3.0, 2.0], [0.2, 3.0, 2.0]])
    rest = torch.randn(4, 4), torch.full((4, 3), 1.5) * torch.rand(4, 3), torch.full((4,), 0.9)
    ours = [t.clone().requires_grad_() for t in (means, *rest)]
    theirs = [t.double().requires_grad_() for t in (means, *rest)]
    splats = project_here(*ours)
    *values, visible = reference_here(*theirs)
    assert visible.all()
    v_outputs = random_like(splats[:4])
    weighted_sum(splats[:4], v_outputs).backward()
    weighted_sum(values, v_outputs).backward()
    assert relative_error(splats.conics, values[1]) < 2e-6
    for actual, expected in zip(ours, theirs, strict=True):
        assert relative_error(actual.grad, expected.grad) < 1e-5


@pytest.mark.parametrize("antialias", [False, True])
def test_gradients_of_the_camera_equal_the_reference(antialias):
    far_out = torch.tensor([[-3.0, 0.1, 2.0], [3.0, 0.3, 2.0], [0.1, -3.0, 2.0], [0.2, 3.0, 2.0]])  # clamped slopes
    rest = torch.randn(4, 4), torch.full((4, 3), 1.5) * torch.rand(4, 3), torch.full((4,), 0.9)
    geometry = [torch.cat(pair) for pair in zip(inputs(), (far_out, *rest), strict=True)]
    ours = [t.clone().requires_grad_() for t in (CAMERA.viewmat, CAMERA.K)]
    theirs = [t.double().requires_grad_() for t in (CAMERA.viewmat, CAMERA.K)]
    splats = project(Geometry(*geometry), View(*ours, *CAMERA.size), antialias=antialias)[:4]
    doubles = Geometry(*(t.double() for t in geometry))
    *values, visible = reference(doubles, View(*theirs, *CAMERA.size), antialias=antialias)
    assert visible[-4:].all()
    v_outputs = random_like(splats)
    weighted_sum(splats, v_outputs).backward()
    weighted_sum((v[visible] for v in values), (c[visible] for c in v_outputs)).backward()
    for actual, expected in zip(ours, theirs, strict=True):
        assert relative_error(actual.grad, expected.grad) < 1e-5


def one(depth=2.0, x=0.0, opacity=0.5, scale=0.05, antialias=False):
    """The projection of a round Gaussian to a 64 × 64 image of a camera at the origin."""
    K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 32.0], [0.0, 0.0, 1.0]])
    means, quats = torch.tensor([[x, 0.0, depth]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    geometry = Geometry(means, quats, torch.full((1, 3), scale), torch.tensor([opacity]))
    return project(geometry, View(torch.eye(4), K, 64, 64), antialias=antialias)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    "culled",
    [
        *({"depth": value} for value in (-2.0, 0.0, 0.01)),
        *({"x": value} for value in (5.0, -5.0)),
        *({"opacity": value} for value in (0.9999 / 255, 1.0001, -0.5, float("nan"))),
        *({"scale": value} for value in (float("inf"), float("nan"))),
    ],
)
def test_culled_gaussians_have_radius_zero_and_zero_values(culled, antialias):
    assert one(antialias=antialias).radii.min() > 0
    for value in one(**culled, antialias=antialias):
        assert not value.any()


def test_a_depth_that_overflows_is_culled():
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3e38
    geometry = [torch.tensor([[0.0, 0.0, 3e38]]), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1)]
    for value in project(Geometry(*geometry), View(viewmat, CAMERA.K, *CAMERA.size)):
        assert not value.any()


def test_gaussians_are_culled_from_a_distance_of_1e10_on():
    assert one(depth=9.99e9).radii.min() > 0
    assert not one(depth=1e10).radii.any()
    assert one(depth=7e9, x=-6.1e9, scale=1e9).radii.min() > 0
    assert not one(depth=8e9, x=-7e9, scale=1e9).radii.any()


def test_just_visible_opacity_and_depth_are_kept():
    assert one(opacity=1.0001 / 255).radii.min() > 0
    assert one(depth=0.0101, scale=1e-4).radii.min() > 0


def test_alpha_is_below_the_cut_off_outside_the_radii():
    splats = project_here(*inputs())
    seen = splats.radii[:, 0] > 0
    a, b, c = splats.conics[seen].double().unbind(-1)
    reach = 2 * (255 * splats.opacities[seen].double()).log()
    determinant = a * c - b * b
    half_sizes = torch.stack([(reach * c / determinant).sqrt(), (reach * a / determinant).sqrt()], -1)
    radii = splats.radii[seen].double()
    assert (radii >= half_sizes - 1e-4).all()
    assert (radii <= half_sizes + 1 + 1e-4).all()


def test_antialiasing_only_lowers_opacities():
    plain, compensated = project_here(*inputs()), project_here(*inputs(), antialias=True)
    both = (plain.radii[:, 0] > 0) & (compensated.radii[:, 0] > 0)
    assert both.sum() > 10
    assert (compensated.opacities[both] < plain.opacities[both]).all()
    assert torch.equal(compensated.conics[both], plain.conics[both])


@pytest.mark.parametrize("num", [0, 1])
def test_few_gaussians_are_enough(num):
    splats = make_splats(num)
    tensors = [getattr(splats, name).requires_grad_() for name in GEOMETRY]
    camera = [t.clone().requires_grad_() for t in (CAMERA.viewmat, CAMERA.K)]
    project(Geometry(*tensors), View(*camera, *CAMERA.size)).means2d.sum().backward()
    assert all(t.grad.shape == t.shape for t in (*tensors, *camera))
