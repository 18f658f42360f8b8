"""The whole render against the float64 reference: images, statistics, gradients."""

import dataclasses

import pytest
import torch

from tests.reference import projection as reference_projection
from tests.reference.render import render as reference
from tests.scenes import (
    GEOMETRY,
    HEIGHT,
    WIDTH,
    as_doubles,
    as_leaves,
    assert_same_gradients,
    error,
    float_tensors,
    generator,
    gradients,
    make_camera,
    make_splats,
    random_like,
    relative_error,
    select,
    weighted_sum,
)
from warpgs.config import RenderSettings
from warpgs.ops.projection import Geometry, View
from warpgs.rendering import opacities_on_screen, render

CAMERA = make_camera()
EVERYTHING = RenderSettings(branches=True, statistics=True)


def background(channels=3):
    return torch.linspace(0.1, 0.8, channels)


def outputs(rendering):
    layers = [layer for layer in (rendering.joint, rendering.static, rendering.dynamic) if layer is not None]
    return [layer.image for layer in layers] + [layer.alpha for layer in layers]


def reference_outputs(splats, behind, branches=True, **options):
    masks = (None, ~splats.is_dynamic, splats.is_dynamic) if branches else (None,)
    doubles, behinds = as_doubles(splats), behind if behind.ndim == 2 else behind.expand(len(masks), -1)
    pairs = zip(behinds, masks, strict=True)
    results = [reference(doubles, CAMERA, b, selected=mask, **options) for b, mask in pairs]
    return doubles, [r[0] for r in results] + [r[1] for r in results], results[0][2]


@pytest.mark.parametrize("options", [{}, {"antialias": True}, {"max_alpha": 0.6}])
@pytest.mark.parametrize("channels", [None, 3])
def test_images_statistics_and_gradients_equal_the_reference(channels, options):
    splats = as_leaves(make_splats(channels=channels))
    behind, behind64 = background().requires_grad_(), background().double().requires_grad_()
    result = render(splats, CAMERA, behind, dataclasses.replace(EVERYTHING, **options))
    doubles, expected, weights = reference_outputs(splats, behind64, **options)
    for actual, wanted in zip(outputs(result), expected, strict=True):
        assert error(actual, wanted) < 2e-6
    assert relative_error(result.weights, weights.sum((1, 2))) < 2e-6
    assert torch.equal(result.contributed, weights.sum((1, 2)) > 0)
    inputs, doubles = [*float_tensors(splats).values(), behind], [*doubles.values(), behind64]
    assert_same_gradients(outputs(result), expected, inputs, doubles)


def test_median_depth_with_a_gradient_is_refused():
    settings, splats = RenderSettings(depth=True, median=True), make_splats()
    with torch.no_grad():
        assert (render(splats, CAMERA, settings=settings).joint.depth > 0).any()
    with pytest.raises(ValueError, match="median depth has no gradient"):
        render(dataclasses.replace(splats, means=splats.means.clone().requires_grad_()), CAMERA, settings=settings)


@pytest.mark.parametrize("depth", [False, True])
def test_each_image_may_have_its_own_background(depth):
    splats, behind = as_leaves(make_splats()), torch.rand(3, 3, generator=generator()).requires_grad_()
    behind64 = behind.detach().double().requires_grad_()
    result = render(splats, CAMERA, behind, dataclasses.replace(EVERYTHING, depth=depth))
    doubles, expected, _ = reference_outputs(splats, behind64)
    for actual, wanted in zip(outputs(result), expected, strict=True):
        assert error(actual, wanted) < 2e-6
    inputs, doubles = [*float_tensors(splats).values(), behind], [*doubles.values(), behind64]
    assert_same_gradients(outputs(result), expected, inputs, doubles)


def test_the_joint_image_is_the_same_with_and_without_branches():
    splats = make_splats()
    alone, together = render(splats, CAMERA), render(splats, CAMERA, settings=EVERYTHING)
    assert error(alone.joint.image, together.joint.image) < 1e-6
    assert alone.static is None
    assert alone.weights is None


def smooth_splats():
    """Gaussians so wide that each contributes to every pixel, and so faint that no cut-off makes the image jump."""
    splats = make_splats(12)
    return dataclasses.replace(splats, scales=10 * splats.scales.clamp(min=0.2), opacities=0.1 + 0.3 * splats.opacities)


def test_in_the_smooth_scene_every_gaussian_contributes_to_every_pixel():
    _, _, weights = reference_outputs(smooth_splats(), background().double())
    assert weights.min() > 1e-4


