"""Coefficients in steps restore series of values."""

import numpy as np
import pytest

from warpgs.export.transform import BASIS_UNIT, MAX_LEVEL, Levels, principal_basis

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
    assert (error < steps * 0.35).all()  # a step / √12, if all coefficients differ from zero


def test_octaves_are_exponents_of_steps():
    values, octaves = series(9), RANDOM.integers(-3, 4, 50, dtype=np.int32)
    error = np.abs(Levels.of(values, np.array([0.1, 0.1]), octaves).values - values).max((0, 2))
    assert (error < 0.05 * 3 * 2.0**octaves * 1.001).all()  # 3 = √9 coefficients that are all wrong by half a step
    assert error[octaves == 3].mean() > 10 * error[octaves == -3].mean()


@pytest.mark.parametrize("over_time", [True, False])
@pytest.mark.parametrize("keys", [1, 2, 9, 30])
def test_the_basis_is_orthonormal(keys, over_time):
    basis = principal_basis(series(keys) * 100, over_time) * BASIS_UNIT
    assert np.allclose(basis @ basis.T, np.eye(keys), atol=3e-4)


def test_the_first_vector_over_time_is_constant():
    basis = principal_basis(series(9) * 100, over_time=True)
    assert (basis[0] == basis[0, 0]).all()
    assert np.allclose(np.abs(basis[0]) * BASIS_UNIT, 1 / 3, atol=1e-4)


def test_vectors_without_coefficients_are_zeros():
    levels = Levels.of(np.full((9, 50, 2), 3.0), np.array([0.1, 0.1]))
    assert (levels.basis[1:] == 0).all()
    assert np.allclose(levels.values, 3.0, atol=0.05)


def test_a_large_constant_is_restored_in_spite_of_the_rounded_basis():
    values = series(30) + 1e5
    assert np.abs(Levels.of(values, np.array([0.1, 0.1])).values - values).max() < 0.3


def test_a_value_of_absurd_size_hardly_changes_the_basis():
    values = RANDOM.normal(size=(6, 2000, 3)) * np.array([9, 7, 5, 3, 2, 1])[:, None, None]
    usual = principal_basis(values, over_time=False)
    values[:, 7] *= 1e20
    assert np.abs(np.abs(principal_basis(values, over_time=False)) - np.abs(usual)).max() * BASIS_UNIT < 0.3


def test_what_changes_together_has_few_coefficients():
    levels = Levels.of(series(30), np.array([0.05, 0.05])).levels  # sums of one sine and one cosine
    assert (levels[3:] != 0).mean() < 0.01
    assert (levels[:3] != 0).mean() > 0.8


@pytest.mark.parametrize("shape", [(1, 0, 3), (4, 0, 3), (1, 5, 0), (0, 5, 3)])
def test_no_values_have_no_coefficients(shape):
    assert Levels.of(np.zeros(shape), np.ones(shape[2]), over_time=shape[0] > 0).values.shape == shape


def test_huge_values_are_clipped_instead_of_wrapping_around():
    assert Levels.of(np.full((1, 1, 1), 1e30), np.ones(1)).levels.item() == MAX_LEVEL
