"""Numbers in a few bits: what comes back is what was put in, to within half a step."""

import numpy as np
import pytest

from warpgs.export.packing import (
    from_planes,
    pack,
    pack_rotations,
    quantise,
    restore,
    to_planes,
    unpack,
    unpack_rotations,
)

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("bits", [1, 8, 11, 21, 32])
def test_a_number_comes_back_to_within_half_a_step(bits):
    values = RANDOM.uniform(-3, 5, 1000)
    error = np.abs(restore(quantise(values, (-3.0, 5.0), bits), (-3.0, 5.0), bits) - values)
    assert error.max() <= 4.0 / (2**bits - 1) * (1 + 1e-6)


def test_both_ends_come_back_exactly():
    ends = (-0.3, 0.7)
    assert restore(quantise(np.array(ends), ends, 8), ends, 8).tolist() == list(ends)


def test_what_is_outside_becomes_an_end():
    assert quantise(np.array([-9.0, 9.0]), (0.0, 1.0), 8).tolist() == [0, 255]


def test_a_range_of_no_length_comes_back_as_its_one_value():
    assert restore(quantise(np.full(3, 2.5), (2.5, 2.5), 8), (2.5, 2.5), 8).tolist() == [2.5] * 3


@pytest.mark.parametrize("widths", [(11, 10, 11), (8, 8, 8, 8), (2, 10, 10, 10), (32,)])
def test_fields_come_back_from_a_word(widths):
    fields = np.stack([RANDOM.integers(0, 2**w, 200, dtype=np.uint64) for w in widths], 1).astype(np.uint32)
    assert (unpack(pack(fields, widths), widths) == fields).all()


def test_the_first_field_is_highest():
    assert pack(np.array([[1, 0, 0]], np.uint32), (11, 10, 11)).tolist() == [1 << 21]


def turned_apart(a, b):
    """Angles [rad] between rotations."""
    return 2 * np.arccos(np.clip(np.abs((a.astype(np.float64) * b).sum(1)), 0, 1))


def test_rotations_come_back_to_less_than_a_third_of_a_degree():
    quats = RANDOM.normal(size=(5000, 4))
    quats = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)
    back = unpack_rotations(pack_rotations(quats))
    # Half a step is √2 / 2046 in each of three components, at most √12 times that in all four; angles are twice that.
    assert turned_apart(quats, back).max() < np.radians(0.28)
    assert np.linalg.norm(back, axis=1) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("axis", range(4))
@pytest.mark.parametrize("sign", [-1, 1])
def test_rotations_about_an_axis_come_back(axis, sign):
    quats = (sign * np.eye(4, dtype=np.float32))[axis : axis + 1]
    assert turned_apart(quats, unpack_rotations(pack_rotations(quats)))[0] < 3e-3


@pytest.mark.parametrize("dtype", ["u1", "<u4"])
@pytest.mark.parametrize("shape", [(1, 7, 4), (5, 7, 4), (3, 0, 4), (1, 1, 1)])
def test_planes_hold_the_frames_exactly(dtype, shape):
    frames = RANDOM.integers(0, 2**32, shape, dtype=np.uint64).astype(dtype)
    planes = to_planes(frames)
    assert planes.dtype == np.uint8
    assert (from_planes(planes, shape, np.dtype(dtype)) == frames).all()