def assert_gradient_predicts(value, step, settings, inputs_with):
    """Central differences along the gradient; the step is small against the scene, large against float32.

    ``inputs_with`` gives splats and camera with another value.
    """

    def loss(value):
        rendering = render(*inputs_with(value), background(), settings)
        return sum(output.double().square().sum() for output in outputs(rendering))

    value = value.detach().clone().requires_grad_()
    loss(value).backward()
    direction = value.grad / value.grad.norm()
    with torch.no_grad():
        slope = (loss(value + step * direction) - loss(value - step * direction)) / (2 * step)
    assert slope.item() == pytest.approx(value.grad.norm().item(), rel=1e-3)


@pytest.mark.parametrize("branches", [False, True])
@pytest.mark.parametrize("name", [*GEOMETRY, "sh"])
def test_gradients_predict_the_effect_of_a_small_step(name, branches):
    splats = as_leaves(smooth_splats())
    value, settings = getattr(splats, name).detach(), EVERYTHING if branches else None
    step = 1e-2 * value.norm() / value.numel() ** 0.5
    assert_gradient_predicts(value, step, settings, lambda v: (dataclasses.replace(splats, **{name: v}), CAMERA))


@pytest.mark.parametrize(("name", "step"), [("viewmat", 1e-3), ("K", 0.05)])
def test_the_gradient_of_the_camera_predicts_the_effect_of_a_small_step(name, step):
    value, splats = getattr(CAMERA, name), smooth_splats()
    assert_gradient_predicts(value, step, EVERYTHING, lambda v: (splats, dataclasses.replace(CAMERA, **{name: v})))


@pytest.mark.parametrize("channels", [1, 5])
def test_any_number_of_channels_can_be_rendered(channels):
    splats = as_leaves(make_splats(channels=channels))
    result = render(splats, CAMERA, background(channels))
    doubles, expected, _ = reference_outputs(splats, background(channels).double(), branches=False)
    assert error(result.joint.image, expected[0]) < 2e-6
    assert_same_gradients([result.joint.image], expected[:1], float_tensors(splats).values(), doubles.values())


@pytest.mark.parametrize("branches", [False, True])
@pytest.mark.parametrize("has_gradient", [lambda k: True, lambda k: k % 2 == 0, lambda k: k % 2 == 1, lambda k: k == 0])
def test_depth_and_gradients_of_any_subset_of_outputs_equal_the_reference(branches, has_gradient):
    splats = as_leaves(make_splats(channels=3))
    rendering = render(splats, CAMERA, background(), RenderSettings(depth=True, branches=branches))
    plain = render(splats, CAMERA, background(), RenderSettings(branches=branches))
    for actual, wanted in zip(outputs(rendering), outputs(plain), strict=True):
        assert torch.equal(actual, wanted)
    doubles = as_doubles(splats)
    viewmat = CAMERA.viewmat.double()
    depths = doubles["means"] @ viewmat[2, :3] + viewmat[2, 3]
    colors = torch.cat([doubles["colors"], depths[:, None]], -1)
    behind = torch.cat([background(), torch.zeros(1)]).double()
    actual, expected, smooth = [], [], []
    for mask in (None, ~splats.is_dynamic, splats.is_dynamic) if branches else (None,):
        image, alpha, _ = reference({**doubles, "colors": colors}, CAMERA, behind, selected=mask)
        expected += [image[..., :3], alpha, image[..., 3] / alpha.clamp_min(1e-6)]
        smooth += [1.0, 1.0, alpha.detach()]  # depth is not smooth where alpha is near 0
    for layer in (rendering.joint, rendering.static, rendering.dynamic)[: 3 if branches else 1]:
        assert not layer.depth[layer.alpha == 0].any()
        actual += [layer.image, layer.alpha, layer.depth]
    for k, (a, e) in enumerate(zip(actual, expected, strict=True)):
        assert relative_error(a, e) < (1e-5 if k % 3 == 2 else 2e-6)
    weights = [(w * s).float() for w, s in zip(random_like(expected), smooth, strict=True)]
    for values in (actual, expected):
        torch.autograd.backward(
            [v for k, v in enumerate(values) if has_gradient(k)],
            [w.to(values[k].dtype) for k, w in enumerate(weights) if has_gradient(k)],
        )
    for name in (*GEOMETRY, "colors"):
        wanted = doubles[name].grad
        if wanted is None:
            assert not gradients(splats)[name].any()
        else:
            assert relative_error(gradients(splats)[name], wanted) < 1e-5, name


