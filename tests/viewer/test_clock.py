"""Playback of the scene's time."""

import pytest

from warpgs.viewer.clock import CLIP_SECONDS, Clock


def test_time_is_constant_while_paused():
    clock = Clock()
    assert [clock.advance(0.3, 1.0, now) for now in (0.0, 1.0, 9.0)] == [0.3, 0.3, 0.3]


def test_time_advances_with_the_clock_and_the_speed():
    clock = Clock()
    clock.toggle()
    time = clock.advance(0.0, 2.0, 100.0)
    assert clock.advance(time, 2.0, 101.0) == pytest.approx(2.0 / CLIP_SECONDS)


def test_time_wraps_around_at_the_end():
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
