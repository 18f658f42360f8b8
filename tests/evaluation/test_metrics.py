"""PSNR, SSIM and flicker against analytic values or a slow reference."""

import math

import pytest
import torch

from tests.reference.ssim import ssim_map as reference_ssim
from warpgs.evaluation import metrics

H, W = 18, 23


@pytest.fixture
def pair():
    truth = torch.rand(H, W, 3)
    return (truth + 0.2 * torch.randn(H, W, 3)).clamp(0, 1), truth


@pytest.fixture
def region():
    region = torch.zeros(H, W, dtype=torch.bool)
    region[3:11, 5:20] = True
    return region


def gray(value):
    return torch.full((H, W, 3), value)


@pytest.mark.parametrize(("error", "decibels"), [(1.0, 0.0), (0.1, 20.0), (0.01, 40.0), (0.5, 6.0205999)])
def test_psnr_of_an_even_error_is_known(error, decibels):
    assert metrics.psnr(gray(error), gray(0.0)) == pytest.approx(decibels, abs=1e-4)


def test_psnr_averages_squares_over_pixels_and_channels_before_the_logarithm(pair):
    image, truth = pair
    errors = [(a - b) ** 2 for a, b in zip(image.flatten().tolist(), truth.flatten().tolist(), strict=True)]
    assert metrics.psnr(image, truth) == pytest.approx(-10 * math.log10(math.fsum(errors) / len(errors)), abs=1e-4)


def test_psnr_of_equal_images_is_infinite(pair):
    assert metrics.psnr(pair[1], pair[1]) == math.inf


def test_psnr_within_a_region_is_that_of_its_pixels_alone(pair, region):
    image, truth = pair
    mean = (image[3:11, 5:20] - truth[3:11, 5:20]).double().square().mean().item()
    assert metrics.psnr(image, truth, region) == pytest.approx(-10 * math.log10(mean), abs=1e-4)


def test_psnr_within_a_region_does_not_see_the_rest(pair, region):
    image, truth = pair
    spoilt = torch.where(region[..., None], image, torch.nan)
    assert metrics.psnr(spoilt, truth, region) == metrics.psnr(image, truth, region)


@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim, metrics.masked_ssim])
def test_an_empty_region_has_no_value(pair, metric):
    assert math.isnan(metric(*pair, torch.zeros(H, W, dtype=torch.bool)))


@pytest.mark.parametrize("metric", [metrics.psnr, metrics.ssim])
def test_the_region_of_all_pixels_is_the_whole_image(pair, metric):
    assert metric(*pair, torch.ones(H, W, dtype=torch.bool)) == pytest.approx(metric(*pair), rel=1e-6)


def test_ssim_is_the_mean_of_the_reference(pair):
    image, truth = (x.double() for x in pair)
    assert metrics.ssim(*pair) == pytest.approx(reference_ssim(image, truth).mean().item(), abs=1e-5)


def test_ssim_of_equal_images_is_one(pair):
    assert metrics.ssim(pair[1], pair[1]) == pytest.approx(1.0, abs=1e-6)


def test_ssim_within_a_region_is_the_mean_of_the_map_there(pair, region):
    image, truth = (x.double() for x in pair)
    expected = reference_ssim(image, truth)[3:11, 5:20].mean().item()
    assert metrics.ssim(*pair, region) == pytest.approx(expected, abs=1e-5)


def test_ssim_takes_images_that_are_not_contiguous(pair):
    turned = [x.transpose(0, 1) for x in pair]
    assert metrics.ssim(*turned) == pytest.approx(metrics.ssim(*pair), abs=1e-5)


def test_masked_ssim_is_that_of_images_that_are_black_outside(pair, region):
    image, truth = (torch.where(region[..., None], x, 0.0).double() for x in pair)
    expected = reference_ssim(image, truth)[3:11, 5:20].mean().item()
    assert metrics.masked_ssim(*pair, region) == pytest.approx(expected, abs=1e-5)


def test_masked_ssim_does_not_see_the_rest(pair, region):
    image, truth = pair
    other = torch.where(region[..., None], image, torch.rand(H, W, 3))
    assert metrics.masked_ssim(other, truth, region) == metrics.masked_ssim(image, truth, region)
    assert metrics.ssim(other, truth, region) != metrics.ssim(image, truth, region)


EVERYWHERE = torch.ones(H, W, dtype=torch.bool)


@pytest.mark.parametrize(("before", "after"), [(0.25, 0.75), (0.75, 0.25)])
def test_flicker_is_the_mean_absolute_change(before, after):
    assert metrics.flicker(gray(before), gray(after), EVERYWHERE) == pytest.approx(0.5)


def test_flicker_of_changes_up_and_down_does_not_cancel(region):
    after = gray(0.5)
    after[3, 5:20] += 0.25
    after[4, 5:20] -= 0.25
    assert metrics.flicker(gray(0.5), after, region) == pytest.approx(2 / 8 * 0.25)


def test_flicker_looks_at_the_region_alone(region):
    after = torch.where(region[..., None], gray(0.5), gray(0.9))
    assert metrics.flicker(gray(0.5), after, region) == 0.0


def test_flicker_of_an_empty_region_has_no_value():
    assert math.isnan(metrics.flicker(gray(0.1), gray(0.2), ~EVERYWHERE))


@pytest.mark.parametrize(
    ("true_after", "expected"),
    [(0.5, 0.3), (0.6, 0.2), (0.4, 0.2), (0.8, 0.0), (1.0, 0.0)],
    ids=["nothing changes", "less does", "less does, the other way", "as much does", "more does"],
)
def test_with_the_truth_only_what_goes_beyond_its_change_is_flicker(true_after, expected):
    value = metrics.flicker(gray(0.5), gray(0.8), EVERYWHERE, gray(0.5), gray(true_after))
    assert value == pytest.approx(expected, abs=1e-6)


def test_change_that_the_truth_has_elsewhere_excuses_no_flicker():
    """Beyond the truth's counts per pixel: one pixel's slack is not another's."""
    image, truth = gray(0.0), gray(0.0)
    image[0, 0], truth[5, 5] = 0.5, 0.5
    value = metrics.flicker(gray(0.0), image, EVERYWHERE, gray(0.0), truth)
    assert value == pytest.approx(0.5 / (H * W))