@pytest.mark.parametrize("branches", [False, True])
def test_the_gradient_of_the_offsets_is_that_of_the_means_on_screen(branches, monkeypatch):
    kept = []
    project = reference_projection.project

    def project_and_keep(*args, **options):
        means2d, *rest = project(*args, **options)
        means2d.retain_grad()
        kept.append(means2d)
        return means2d, *rest

    monkeypatch.setattr(reference_projection, "project", project_and_keep)
    _, expected, _ = reference_outputs(as_leaves(make_splats()), background().double(), branches=branches)
    v_outputs = random_like(expected)
    weighted_sum(expected, v_outputs).backward()
    means2d_gradient = sum(m.grad for m in kept) * torch.tensor([WIDTH / 2, HEIGHT / 2])
    offsets = torch.zeros(60, 2, requires_grad=True)
    result = render(make_splats(), CAMERA, background(), RenderSettings(branches=branches), offsets)
    weighted_sum(outputs(result), v_outputs).backward()
    assert relative_error(offsets.grad, means2d_gradient) < 1e-5


def test_offsets_shift_gaussians_on_screen():
    offsets = torch.zeros(60, 2)
    plain = render(make_splats(), CAMERA, background()).joint.image
    assert torch.equal(render(make_splats(), CAMERA, background(), screen_offsets=offsets).joint.image, plain)
    offsets[:] = torch.tensor([2.0 / WIDTH, -4.0 / HEIGHT])  # one pixel to the right and two up
    shifted = render(make_splats(), CAMERA, background(), screen_offsets=offsets).joint.image
    assert error(shifted[:-2, 1:], plain[2:, :-1]) < 1e-5


def test_offsets_of_another_number_of_gaussians_are_refused():
    with pytest.raises(ValueError, match=r"screen_offsets must have shape \[N, 2\] with N = 60, got \[59, 2\]"):
        render(make_splats(), CAMERA, screen_offsets=torch.zeros(59, 2))


@pytest.mark.parametrize("depth", [True, False])
@pytest.mark.parametrize(
    "dynamic", ["some", "none"]
)  # with none, all blocks of the joint and the static image are equal
def test_absolute_gradients_of_the_offsets_are_the_sums_of_the_lengths_of_single_pixels(dynamic, depth):
    def render_with_offsets(absgrad):
        splats, offsets = make_splats(), torch.zeros(60, 2, requires_grad=True)
        if dynamic == "none":
            splats = dataclasses.replace(splats, is_dynamic=torch.zeros(60, dtype=torch.bool))
        settings = RenderSettings(branches=True, depth=depth, absgrad=absgrad)
        result = render(splats, CAMERA, background(), settings, offsets)
        values = [o if o.ndim == 2 else o.sum(-1) for o in outputs(result)]
        layers = (result.joint, result.static, result.dynamic)
        values += [layer.depth * layer.alpha.detach() for layer in layers if depth]
        images = torch.stack(values).unflatten(0, (-1, 3)).sum(0)  # joint, static, dynamic
        weights = torch.randn(3, HEIGHT, WIDTH, generator=generator())
        return (images * weights)[:, ::7, ::9].flatten(), offsets

    values, offsets = render_with_offsets(absgrad=False)
    expected = sum(torch.autograd.grad(value, offsets, retain_graph=True)[0].abs() for value in values)
    values, offsets = render_with_offsets(absgrad=True)
    values.sum().backward()
    assert expected.count_nonzero() > 60
    assert relative_error(offsets.grad, expected) < 1e-5


@pytest.mark.parametrize("antialias", [False, True])
def test_opacities_on_screen_are_those_that_are_composited(antialias):
    splats = make_splats()
    splats.means[::7, 2] = -5.0
    geometry = Geometry(*(getattr(splats, name).double() for name in GEOMETRY))
    view = View(CAMERA.viewmat.double(), CAMERA.K.double(), WIDTH, HEIGHT)
    *_, expected, visible = reference_projection.project(geometry, view, antialias=antialias)
    assert 20 < visible.sum() < 52
    found = opacities_on_screen(splats, CAMERA, RenderSettings(antialias=antialias))
    assert error(found, torch.where(visible, expected, 0.0)) < 1e-6


@pytest.mark.parametrize("max_intersections", [1, 100_000])
def test_the_number_of_intersections_can_be_bounded(max_intersections):
    expected = render(make_splats(), CAMERA)
    assert expected.num_intersections is None
    bounded = render(make_splats(), CAMERA, settings=RenderSettings(max_intersections=max_intersections))
    assert torch.equal(bounded.joint.image, expected.joint.image)
    assert 60 < int(bounded.num_intersections) < 60 * 12


