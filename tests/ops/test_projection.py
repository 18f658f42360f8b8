"""EWA projection: values, gradients, culling."""

import pytest
import torch

from tests.ops.alone import project
from tests.reference import rows as rows_reference
from tests.reference.projection import project as reference
from tests.scenes import GEOMETRY, generator, make_camera, make_splats, relative_error, weighted_sum
from warpgs.kernels.constants import CULLED_DEPTH, CULLED_LOG2_OPACITY
from warpgs.kernels.rows import gradient_stride
from warpgs.ops.projection import Geometry, View, project_bwd, project_fwd

CAMERA = make_camera()
VIEW = View(CAMERA.viewmat, CAMERA.K, *CAMERA.size)
NUM = 150


def inputs():
    splats = make_splats(NUM)
    return [getattr(splats, name) for name in GEOMETRY]


def project_here(*tensors, near=0.01, antialias=False):
    return project(Geometry(*tensors), VIEW, near=near, antialias=antialias)


def reference_here(*tensors, near=0.01, antialias=False):
    return reference(Geometry(*tensors), in_double(VIEW), near=near, antialias=antialias)


def in_double(view: View) -> View:
    parts = {name: getattr(view, name) for name in ("viewmat", "K", "distortion", "motion")}
    return view._replace(**{name: part.double() for name, part in parts.items() if part is not None})


def assert_same_values(splats, expected, tolerance: float) -> None:
    """Compares splats, and which are visible, with the reference's."""
    *values, visible = expected
    assert torch.equal(splats.radii.gt(0).all(-1), visible)
    for actual, value in zip(splats[:4], values, strict=True):
        assert relative_error(actual[visible], value[visible]) < tolerance


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("near", [0.01, 3.5])
def test_values_equal_the_reference(antialias, near):
    splats = project_here(*inputs(), near=near, antialias=antialias)
    expected = reference_here(*(t.double() for t in inputs()), near=near, antialias=antialias)
    assert 10 < expected[-1].sum() < NUM
    assert_same_values(splats, expected, 1e-6)


OUTPUTS = {"means2d": slice(3, 5), "conics": slice(5, 8), "depths": slice(1, 2), "opacities": slice(2, 3)}
"""The columns of gradient rows of one feature and depth that make up the gradient of each output."""


def random_gradient_rows(num: int, *outputs: str) -> torch.Tensor:
    """[1, N, stride] rows with random gradients of some outputs."""
    rows = torch.randn(1, num, gradient_stride(2), generator=generator())
    v_rows = torch.zeros_like(rows)
    for name in outputs or OUTPUTS:
        v_rows[..., OUTPUTS[name]] = rows[..., OUTPUTS[name]]
    return v_rows


def gradients(tensors, view, v_rows, antialias=False):
    """Gradients of the inputs of a projection for gradients of its rows."""
    rows, *_ = project_fwd(Geometry(*tensors), torch.zeros(len(tensors[0]), 1), view, 0.01, antialias, with_depth=True)
    return project_bwd(Geometry(*tensors), view, antialias, rows, v_rows)


def assert_same_gradients(tensors, view, v_rows, antialias, of_camera=False):
    """Compares the backward pass with that of the reference in double precision; returns what is visible."""
    given = {name: getattr(view, name) for name in ("viewmat", "K", "distortion", "motion")}
    names = [name for name, part in given.items() if part is not None and part.numel()]
    parts = {name: getattr(view, name).clone().requires_grad_(of_camera) for name in names}
    v = gradients(tensors, view._replace(**parts), v_rows, antialias)

    doubles = [t.double().requires_grad_() for t in (*tensors, *(getattr(view, name) for name in names))]
    double_view = view._replace(**dict(zip(names, doubles[4:], strict=True)))
    *values, visible = reference(Geometry(*doubles[:4]), double_view, antialias=antialias)
    v_means2d, v_conics, v_opacities = rows_reference.splat_gradients(values[1], values[3], v_rows[0, :, 2:].double())
    v_values = [t[visible].detach() for t in (v_means2d, v_conics, v_rows[0, :, 1].double(), v_opacities)]
    weighted_sum((value[visible] for value in values), v_values).backward()
    pairs = [*zip(v.geometry, doubles, strict=False)]
    pairs += [*zip((getattr(v, name) for name in names), doubles[4:], strict=True)] if of_camera else []
    for actual, double in pairs:
        assert (actual - double.grad).norm() <= 1e-5 * double.grad.norm()
    return visible


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("output", OUTPUTS)
def test_the_gradient_of_each_output_equals_the_reference(output, antialias):
    visible = assert_same_gradients(inputs(), VIEW, random_gradient_rows(NUM, output), antialias)
    assert 10 < visible.sum() < NUM


