"""Invalid input is refused by name, or the image and all gradients stay finite."""

import dataclasses

import pytest
import torch

from tests.scenes import GEOMETRY, as_leaves, float_tensors, gradients, make_camera, make_splats, select
from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats
from warpgs.ops.ssim import ssim
from warpgs.rendering import render

pytestmark = pytest.mark.usefixtures("contracts_off")
CAMERA = make_camera()
TENSORS = [*GEOMETRY, "sh"]
ODD = torch.arange(60) % 4 == 1
"""The Gaussians that get the odd values."""


def changed(name, value) -> Splats:
    return dataclasses.replace(make_splats(), **{name: value})


def odd(splats: Splats | None = None, **values) -> Splats:
    """The random scene, or a given one, with odd values in every fourth Gaussian."""
    splats = splats or make_splats()
    for name, value in values.items():
        tensor = getattr(splats, name).clone()
        tensor[ODD] = torch.as_tensor(value, dtype=tensor.dtype)
        splats = dataclasses.replace(splats, **{name: tensor})
    return splats


def render_image(splats: Splats, camera: Camera = CAMERA, offsets: torch.Tensor | None = None) -> torch.Tensor:
    """The image, after checking that it and all gradients are finite."""
    splats = as_leaves(splats)
    image = render(splats, camera, torch.full((3,), 0.2), screen_offsets=offsets).joint.image
    image.square().sum().backward()
    assert image.isfinite().all()
    for name, gradient in gradients(splats).items():
        assert gradient.isfinite().all(), name
    return image.detach()


@pytest.mark.parametrize("name", TENSORS)
def test_a_wrong_number_of_gaussians_is_refused_by_name(name):
    with pytest.raises(ValueError, match=r"N = \d+"):
        changed(name, getattr(make_splats(59), name))


@pytest.mark.parametrize("name", TENSORS)
@pytest.mark.parametrize(
    "spoil",
    [
        lambda t: t[..., None],
        lambda t: t.sum(),
        lambda t: t.double(),
        lambda t: t.half(),
        lambda t: t.int(),
        lambda t: t.repeat_interleave(2, dim=0)[::2],
        lambda t: t.tolist(),
        lambda t: t.numpy(),
    ],
    ids=["extra axis", "scalar", "double", "half", "int", "not contiguous", "list", "array"],
)
def test_a_tensor_that_does_not_fit_is_refused_by_name(name, spoil):
    with pytest.raises(ValueError, match=f"^{name} must"):
        changed(name, spoil(getattr(make_splats(), name)))


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        *((name, torch.ones(60, 5), f"{name} must have shape") for name in ("means", "quats", "scales")),
        *(("sh", torch.ones(60, bases, 3), "sh must have shape") for bases in (0, 2, 15, 25)),
        *(("sh_degree", degree, "sh_degree") for degree in (-1, 4, 1.5)),
        ("colors", torch.ones(60, 3), "exactly one of colors and sh"),
        ("sh", None, "exactly one of colors and sh"),
        ("is_dynamic", torch.ones(60), "is_dynamic must"),
        ("quats", torch.ones(60, 4, device="meta"), "quats on meta"),
    ],
)
def test_a_field_that_does_not_fit_the_others_is_refused_by_name(name, value, words):
    with pytest.raises(ValueError, match=words):
        changed(name, value)


def test_colours_without_channels_are_refused():
    with pytest.raises(ValueError, match="colors must have at least one channel"):
        make_splats(channels=0)


def test_splats_on_another_kind_of_device_are_refused():
    with pytest.raises(ValueError, match="must be on a CPU or CUDA device"):
        make_splats().to("meta")


@pytest.mark.parametrize(
    ("branches", "background"),
    [
        *((False, torch.zeros(shape)) for shape in ((4,), (1, 3), (3, 3))),
        *((False, value) for value in (torch.zeros(3).double(), 0.5)),
        *((True, torch.zeros(shape)) for shape in ((1, 3), (3, 4), (3, 3, 1))),
    ],
)
def test_a_background_that_does_not_fit_the_images_is_refused(branches, background):
    with pytest.raises(ValueError, match="background must"):
        render(make_splats(), CAMERA, background, RenderSettings(branches=branches))


@pytest.mark.parametrize(("name", "shape"), [("viewmat", (3, 4)), ("K", (4, 4))])
def test_a_camera_matrix_that_does_not_fit_is_refused(name, shape):
    with pytest.raises(ValueError, match=f"{name} must"):
        dataclasses.replace(CAMERA, **{name: torch.ones(shape)})


@pytest.mark.parametrize("camera", [[CAMERA], (CAMERA, CAMERA), None, CAMERA.viewmat], ids=str)
def test_anything_but_one_camera_is_refused(camera):
    with pytest.raises(TypeError, match=f"^camera must be one Camera, got {type(camera).__name__}: call render once"):
        render(make_splats(), camera)


@pytest.mark.parametrize("name", ["width", "height"])
@pytest.mark.parametrize("value", [-1, 32769, 12.0, True, None])
def test_an_invalid_image_size_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name} must be"):
        dataclasses.replace(CAMERA, **{name: value})


def test_images_of_two_sizes_are_not_compared():
    with pytest.raises(ValueError, match="target must have shape"):
        ssim(torch.ones(5, 6, 3), torch.ones(6, 5, 3))
    with pytest.raises(ValueError, match="mask must be"):
        ssim(torch.ones(5, 6, 3), torch.ones(5, 6, 3), torch.ones(5, 6))


