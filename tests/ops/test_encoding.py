"""Sinusoidal encoding (paper Eq. 6)."""

import math

import pytest
import torch

from tests.reference.encoding import encode as reference
from tests.scenes import error, generator
from warpgs.kernels.encoding import CUDA_LANES_LOG2, make_encode
from warpgs.ops.encoding import ALIGNMENT, ROW_ALIGNMENT, encode, encoded_size
from warpgs.runtime.launch import launch

TIME = torch.tensor([0.3])
BOX = (torch.zeros(3), torch.ones(3))
RAW = pytest.mark.parametrize("raw", [True, False])


def random_means(num):
    return 2.0 * torch.rand(num, 3, generator=generator()) - 1.0


def encode_unit_box(means, *bands, time=TIME, **options):
    return encode(means, time, bands, BOX, **options)


def waves(values, bands, raw=True):
    """Equation 6 in Python floats, with the frequencies of a value side by side."""
    angles = [2**k * math.pi * x for x in values for k in range(bands)]
    return [*(values if raw else []), *map(math.sin, angles), *map(math.cos, angles)]


@RAW
def test_the_encoding_equals_the_reference(raw):
    means, center, half_size = random_means(50), torch.tensor([0.1, 2.0, -1.0]), torch.tensor([1.0, 3.0, 0.5])
    positions = reference((means.double() - center) / half_size, 6, raw)
    times = reference(TIME.double()[:, None], 4, raw).expand(50, -1)
    encoded = encode(means, TIME, (6, 4), (center, half_size), raw=raw)[:, : encoded_size(6, 4, raw)]
    # p is rounded before the highest frequency multiplies its error by 32 π.
    assert error(encoded, torch.cat([positions, times], 1)) < 2e-5


@pytest.mark.parametrize("bands", [(1, 2), (4, 1), (10, 10)])
@RAW
def test_the_encoding_is_equation_6_for_position_and_time(bands, raw):
    means = random_means(6)
    encoded = encode_unit_box(means, *bands, raw=raw)
    for row in range(6):
        expected = waves(means[row].tolist(), bands[0], raw) + waves(TIME.tolist(), bands[1], raw)
        assert error(encoded[row, : len(expected)], torch.tensor(expected, dtype=torch.float64)) < 1e-6


def test_half_precision_is_rounded_single_precision():
    means = random_means(20)
    assert torch.equal(encode_unit_box(means, 4, 3, half=True)[:20], encode_unit_box(means, 4, 3).half())


@pytest.mark.parametrize("num", [1, 64, 65])
def test_in_half_precision_copies_of_the_last_row_follow(num):
    encoded = encode_unit_box(random_means(num), 4, 3, half=True)
    assert len(encoded) == math.ceil(num / ROW_ALIGNMENT) * ROW_ALIGNMENT
    assert (encoded[num:] == encoded[num - 1]).all()


@pytest.mark.parametrize("bands", [(10, 10), (3, 2), (0, 0), (1, 3)])
@RAW
def test_rows_are_padded_with_zeros_to_a_multiple_of_the_alignment(bands, raw):
    encoded = encode_unit_box(random_means(2), *bands, raw=raw)
    size = encoded_size(*bands, raw)
    assert encoded.shape == (2, math.ceil(size / ALIGNMENT) * ALIGNMENT)
    assert not encoded[:, size:].any()
    assert encoded[:, :size].any(0).all()


@pytest.mark.parametrize("half", [False, True])
def test_the_encoding_starts_at_the_offset(half):
    means = random_means(5)
    with_offset = encode_unit_box(means, 4, 2, offset=16, half=half)
    assert torch.equal(with_offset[:, 16:], encode_unit_box(means, 4, 2, half=half))


def run_kernel(like, means, raw, lanes_log2, half=False):
    encoding = torch.zeros_like(like)
    threads = len(like) * 4 << lanes_log2
    launch(make_encode(half), threads, means, TIME, *BOX, 10, 3, 8, int(raw), lanes_log2, encoding)
    return encoding[:, 8:]


@RAW
def test_several_threads_per_row_write_the_same_as_one(raw):
    means = random_means(5)
    like = torch.empty(5, 8 + encode_unit_box(means, 10, 3, raw=raw).shape[1])
    assert torch.equal(run_kernel(like, means, raw, CUDA_LANES_LOG2), run_kernel(like, means, raw, 0))


@RAW
@pytest.mark.parametrize("half", [False, True])
def test_the_kernel_of_cuda_equals_the_encoding_of_the_cpu(raw, half):
    means = random_means(5)
    encoding = encode_unit_box(means, 10, 3, offset=8, raw=raw, half=half)
    difference = error(run_kernel(encoding, means, raw, CUDA_LANES_LOG2, half), encoding[:, 8:])
    assert difference < (1e-3 if half else 2e-7)


def test_without_bands_the_encoding_is_the_values():
    means = random_means(5)
    assert torch.equal(encode_unit_box(means, 0, 0)[:, :4], torch.cat([means, TIME.expand(5, 1)], 1))


def test_the_encoding_of_no_values_is_empty():
    assert encode_unit_box(torch.zeros(0, 3), 4, 2).shape == (0, 32)


def test_each_value_is_encoded_independently():
    means = random_means(1)
    moved = means.clone()
    moved[0, 1] += 0.1
    changed = (encode_unit_box(means, 4, 2) != encode_unit_box(moved, 4, 2))[0]
    assert changed.nonzero()[:, 0].tolist() == [1, *range(7, 11), *range(19, 23)]
    changed = (encode_unit_box(means, 4, 2) != encode_unit_box(means, 4, 2, time=TIME + 0.1))[0]
    assert changed.nonzero()[:, 0].tolist() == [*range(27, 32)]


def test_the_encoding_has_no_gradient():
    assert not encode_unit_box(random_means(3).requires_grad_(), 2, 2).requires_grad


@pytest.mark.parametrize("means", [torch.zeros(4, 3, dtype=torch.float64), torch.zeros(3, 4).T])
def test_positions_of_a_wrong_type_or_layout_are_refused(means):
    with pytest.raises(ValueError, match="means must"):
        encode_unit_box(means, 2, 2)


def test_a_time_of_a_wrong_type_is_refused():
    with pytest.raises(ValueError, match="time must"):
        encode_unit_box(random_means(4), 2, 2, time=TIME.double())


@pytest.mark.parametrize("half", [False, True])
def test_each_row_may_have_its_own_time(half):
    means, times = random_means(5), torch.linspace(0.1, 0.9, 5)
    encoded = encode_unit_box(means, 3, 2, time=times, half=half)
    for k, row in enumerate(encoded[:5]):
        assert torch.equal(row, encode_unit_box(means, 3, 2, time=times[k : k + 1], half=half)[k])
    assert torch.equal(encoded[5:], encoded[4:5].expand(len(encoded) - 5, -1))


def test_another_number_of_times_than_of_positions_is_refused():
    with pytest.raises(ValueError, match="time must"):
        encode_unit_box(random_means(4), 2, 2, time=torch.zeros(3))
