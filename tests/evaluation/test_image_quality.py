"""PSNR, SSIM and flicker against analytic values or a slow reference."""

import math

import numpy as np
import pytest
import torch
from numpy.lib.stride_tricks import sliding_window_view

from tests.reference.ssim import ssim_map as reference_ssim
from tests.scenes import generator
from warpgs.evaluation import image_quality

H, W = 18, 23


@pytest.fixture
def pair():
    truth = torch.rand(H, W, 3)
    return (truth + 0.2 * torch.randn(H, W, 3)).clamp(0, 1), truth


EVERYWHERE = torch.ones(H, W, dtype=torch.bool)
BLOCK = ~EVERYWHERE
BLOCK[3:11, 5:20] = True


def gray(value):
    return torch.full((H, W, 3), value)


@pytest.mark.parametrize(("error", "decibels"), [(1.0, 0.0), (0.1, 20.0), (0.01, 40.0), (0.5, 6.0205999)])
def test_psnr_of_an_even_error_is_known(error, decibels):
    assert image_quality.psnr(gray(error), gray(0.0)) == pytest.approx(decibels, abs=1e-4)


def test_psnr_averages_squares_over_pixels_and_channels_before_the_logarithm(pair):
    image, truth = pair
    errors = [(a - b) ** 2 for a, b in zip(image.flatten().tolist(), truth.flatten().tolist(), strict=True)]
    assert image_quality.psnr(image, truth) == pytest.approx(
        -10 * math.log10(math.fsum(errors) / len(errors)), abs=1e-4
    )


def test_rounding_the_truth_to_8_bits_limits_psnr(pair):
    levels = (torch.arange(10_000) / 9_999).double()
    rounding = (levels - (255.0 * levels).round() / 255.0).square().mean()
    limit = -10.0 * math.log10(rounding)
    assert image_quality.psnr(pair[1], pair[1]) == pytest.approx(limit, abs=0.05)
    assert image_quality.psnr(gray(1e-5), gray(0.0)) == image_quality.psnr(pair[1], pair[1])
    assert image_quality.psnr(gray(2e-3), gray(0.0)) < image_quality.psnr(pair[1], pair[1]) - 1.0


def test_psnr_within_a_region_is_that_of_its_pixels_alone(pair):
    image, truth = pair
    mean = (image[3:11, 5:20] - truth[3:11, 5:20]).double().square().mean().item()
    assert image_quality.psnr(image, truth, BLOCK) == pytest.approx(-10 * math.log10(mean), abs=1e-4)


def test_psnr_within_a_region_does_not_see_the_rest(pair):
    image, truth = pair
    spoilt = torch.where(BLOCK[..., None], image, torch.nan)
    assert image_quality.psnr(spoilt, truth, BLOCK) == image_quality.psnr(image, truth, BLOCK)


@pytest.mark.parametrize("metric", [image_quality.psnr, image_quality.ssim, image_quality.masked_ssim])
def test_an_empty_region_has_no_value(pair, metric):
    assert math.isnan(metric(*pair, ~EVERYWHERE))


@pytest.mark.parametrize("metric", [image_quality.psnr, image_quality.ssim])
def test_the_region_of_all_pixels_is_the_whole_image(pair, metric):
    assert metric(*pair, EVERYWHERE) == pytest.approx(metric(*pair), rel=1e-6)


def test_ssim_is_the_mean_of_the_reference(pair):
    image, truth = (x.double() for x in pair)
    assert image_quality.ssim(*pair) == pytest.approx(reference_ssim(image, truth).mean().item(), abs=1e-5)


def test_ssim_of_equal_images_is_one(pair):
    assert image_quality.ssim(pair[1], pair[1]) == pytest.approx(1.0, abs=1e-6)


def test_ssim_within_a_region_is_the_mean_of_the_map_there(pair):
    image, truth = (x.double() for x in pair)
    expected = reference_ssim(image, truth)[3:11, 5:20].mean().item()
    assert image_quality.ssim(*pair, BLOCK) == pytest.approx(expected, abs=1e-5)


def test_ssim_takes_images_that_are_not_contiguous(pair):
    turned = [x.transpose(0, 1) for x in pair]
    assert image_quality.ssim(*turned) == pytest.approx(image_quality.ssim(*pair), abs=1e-5)


def gaussian_window():
    weights = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    return weights / weights.sum()


def partial_convolution(values, mask):
    """Along the first axis, one window after the other (Liu et al. 2018, section 3.1)."""
    length = len(values) - 10
    result, known = np.zeros((length, values.shape[1])), np.zeros((length, values.shape[1]))
    for i in range(length):
        for j in range(values.shape[1]):
            inside = mask[i : i + 11, j]
            if inside.sum() > 0:
                result[i, j] = (gaussian_window() * values[i : i + 11, j] * inside).sum() * 11 / inside.sum()
                known[i, j] = 1.0
    return result, known


def masked_mean(values, mask):
    along_rows, known = partial_convolution(values.T, mask.T)
    return partial_convolution(along_rows.T, known.T)[0]