def far_out_inputs():
    """Gaussians beyond the margins of the image, where slopes are clamped."""
    means = torch.tensor([[-3.0, 0.1, 2.0], [3.0, 0.3, 2.0], [0.1, -3.0, 2.0], [0.2, 3.0, 2.0]])
    return means, torch.randn(4, 4), torch.full((4, 3), 1.5) * torch.rand(4, 3), torch.full((4,), 0.9)


def test_slopes_outside_the_margin_use_the_clamped_jacobian():
    tensors = far_out_inputs()
    splats = project_here(*tensors)
    *values, visible = reference_here(*(t.double() for t in tensors))
    assert visible.all()
    assert relative_error(splats.conics, values[1]) < 2e-6
    assert_same_gradients(tensors, VIEW, random_gradient_rows(4), antialias=False)


@pytest.mark.parametrize("antialias", [False, True])
def test_gradients_of_the_camera_equal_the_reference(antialias):
    geometry = [torch.cat(pair) for pair in zip(inputs(), far_out_inputs(), strict=True)]
    visible = assert_same_gradients(geometry, VIEW, random_gradient_rows(NUM + 4), antialias, of_camera=True)
    assert visible[-4:].all()


def round_gaussian(depth=2.0, x=0.0, opacity=0.5, scale=0.05) -> tuple[Geometry, View]:
    """A round Gaussian, and a camera at the origin with an image of 64 × 64 pixels."""
    K = torch.tensor([[50.0, 0.0, 32.0], [0.0, 50.0, 32.0], [0.0, 0.0, 1.0]])
    means, quats = torch.tensor([[x, 0.0, depth]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    geometry = Geometry(means, quats, torch.full((1, 3), scale), torch.tensor([opacity]))
    return geometry, View(torch.eye(4), K, 64, 64)


def one(antialias=False, **values):
    return project(*round_gaussian(**values), antialias=antialias)


def assert_culled(geometry: Geometry, view: View, antialias=False):
    rows, radii, order = project_fwd(geometry, torch.rand(1, 1), view, 0.01, antialias, with_depth=True)
    assert not radii.any()
    assert rows.packed[0, 1, 1] == CULLED_LOG2_OPACITY
    assert order.keys[0] == CULLED_DEPTH
    v = project_bwd(geometry, view, antialias, rows, random_gradient_rows(1), with_offsets=True)
    assert not any(gradient.any() for gradient in (*v.geometry, v.screen_offsets))


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    "culled",
    [
        *({"depth": value} for value in (-2.0, 0.0, 0.01)),
        *({"x": value} for value in (5.0, -5.0)),
        *({"opacity": value} for value in (0.9999 / 255, 1.0001, -0.5, float("nan"))),
        *({"scale": value} for value in (4e7, float("inf"), float("nan"))),
    ],
)
def test_culled_gaussians_are_marked_and_have_no_gradient(culled, antialias):
    assert one(antialias=antialias).radii.min() > 0
    assert_culled(*round_gaussian(**culled), antialias)


def test_a_depth_that_overflows_is_culled():
    viewmat = torch.eye(4)
    viewmat[2, 3] = 3e38
    geometry = [torch.tensor([[0.0, 0.0, 3e38]]), torch.ones(1, 4), torch.ones(1, 3), torch.ones(1)]
    assert_culled(Geometry(*geometry), View(viewmat, CAMERA.K, *CAMERA.size))


def test_gaussians_are_culled_from_a_distance_of_1e10_on():
    assert one(depth=9.99e9).radii.min() > 0
    assert not one(depth=1e10).radii.any()
    assert one(depth=7e9, x=-6.1e9, scale=1e9).radii.min() > 0
    assert not one(depth=8e9, x=-7e9, scale=1e9).radii.any()


def test_just_visible_opacity_and_depth_are_kept():
    assert one(opacity=1.0001 / 255).radii.min() > 0
    assert one(opacity=1 / 255).radii.eq(1).all()  # which reaches no further than its mean
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
    geometry = Geometry(*(t[:num].contiguous() for t in inputs()))
    view = View(*(t.clone().requires_grad_() for t in (CAMERA.viewmat, CAMERA.K)), *CAMERA.size)
    rows, *_ = project_fwd(geometry, torch.rand(num, 1), view, 0.01, False, with_depth=True)
    v = project_bwd(geometry, view, False, rows, random_gradient_rows(num))
    for gradient, tensor in zip((*v.geometry, v.viewmat, v.K), (*geometry, *view[:2]), strict=True):
        assert gradient.shape == tensor.shape
        assert gradient.isfinite().all()
