"""Sinusoidal encoding (paper Eq. 6)."""

import math

import pytest
import torch

from tests.reference.encoding import encode as reference
from tests.scenes import error, generator
from warpgs.kernels.encoding import CUDA_LANES_LOG2, make_encode
from warpgs.ops.encoding import ALIGNMENT, encode, encoded_size
from warpgs.runtime.tape import Run

TIME = torch.tensor([0.3])
BOX = (torch.zeros(3), torch.ones(3))


def random_means(num):
    return 2.0 * torch.rand(num, 3, generator=generator()) - 1.0


def encode_plainly(means, *bands, time=TIME, **options):
    return encode(means, time, bands, *BOX, **options)


def waves(values, bands):
    """Equation 6 in Python's own floats, each value's frequencies together."""
    angles = [2**k * math.pi * x for x in values for k in range(bands)]
    return [*values, *map(math.sin, angles), *map(math.cos, angles)]


def test_the_encoding_is_that_of_the_reference():
    means, center, half_size = random_means(50), torch.tensor([0.1, 2.0, -1.0]), torch.tensor([1.0, 3.0, 0.5])
    positions = reference((means.double() - center) / half_size, 6)
    moments = reference(TIME.double()[:, None], 4).expand(50, -1)
    encoded = encode(means, TIME, (6, 4), center, half_size)[:, : encoded_size(6, 4)]
    # p is rounded before the highest frequency multiplies its error by 32 π.
    assert error(encoded, torch.cat([positions, moments], 1)) < 2e-5


@pytest.mark.parametrize("bands", [(1, 2), (4, 1), (10, 10)])
def test_the_encoding_holds_equation_6_of_position_and_of_time(bands):
    means = random_means(6)
    encoded = encode_plainly(means, *bands)
    for row in range(6):
        expected = waves(means[row].tolist(), bands[0]) + waves(TIME.tolist(), bands[1])
        assert error(encoded[row, : len(expected)], torch.tensor(expected, dtype=torch.float64)) < 1e-6


def test_half_precision_is_single_precision_rounded():
    means = random_means(20)
    assert torch.equal(encode_plainly(means, 4, 3, half=True), encode_plainly(means, 4, 3).half())


@pytest.mark.parametrize("bands", [(10, 10), (3, 2), (0, 0), (1, 3)])
def test_rows_are_padded_with_zeros_to_whole_pieces_of_memory(bands):
    encoded = encode_plainly(random_means(2), *bands)
    size = encoded_size(*bands)
    assert encoded.shape == (2, math.ceil(size / ALIGNMENT) * ALIGNMENT)
    assert not encoded[:, size:].any()
    assert encoded[:, :size].any(0).all()


@pytest.mark.parametrize("half", [False, True])
def test_room_is_left_before_the_encoding(half):
    means = random_means(5)
    with_room = encode_plainly(means, 4, 2, room=16, half=half)
    assert torch.equal(with_room[:, 16:], encode_plainly(means, 4, 2, half=half))


def test_threads_that_share_a_row_write_what_one_thread_writes():
    means = random_means(5)
    expected = encode_plainly(means, 10, 3, room=8)
    encoding = torch.empty_like(expected)
    run = Run(means.device, [])
    threads = 5 * 4 << CUDA_LANES_LOG2
    run.launch(make_encode(False), threads, means, TIME, *BOX, 10, 3, 8, CUDA_LANES_LOG2, encoding)
    assert torch.equal(encoding[:, 8:], expected[:, 8:])


def test_without_bands_the_values_are_the_encoding():
    means = random_means(5)
    assert torch.equal(encode_plainly(means, 0, 0)[:, :4], torch.cat([means, TIME.expand(5, 1)], 1))


def test_no_values_have_an_empty_encoding():
    assert encode_plainly(torch.zeros(0, 3), 4, 2).shape == (0, 32)


def test_each_value_is_encoded_apart_from_the_others():
    means = random_means(1)
    moved = means.clone()
    moved[0, 1] += 0.1
    changed = (encode_plainly(means, 4, 2) != encode_plainly(moved, 4, 2))[0]
    assert changed.nonzero()[:, 0].tolist() == [1, *range(7, 11), *range(19, 23)]
    changed = (encode_plainly(means, 4, 2) != encode_plainly(means, 4, 2, time=TIME + 0.1))[0]
    assert changed.nonzero()[:, 0].tolist() == [*range(27, 32)]


def test_no_gradient_flows_back():
    assert not encode_plainly(random_means(3).requires_grad_(), 2, 2).requires_grad


@pytest.mark.parametrize("means", [torch.zeros(4, 3, dtype=torch.float64), torch.zeros(3, 4).T])
def test_positions_that_the_kernel_cannot_read_are_refused(means):
    with pytest.raises(ValueError, match="means must"):
        encode_plainly(means, 2, 2)


def test_a_time_that_the_kernel_cannot_read_is_refused():
    with pytest.raises(ValueError, match="time must"):
        encode_plainly(random_means(4), 2, 2, time=TIME.double())
