"""Cosine coefficients in steps restore values over time."""

import numpy as np
import pytest

from warpgs.export.cosines import MAX_LEVEL, Levels

RANDOM = np.random.default_rng(0)


def series(keys):
    """[keys, 50, 2] smooth values."""
    times = np.linspace(0, 1, keys)[:, None, None]
    return np.sin(2 * times + RANDOM.uniform(0, 6, (1, 50, 2)))


def test_one_time_is_within_half_a_step():
    values, steps = series(1), np.array([0.1, 0.01])
    assert (np.abs(Levels.of(values, steps).values - values) <= steps / 2 * (1 + 1e-9)).all()


@pytest.mark.parametrize("keys", [2, 9, 30])
def test_the_error_over_time_is_that_of_the_steps(keys):
    values, steps = series(keys), np.array([0.1, 0.01])
    error = np.sqrt(np.square(Levels.of(values, steps).values - values).mean((0, 1)))
    assert (error < steps * 2 / 3).all()  # of a coefficient that is rounded to zero


def test_the_formula_is_that_of_the_player():
    values = series(7)
    levels = Levels.of(values, np.array([1e-6, 1e-6]))
    frequencies, times = np.arange(7)[:, None], np.arange(7)
    weights = np.sqrt(2 / 7) * np.cos(np.pi * (times + 0.5) * frequencies / 7)
    weights[0] = np.sqrt(1 / 7)
    assert np.allclose(np.tensordot(weights.T, levels.levels * 1e-6, 1), values, atol=1e-5)


def test_what_changes_smoothly_has_few_coefficients():
    assert (Levels.of(series(30), np.array([0.05, 0.05])).levels != 0).mean() < 0.3


@pytest.mark.parametrize("shape", [(1, 0, 3), (4, 0, 3), (1, 5, 0)])
def test_no_values_have_no_coefficients(shape):
    assert Levels.of(np.zeros(shape), np.ones(shape[2])).values.shape == shape


def test_huge_values_are_clipped_instead_of_wrapping_around():
    assert Levels.of(np.full((1, 1, 1), 1e30), np.ones(1)).levels.item() == MAX_LEVEL
