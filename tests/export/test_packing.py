"""Quantisation and bit packing: values are restored to within half a step."""

import numpy as np
import pytest

from tests.export.pages import from_planes
from warpgs.formats import packing

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("bits", [1, 8, 11, 21, 32])
def test_quantisation_is_within_half_a_step(bits):
    values = RANDOM.uniform(-3, 5, 1000)
    error = np.abs(packing.dequantise(packing.quantise(values, (-3.0, 5.0), bits), (-3.0, 5.0), bits) - values)
    assert error.max() <= 4.0 / (2**bits - 1) * (1 + 1e-6)


def test_both_bounds_are_restored_exactly():
    bounds = (-0.3, 0.7)
    assert packing.dequantise(packing.quantise(np.array(bounds), bounds, 8), bounds, 8).tolist() == list(bounds)


def test_values_out_of_bounds_are_clipped():
    assert packing.quantise(np.array([-9.0, 9.0]), (0.0, 1.0), 8).tolist() == [0, 255]


def test_an_empty_range_is_restored_as_its_one_value():
    assert packing.dequantise(packing.quantise(np.full(3, 2.5), (2.5, 2.5), 8), (2.5, 2.5), 8).tolist() == [2.5] * 3


@pytest.mark.parametrize("widths", [(11, 10, 11), (8, 8, 8, 8), (2, 10, 10, 10), (32,)])
def test_unpacked_fields_are_those_that_were_packed(widths):
    fields = np.stack([RANDOM.integers(0, 2**w, 200, dtype=np.uint64) for w in widths], 1).astype(np.uint32)
    assert (packing.unpack(packing.pack(fields, widths), widths) == fields).all()


def test_the_first_field_is_in_the_highest_bits():
    assert packing.pack(np.array([[1, 0, 0]], np.uint32), (11, 10, 11)).tolist() == [1 << 21]


def angles_between(a, b):
    """Angles [rad] between rotations."""
    return 2 * np.arccos(np.clip(np.abs((a.astype(np.float64) * b).sum(1)), 0, 1))


def test_rotations_are_restored_to_within_a_third_of_a_degree():
    quats = RANDOM.normal(size=(5000, 4))
    quats = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
    back = packing.unpack_rotations(packing.pack_rotations(quats))
    # Half a step is √2 / 2046 in each of three components, at most √12 times that in all four; angles are twice that.
    assert angles_between(quats, back).max() < np.radians(0.28)
    assert np.linalg.norm(back, axis=1) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("sign", [-1, 1])
def test_rotations_about_an_axis_are_restored(axis, sign):
    quats = (sign * np.eye(4, dtype=np.float32))[axis : axis + 1]
    assert angles_between(quats, packing.unpack_rotations(packing.pack_rotations(quats)))[0] < 3e-3


@pytest.mark.parametrize("largest", [0, 100, 30_000, 2**31 - 1])
@pytest.mark.parametrize("shape", [(1, 7, 4), (5, 7, 4), (3, 0, 4), (1, 1, 1)])
def test_planes_are_lossless(largest, shape):
    levels = RANDOM.integers(-largest, largest, shape, dtype=np.int32, endpoint=True)
    planes = packing.to_planes(levels)
    assert planes.dtype == np.uint8
    assert (from_planes(planes, shape) == levels).all()


def test_small_integers_take_one_byte():
    assert len(packing.to_planes(np.full((2, 3, 4), -128, np.int32))) == 24
    assert len(packing.to_planes(np.full((2, 3, 4), 128, np.int32))) == 48