def naive_masked_ssim(image, truth, region):
    """DyCheck's definition, with loops over windows in NumPy."""
    similarities = []
    mask = region.numpy().astype(float)
    for channel in range(3):
        a, b = (x[..., channel].double().numpy() for x in (image, truth))
        mean_a, mean_b = masked_mean(a, mask), masked_mean(b, mask)
        variance_a = np.maximum(0.0, masked_mean(a * a, mask) - mean_a**2)
        variance_b = np.maximum(0.0, masked_mean(b * b, mask) - mean_b**2)
        covariance = masked_mean(a * b, mask) - mean_a * mean_b
        covariance = np.sign(covariance) * np.minimum(np.sqrt(variance_a * variance_b), np.abs(covariance))
        above = (2 * mean_a * mean_b + 1e-4) * (2 * covariance + 9e-4)
        similarities.append(above / ((mean_a**2 + mean_b**2 + 1e-4) * (variance_a + variance_b + 9e-4)))
    return np.mean(similarities)


SCATTERED = torch.rand(H, W, generator=generator()) < 0.1


@pytest.mark.parametrize("region", [BLOCK, SCATTERED, EVERYWHERE], ids=["block", "scattered", "everywhere"])
def test_masked_ssim_is_that_of_dycheck(pair, region):
    assert image_quality.masked_ssim(*pair, region) == pytest.approx(naive_masked_ssim(*pair, region), abs=1e-9)


def test_windows_without_any_pixel_of_the_region_count_as_one_in_masked_ssim(pair):
    """So a small region scores high: DyCheck takes the mean over all windows."""
    corner = torch.zeros(H, W, dtype=torch.bool)
    corner[:2, :2] = True
    assert 0.9 < image_quality.masked_ssim(*pair, corner) < 1.0


def test_masked_ssim_of_equal_images_is_one(pair):
    assert image_quality.masked_ssim(pair[1], pair[1], BLOCK) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("size", [(10, 23), (18, 10)])
def test_masked_ssim_of_images_smaller_than_its_window_has_no_value(size):
    image = torch.rand(*size, 3)
    assert math.isnan(image_quality.masked_ssim(image, image, torch.ones(size, dtype=torch.bool)))


def windowed_mean(values):
    window = np.outer(gaussian_window(), gaussian_window())
    return np.einsum("ijckl,kl->ijc", sliding_window_view(values, (11, 11), (0, 1)), window)


def naive_ms_ssim(image, truth):
    """Wang et al. 2003 as in TensorFlow, in NumPy with two-dimensional windows."""
    result = np.ones(3)
    a, b = (x.double().numpy() for x in (image, truth))
    for weight in (0.0448, 0.2856, 0.3001, 0.2363, 0.1333):
        mean_a, mean_b = windowed_mean(a), windowed_mean(b)
        covariance = windowed_mean(a * b) - mean_a * mean_b
        variances = windowed_mean(a * a) - mean_a**2 + windowed_mean(b * b) - mean_b**2
        contrast = (2 * covariance + 9e-4) / (variances + 9e-4)
        luminance = (2 * mean_a * mean_b + 1e-4) / (mean_a**2 + mean_b**2 + 1e-4)
        factor = (contrast * luminance if weight == 0.1333 else contrast).mean((0, 1))
        result = result * np.maximum(factor, 0.0) ** weight
        a, b = (np.pad(x, ((0, x.shape[0] % 2), (0, x.shape[1] % 2), (0, 0)), "symmetric") for x in (a, b))
        a, b = (0.25 * (x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]) for x in (a, b))
    return result.mean()


@pytest.mark.parametrize("size", [(161, 163), (165, 176)])
def test_multi_scale_ssim_is_that_of_the_reference(size):
    truth = torch.rand(*size, 3)
    image = (truth + 0.2 * torch.randn(*size, 3)).clamp(0, 1)
    assert image_quality.ms_ssim(image, truth) == pytest.approx(naive_ms_ssim(image, truth), abs=1e-9)
    assert image_quality.ms_ssim(truth, truth) == pytest.approx(1.0, abs=1e-12)


def test_multi_scale_ssim_of_opposite_images_is_a_number():
    """Their covariance is negative, and a negative number has no real fractional power."""
    image = torch.rand(161, 161, 3)
    assert image_quality.ms_ssim(image, 1.0 - image) == 0.0


@pytest.mark.parametrize("size", [(160, 200), (200, 160)])
def test_multi_scale_ssim_of_small_images_has_no_value(size):
    image = torch.rand(*size, 3)
    assert math.isnan(image_quality.ms_ssim(image, image))


def test_masked_ssim_does_not_see_the_rest(pair):
    image, truth = pair
    other = torch.where(BLOCK[..., None], image, torch.rand(H, W, 3))
    assert image_quality.masked_ssim(other, truth, BLOCK) == image_quality.masked_ssim(image, truth, BLOCK)
    assert image_quality.ssim(other, truth, BLOCK) != image_quality.ssim(image, truth, BLOCK)


@pytest.mark.parametrize(("before", "after"), [(0.25, 0.75), (0.75, 0.25)])
def test_flicker_is_the_mean_absolute_change(before, after):
    assert image_quality.flicker(gray(before), gray(after), EVERYWHERE) == pytest.approx(0.5)


def test_flicker_of_changes_up_and_down_does_not_cancel():
    after = gray(0.5)
    after[3, 5:20] += 0.25
    after[4, 5:20] -= 0.25
    assert image_quality.flicker(gray(0.5), after, BLOCK) == pytest.approx(2 / 8 * 0.25)


def test_flicker_looks_at_the_region_alone():
    after = torch.where(BLOCK[..., None], gray(0.5), gray(0.9))
    assert image_quality.flicker(gray(0.5), after, BLOCK) == 0.0


def test_flicker_of_an_empty_region_has_no_value():
    assert math.isnan(image_quality.flicker(gray(0.1), gray(0.2), ~EVERYWHERE))
