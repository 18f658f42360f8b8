"""Low resolution while something changes, full resolution at rest."""

import pytest

from warpgs.viewer.adaptive_resolution import SCALES, AdaptiveResolution

PIXELS = 1_000_000


def measured(fixed, per_million, sizes=(1.0, 0.5, 0.25)):
    resolution = AdaptiveResolution(target_seconds=0.1)
    for scale in (*sizes, *sizes):
        pixels = round(PIXELS * scale**2)
        resolution.add(pixels, fixed + per_million * pixels * 1e-6)
    return resolution


def test_the_fixed_cost_and_the_cost_per_pixel_are_estimated():
    assert measured(0.02, 0.8).cost() == pytest.approx((0.02, 0.8))


def test_the_resolution_is_full_before_the_first_measurement():
    assert AdaptiveResolution().interactive_scale(PIXELS) == 1.0


@pytest.mark.parametrize(
    ("fixed", "per_million", "scale"), [(0.001, 0.01, 1.0), (0.5, 0.1, 1.0), (0.0, 1e3, SCALES[-1])]
)
def test_fast_machines_and_cheap_pixels_are_at_full_resolution_and_it_has_a_minimum(fixed, per_million, scale):
    assert measured(fixed, per_million).interactive_scale(PIXELS) == scale


def test_a_slow_machine_renders_the_highest_resolution_within_the_target_time():
    scale = measured(0.0, 0.8).interactive_scale(PIXELS)
    assert scale in SCALES
    assert 0.8 * scale**2 <= 0.1 < 0.8 * (scale * 2**0.5) ** 2


def test_with_images_of_one_size_the_cost_is_all_per_pixel():
    assert measured(0.0, 0.8, sizes=(0.5,)).cost() == pytest.approx((0.0, 0.8))


def test_old_measurements_lose_their_weight():
    resolution = measured(0.0, 5.0)
    for _ in range(40):
        resolution.add(PIXELS, 0.01)
    assert resolution.interactive_scale(PIXELS) == 1.0


@pytest.mark.parametrize("scale", SCALES)
def test_an_image_at_rest_is_refined_to_full_resolution_in_a_few_steps(scale):
    steps = 0
    while scale < 1:
        scale, steps = AdaptiveResolution.refined(scale), steps + 1
    assert scale == 1
    assert steps <= 3
