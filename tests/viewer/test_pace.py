"""Few pixels while something moves, all of them at rest; and time that plays."""

import pytest

from warpgs.viewer.clock import CLIP_SECONDS, Clock
from warpgs.viewer.pace import SCALES, Pace

WHOLE = 1_000_000


def learned(fixed, per_million, sizes=(1.0, 0.5, 0.25)):
    pace = Pace(moving_seconds=0.1)
    for scale in (*sizes, *sizes):
        pixels = round(WHOLE * scale**2)
        pace.took(pixels, fixed + per_million * pixels * 1e-6)
    return pace


def test_a_cost_is_learned_as_a_fixed_part_and_one_for_each_pixel():
    assert learned(0.02, 0.8).cost() == pytest.approx((0.02, 0.8))


def test_nothing_is_held_back_before_anything_was_measured():
    assert Pace().while_moving(WHOLE) == 1.0


def test_a_fast_machine_draws_all_pixels_while_moving():
    assert learned(0.001, 0.01).while_moving(WHOLE) == 1.0


def test_a_slow_machine_draws_no_more_pixels_than_the_time_allows():
    scale = learned(0.0, 0.8).while_moving(WHOLE)
    assert scale in SCALES
    assert 0.8 * scale**2 <= 0.1 < 0.8 * (scale * 2**0.5) ** 2


def test_pixels_are_not_given_up_where_they_cost_nothing():
    assert learned(0.5, 0.1).while_moving(WHOLE) == 1.0


def test_there_is_a_smallest_scale():
    assert learned(0.0, 1e3).while_moving(WHOLE) == SCALES[-1]


def test_images_of_one_size_are_taken_as_costing_by_the_pixel():
    assert learned(0.0, 0.8, sizes=(0.5,)).cost() == pytest.approx((0.0, 0.8))


def test_what_was_long_ago_is_forgotten():
    pace = learned(0.0, 5.0)
    for _ in range(40):
        pace.took(WHOLE, 0.01)
    assert pace.while_moving(WHOLE) == 1.0


@pytest.mark.parametrize("scale", SCALES)
def test_a_picture_at_rest_is_whole_after_a_few_steps(scale):
    steps = 0
    while scale < 1:
        scale, steps = Pace.refined(scale), steps + 1
    assert scale == 1
    assert steps <= 3


def test_time_stands_still_unless_it_plays():
    clock = Clock()
    assert [clock.advance(0.3, 1.0, now) for now in (0.0, 1.0, 9.0)] == [0.3, 0.3, 0.3]


def test_time_runs_by_the_clock_and_the_speed():
    clock = Clock()
    clock.toggle()
    moment = clock.advance(0.0, 2.0, 100.0)
    assert clock.advance(moment, 2.0, 101.0) == pytest.approx(2.0 / CLIP_SECONDS)


def test_time_begins_anew_after_the_last_moment():
    clock = Clock()
    clock.toggle()
    clock.advance(0.9, 1.0, 0.0)
    assert clock.advance(0.9, 1.0, 1.0) == pytest.approx(0.9 + 1 / CLIP_SECONDS - 1)


def test_a_pause_does_not_make_time_jump():
    clock = Clock()
    clock.toggle()
    clock.advance(0.2, 1.0, 0.0)
    clock.toggle()
    clock.advance(0.2, 1.0, 50.0)
    clock.toggle()
    assert clock.advance(0.2, 1.0, 60.0) == 0.2
