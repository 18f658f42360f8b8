"""Structural similarity."""

import pytest
import torch
from skimage.metrics import structural_similarity

from tests.reference.ssim import ssim_map as reference
from tests.scenes import assert_same_gradients, error, generator, relative_error
from warpgs.kernels import ssim as kernels
from warpgs.kernels.ssim_cpu import MAX_CHANNELS
from warpgs.ops import ssim_cpu
from warpgs.ops.ssim import l1_and_ssim, ssim, ssim_map

SIZES = [(1, 1, 1), (37, 50, 3), (70, 9, 2), (130, 67, 3), (12, 13, MAX_CHANNELS + 1)]
"""Also larger than a thread's block, narrower than the window, and of more channels than the CPU's kernels take."""


def run_kernels(monkeypatch):
    """Lets the CPU run the kernels of CUDA."""
    monkeypatch.setattr(ssim_cpu, "has_kernel", lambda image: False)


@pytest.fixture(autouse=True, params=["cpu", "cuda"])
def implementation(request, monkeypatch):
    """Each test runs the kernels of the CPU and those of CUDA."""
    if request.param == "cuda":
        run_kernels(monkeypatch)


def images(size=(37, 50, 3)):
    g = generator()
    mask = torch.rand(size[:2], generator=g) > 0.3
    mask[0, 0] = True
    return torch.rand(size, generator=g), torch.rand(size, generator=g), mask


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("size", SIZES)
def test_map_and_gradient_equal_the_reference(size, masked):
    image, target, mask = images(size)
    mask = mask if masked else None
    double = image.double().requires_grad_()
    value, expected = ssim_map(image.requires_grad_(), target, mask), reference(double, target.double(), mask)
    assert error(value, expected) < 4e-6
    assert_same_gradients([value], [expected], [image], [double])


def test_the_strip_size_makes_no_difference(monkeypatch):
    run_kernels(monkeypatch)
    values = []
    for strip in (kernels.STRIP, kernels.SMALL_IMAGE_STRIP, 128):
        monkeypatch.setattr(kernels, "SMALL_IMAGE_STRIP", strip)
        image, target, mask = images((37, 21, 3))
        value = ssim_map(image.requires_grad_(), target, mask)
        value.square().sum().backward()
        values.append((value.detach(), image.grad))
    assert all(torch.equal(a, b) for other in values[1:] for a, b in zip(values[0], other, strict=True))


def test_interior_equals_scikit_image():
    image, target, _ = images()
    expected = structural_similarity(
        image.double().numpy(),
        target.double().numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
        full=True,
    )[1]
    inside = (slice(6, -6), slice(6, -6))
    assert error(ssim_map(image, target)[inside], torch.from_numpy(expected)[inside]) < 4e-6


def test_equal_images_have_similarity_one():
    image, _, mask = images()
    assert ssim(image, image).item() == pytest.approx(1, abs=1e-6)
    assert ssim(image, image, mask).item() == pytest.approx(1, abs=1e-6)


def test_pixels_outside_the_mask_have_no_effect_and_get_no_gradient():
    image, target, mask = images()
    changed = torch.where(mask[..., None], image, 0.123).requires_grad_()
    value = ssim(changed, target, mask)
    value.backward()
    assert torch.equal(value, ssim(image, target, mask))
    assert not changed.grad[~mask].any()
    assert changed.grad[mask].any()


def test_an_empty_mask_gives_similarity_one():
    image, target, mask = images()
    assert ssim(image, target, torch.zeros_like(mask)).item() == pytest.approx(1, abs=1e-6)


def test_the_target_gets_no_gradient():
    image, target, _ = (t.requires_grad_() if t.is_floating_point() else t for t in images())
    ssim(image, target).backward()
    assert image.grad is not None
    assert target.grad is None


def test_the_mean_of_the_map_is_the_similarity():
    image, target, _ = images()
    assert torch.equal(ssim(image, target), ssim_map(image, target).mean())


def l1_and_ssim_reference(image, target, weight, mask):
    similarity = reference(image, target, mask).mean()
    difference = image - target if mask is None else (image - target) * mask[..., None]
    return difference.abs().mean() + weight * (1.0 - similarity)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("weight", [0.0, 0.2, 3.0])
@pytest.mark.parametrize("size", SIZES)
def test_l1_and_similarity_in_one_pass_equal_the_reference(size, weight, masked):
    image, target, mask = images(size)
    mask = mask if masked else None
    double = image.double().requires_grad_()
    image.requires_grad_()
    value = l1_and_ssim(image, target, weight, mask)
    expected = l1_and_ssim_reference(double, target.double(), weight, mask)
    assert error(value, expected) < 1e-6
    (3.7 * value).backward()
    (3.7 * expected).backward()
    assert relative_error(image.grad, double.grad) < 1e-5


def test_equal_images_have_no_loss_and_no_gradient():
    image, _, mask = images()
    leaf = image.clone().requires_grad_()
    value = l1_and_ssim(leaf, image, 0.2, mask)
    value.backward()
    assert value.item() == pytest.approx(0, abs=1e-7)
    assert leaf.grad.abs().max() < 1e-7


@pytest.mark.parametrize("size", [(0, 5, 3), (5, 0, 3), (5, 5, 0)])
def test_the_map_of_an_image_without_pixels_is_empty(size):
    assert ssim_map(torch.zeros(size), torch.zeros(size)).shape == size


def test_values_outside_the_mask_may_be_nan():
    image, target, mask = images()
    expected = ssim(image, target, mask)
    image[~mask] = torch.nan
    image.requires_grad_()
    value = ssim(image, target, mask)
    value.backward()
    assert torch.equal(value, expected)
    assert image.grad.isfinite().all()


@pytest.mark.parametrize("compare", [ssim, lambda image, target: l1_and_ssim(image, target, 0.2)])
def test_an_image_without_pixels_is_refused(compare):
    empty = torch.zeros(0, 5, 3)
    with pytest.raises(ValueError, match="image must have pixels"):
        compare(empty, empty)