def test_the_order_of_the_gaussians_does_not_matter():
    splats, order = as_leaves(make_splats()), torch.randperm(60)
    shuffled = as_leaves(select(splats, order))
    images = [render(s, CAMERA).joint.image for s in (splats, shuffled)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    for name, gradient in gradients(splats).items():
        assert relative_error(gradients(shuffled)[name], gradient[order]) < 1e-6


def test_the_same_input_gives_the_same_bits():
    splats = make_splats()
    first, second = (render(splats, CAMERA, background(), EVERYTHING) for _ in range(2))
    for a, b in zip(outputs(first), outputs(second), strict=True):
        assert torch.equal(a, b)
    assert torch.equal(first.weights, second.weights)


def test_culled_gaussians_leave_the_image_unchanged_and_get_zero_gradients():
    splats = make_splats()
    culled = torch.arange(60) % 3 == 0
    means = torch.where(culled[:, None], torch.tensor([0.0, 0.0, -5.0]), splats.means)
    some = as_leaves(dataclasses.replace(splats, means=means))
    image = render(some, CAMERA).joint.image
    image.sum().backward()
    assert torch.equal(image, render(select(splats, ~culled), CAMERA).joint.image)
    for gradient in gradients(some).values():
        assert not gradient[culled].any()
        assert gradient[~culled].any()


@pytest.mark.parametrize("settings", [RenderSettings(), EVERYTHING])
def test_an_empty_scene_is_background(settings):
    splats, behind = as_leaves(make_splats(0)), background().requires_grad_()
    result = render(splats, CAMERA, behind, settings)
    for layer in (result.joint, result.static, result.dynamic):
        if layer is not None:
            assert torch.equal(layer.image, behind.expand(HEIGHT, WIDTH, 3))
            assert not layer.alpha.any()
    sum(value.sum() for value in outputs(result)).backward()
    images = 3 if settings.branches else 1
    assert torch.equal(behind.grad, torch.full((3,), float(images * WIDTH * HEIGHT)))


def test_the_background_of_splats_is_that_of_their_renders():
    splats = make_splats()
    held = dataclasses.replace(splats, background=background())
    for settings in (RenderSettings(), EVERYTHING):
        expected = render(splats, CAMERA, background(), settings).joint.image
        assert torch.equal(render(held, CAMERA, settings=settings).joint.image, expected)
        other = torch.zeros(3)
        assert torch.equal(render(held, CAMERA, other, settings).joint.image, render(splats, CAMERA, other).joint.image)


def test_the_background_of_splats_is_that_of_three_channels_alone():
    splats = dataclasses.replace(make_splats(), background=background())
    weights = dataclasses.replace(splats, colors=torch.ones(60, 1), sh=None, sh_degree=None)
    rendering = render(weights, CAMERA)
    assert torch.allclose(rendering.joint.image[..., 0], rendering.joint.alpha)


@pytest.mark.parametrize("dynamic", [False, True])
def test_splats_of_one_branch_leave_the_other_image_background(dynamic):
    splats = dataclasses.replace(make_splats(), is_dynamic=torch.full((60,), dynamic))
    result = render(splats, CAMERA, background(), EVERYTHING)
    full, other = (result.dynamic, result.static) if dynamic else (result.static, result.dynamic)
    assert torch.equal(full.image, result.joint.image)
    assert torch.equal(other.image, background().expand(HEIGHT, WIDTH, 3))


def test_statistics_do_not_require_gradients():
    rendering = render(as_leaves(make_splats()), CAMERA, background(), EVERYTHING)
    assert rendering.joint.image.requires_grad
    assert not rendering.contributed.requires_grad
    assert not rendering.weights.requires_grad


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        *(("near", value, "positive and finite") for value in (0.0, -1.0, float("nan"), float("inf"))),
        *(("max_alpha", value, "") for value in (0.0, -1.0, 0.9999, 1.0, float("nan"))),  # would hide Gaussians
        *(("max_intersections", value, "between 1 and") for value in (0, -1, 1 << 30)),
    ],
)
def test_settings_out_of_their_range_are_refused_by_name(name, value, words):
    with pytest.raises(ValueError, match=f"{name} must be {words}"):
        RenderSettings(**{name: value})


def test_branches_require_is_dynamic():
    splats = dataclasses.replace(make_splats(), is_dynamic=None)
    with pytest.raises(ValueError, match="is_dynamic"):
        render(splats, CAMERA, settings=EVERYTHING)


def test_rendering_without_gradients_gives_the_same_image():
    splats = as_leaves(make_splats())
    with torch.no_grad():
        plain = render(splats, CAMERA).joint.image
    assert not plain.requires_grad
    assert torch.equal(plain, render(splats, CAMERA).joint.image)


def test_a_degree_of_harmonics_can_be_chosen():
    splats = dataclasses.replace(make_splats(), sh_degree=1)
    cut = dataclasses.replace(splats, sh=splats.sh[:, :4].contiguous(), sh_degree=None)
    assert torch.equal(render(splats, CAMERA).joint.image, render(cut, CAMERA).joint.image)
    assert set(float_tensors(splats)) == {*GEOMETRY, "sh"}
