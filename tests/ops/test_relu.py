"""The way back through ReLU and bias, in half precision."""

import pytest
import torch

from tests.scenes import generator
from warpgs.ops.relu import MAX_CHUNKS, ROWS_PER_CHUNK, num_sums, relu_backward


def random_half(*shape, seed=0):
    return torch.randn(*shape, generator=generator(seed)).half()


def room(gradients):
    return torch.full((num_sums(len(gradients)), gradients.shape[1]), torch.nan)


def relu_of(x):
    return x.clamp_min(0.0)


@pytest.mark.parametrize(
    ("num", "columns", "beside"), [(1, 8, 0), (37, 16, 24), (MAX_CHUNKS * ROWS_PER_CHUNK + 3, 8, 0)]
)
def test_gradients_pass_where_features_are_positive_and_are_added_up(num, columns, beside):
    features = random_half(num, columns + beside)
    features[:, :columns] = relu_of(features[:, :columns])
    features[0, 0] = 0.0
    gradients = random_half(num, columns, seed=1)
    expected = torch.where(features[:, :columns] > 0, gradients, 0.0)
    sums = room(gradients)
    relu_backward(features, gradients, sums)
    assert torch.equal(gradients, expected)
    assert torch.allclose(sums.double().sum(0), expected.double().sum(0), rtol=1e-6, atol=1e-5)


def test_the_smallest_positive_number_counts_and_what_is_not_a_number_stays_visible():
    features = torch.tensor([[6e-8, 0.0, torch.nan, torch.inf, 1.0, 0.0, 0.0, 0.0]]).half()
    gradients = torch.arange(1, 9).half()[None]
    relu_backward(features, gradients, room(gradients))
    assert gradients.tolist() == [[1, 0, 3, 4, 5, 0, 0, 0]]


def test_no_rows_have_no_sums():
    assert num_sums(0) == 0
    relu_backward(random_half(0, 8), random_half(0, 8), torch.zeros(0, 8))


def test_sums_of_another_size_are_refused():
    with pytest.raises(ValueError, match="sums must"):
        relu_backward(random_half(9, 8), random_half(9, 8), torch.zeros(2, 8))


@pytest.mark.parametrize(
    ("features", "gradients", "words"),
    [
        (random_half(3, 8), random_half(3, 12), "multiple of 8"),
        (random_half(3, 8), random_half(3, 16), "at most"),
        (random_half(4, 8), random_half(3, 8), "gradients must"),
        (random_half(3, 8).float(), random_half(3, 8), "features must"),
        (random_half(3, 8), random_half(8, 3).T, "gradients must"),
    ],
)
@pytest.mark.usefixtures("contracts_off")
def test_what_the_kernel_cannot_read_is_refused(features, gradients, words):
    with pytest.raises(ValueError, match=words):
        relu_backward(features, gradients, room(gradients))