@pytest.mark.parametrize("size", [(0, 0), (0, 7), (7, 0), (1, 1)])
def test_images_with_zero_or_one_pixel_can_be_rendered(size):
    assert render_image(make_splats(), make_camera(*size)).shape == (size[1], size[0], 3)


@pytest.mark.parametrize("num", [0, 1])
def test_zero_or_one_gaussian_can_be_rendered(num):
    render_image(make_splats(num))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("entry", ["one", "all"])
@pytest.mark.parametrize("name", TENSORS)
def test_a_gaussian_that_is_not_finite_leaves_the_image_unchanged(name, entry, value):
    splats = make_splats()
    tensor = getattr(splats, name).clone()
    (tensor if entry == "all" else tensor.view(60, -1)[:, 0])[ODD] = value
    image = render_image(dataclasses.replace(splats, **{name: tensor}))
    assert torch.equal(image, render_image(select(splats, ~ODD)))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_an_offset_on_screen_that_is_not_finite_leaves_the_image_unchanged(value):
    splats, offsets = make_splats(), torch.zeros(60, 2)
    offsets[ODD, 1] = value
    assert torch.equal(render_image(splats, offsets=offsets), render_image(select(splats, ~ODD)))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("channel", [0, 2])
def test_a_colour_that_is_not_finite_leaves_the_image_unchanged(channel, value):
    splats = make_splats(channels=3)
    expected = render_image(select(splats, ~ODD))
    splats.colors[ODD, channel] = value
    assert torch.equal(render_image(splats), expected)


@pytest.mark.parametrize(
    "values",
    [
        {"quats": 0.0},
        {"means": [0.0, 0.0, -5.0]},
        {"means": CAMERA.position.tolist()},
        {"opacities": 0.0},
        {"opacities": -0.5},
        {"opacities": 1.5},
        {"opacities": 1e30},
        {"means": 1e30},
        {"scales": 1e30},
        {"scales": 1e12},
    ],
    ids=str,
)
def test_an_invalid_gaussian_leaves_the_image_unchanged(values):
    assert torch.equal(render_image(odd(**values)), render_image(select(make_splats(), ~ODD)))


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(
    "values",
    [
        {"colors": float("nan")},
        {"colors": [0.1, float("inf"), 0.2]},
        {"colors": 3e38},
        {"opacities": 1.5},
        {"opacities": 1.0001, "scales": 0.02},
        {"means": float("nan")},
    ],
    ids=str,
)
def test_radii_of_gaussians_that_are_skipped_are_zero(values, antialias):
    settings = RenderSettings(antialias=antialias, statistics=True)
    splats = odd(make_splats(channels=3), **values)
    radii = render(splats, CAMERA, settings=settings).radii
    expected = render(select(splats, ~ODD), CAMERA, settings=settings)
    assert not radii[ODD].any()
    assert torch.equal(radii[~ODD], expected.radii)


@pytest.mark.parametrize("settings", [RenderSettings(), RenderSettings(absgrad=True, branches=True, depth=True)])
def test_gradients_are_finite_at_very_large_colours(settings):
    splats, offsets = as_leaves(odd(make_splats(channels=3), colors=1e19)), torch.zeros(60, 2, requires_grad=True)
    render(splats, CAMERA, settings=settings, screen_offsets=offsets).joint.image.sum().backward()
    for gradient in (gradients(splats)["means"], offsets.grad):
        assert gradient.isfinite().all()
        assert gradient.abs().max() > 1e19


@pytest.mark.parametrize(
    "values",
    [
        {"scales": 0.0},
        {"scales": 1e-30},
        {"scales": [0.0, 0.1, 0.1]},
        {"scales": -0.1},
        {"scales": [1e-8, 1e-8, 1e3]},
        {"scales": [1e-8, 1e3, 1e3]},
        {"scales": [1e3, 1e-8, 0.1]},
        {"scales": 1e4},
        {"opacities": 1.0},
        {"quats": 1e-15},
        {"quats": 1e15},
        {"sh": 1e6},
        {"scales": 1e4, "opacities": 1.0},
    ],
    ids=str,
)
@pytest.mark.parametrize("antialias", [False, True])
def test_extreme_gaussians_leave_image_and_gradients_finite(values, antialias):
    splats = as_leaves(odd(**values))
    image = render(splats, CAMERA, settings=RenderSettings(antialias=antialias)).joint.image
    image.sum().backward()
    assert image.isfinite().all()
    for name, gradient in gradients(splats).items():
        assert gradient.isfinite().all(), name
    assert gradients(splats)["means"][~ODD].any()


def test_gaussians_that_cover_the_image_show_their_colour_everywhere():
    splats = make_splats(1, channels=3)
    splats = dataclasses.replace(splats, scales=torch.full((1, 3), 1e4), opacities=torch.ones(1))
    image = render(splats, CAMERA).joint.image
    assert (image - 0.999 * splats.colors).abs().max() < 1e-4
    assert set(float_tensors(splats)) == {*GEOMETRY, "colors"}


@pytest.mark.parametrize("name", ["viewmat", "K"])
def test_a_camera_that_is_not_finite_renders_the_background(name):
    camera = dataclasses.replace(CAMERA, **{name: torch.full_like(getattr(CAMERA, name), float("nan"))})
    assert torch.equal(render_image(make_splats(), camera), torch.full((37, 50, 3), 0.2))
