"""The multilayer perceptron, and the backward pass of ReLU and bias in half precision."""

import pytest
import torch

from tests.reference import mlp as reference
from tests.scenes import error, generator, random_like, relative_error
from warpgs.ops import mlp
from warpgs.ops.mlp import MAX_CHUNKS, ROWS_PER_CHUNK, num_sums, num_values, perceptron, relu_backward, split

COLUMNS, WIDTH, OUTPUTS = 6, 16, (3, 1, 1)
LAYOUTS = [(9, 4), (4, 2), (4, 1), (5, 0), (2, 0)]
"""Numbers of layers with the last one, and the layer that reads the encoding again (0: none)."""


def make_shapes(depth, skip):
    hidden = [(WIDTH, WIDTH + COLUMNS * (k == skip)) for k in range(1, depth - 1)]
    return [(WIDTH, COLUMNS), *hidden, (sum(OUTPUTS) + 2, WIDTH)]


def random_inputs(num, skip):
    """Encodings with free columns before them if there is a skip connection."""
    inputs = torch.randn(num, COLUMNS + (WIDTH if skip else 0), generator=generator())
    inputs[:, :-COLUMNS] = torch.nan
    return inputs


def random_values(shapes):
    values = 0.3 * torch.randn(num_values(shapes), generator=generator(1))
    return values.requires_grad_()


def double_layers(values, shapes):
    return [tuple(part.detach().double().requires_grad_() for part in layer) for layer in split(values, shapes)]


@pytest.mark.parametrize("num", [0, 1, 37, 200])
@pytest.mark.parametrize(("depth", "skip"), LAYOUTS)
def test_outputs_and_gradients_equal_the_reference(depth, skip, num):
    shapes = make_shapes(depth, skip)
    inputs, values = random_inputs(num, skip), random_values(shapes)
    layers = double_layers(values, shapes)
    expected = reference.perceptron(inputs[:, -COLUMNS:].double(), layers, skip)[:, : sum(OUTPUTS)]
    parts = perceptron(inputs, values, shapes, skip, OUTPUTS)
    assert [part.shape for part in parts] == [(num, columns) for columns in OUTPUTS]
    assert all(part.is_contiguous() for part in parts)
    outputs = torch.cat(parts, 1)
    (v_outputs,) = random_like([outputs])
    outputs.backward(v_outputs)
    expected.backward(v_outputs.double())
    if num > 0:
        assert relative_error(outputs, expected) < 2e-6
    for layer, wanted in zip(split(values.grad, shapes), layers, strict=True):
        for gradient, part in zip(layer, wanted, strict=True):
            assert error(gradient, part.grad) < 1e-5 * (1 + part.grad.abs().max())


def single_precision_product(a, b, out=None):
    value = a.float() @ b.float()
    return value if out is None else out.copy_(value)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("num", [0, 1, 40])
def test_padding_rows_change_neither_outputs_nor_gradients(half, num, monkeypatch):
    if half:  # the CPU has no such products
        monkeypatch.setattr(mlp, "_product", single_precision_product)
    shapes = [(WIDTH, 8), (WIDTH, WIDTH + 8), (8, WIDTH)]
    values = random_values(shapes)
    results = []
    for rows in (64, 128) if half else (num, 40):
        inputs = torch.randn(128, 8 + WIDTH, generator=generator())[:rows].to(torch.float16 if half else torch.float32)
        values.grad = None
        outputs = torch.cat(perceptron(inputs.contiguous(), values, shapes, 1, OUTPUTS, num), 1)
        outputs.backward(torch.randn(40, sum(OUTPUTS), generator=generator(2))[:num])
        results.append((outputs.detach(), values.grad))
    for padded, expected in zip(*results, strict=True):
        assert padded.shape == expected.shape
        assert torch.allclose(padded, expected, rtol=0.0, atol=1e-5)


def test_outputs_that_are_not_used_have_no_gradient():
    shapes = make_shapes(3, 0)
    inputs, values = random_inputs(70, 0), random_values(shapes)
    first, *_ = perceptron(inputs, values, shapes, 0, OUTPUTS)
    (alone,) = torch.autograd.grad(first.square().sum(), values)
    first, *others = perceptron(inputs, values, shapes, 0, OUTPUTS)
    (beside,) = torch.autograd.grad(first.square().sum() + sum(0.0 * other.sum() for other in others), values)
    assert alone.any()
    assert torch.equal(alone, beside)


@pytest.mark.parametrize("num", [0, 5])
def test_gradients_in_half_precision_are_scaled_by_their_common_maximum(num):
    small, large = torch.ones(num, 3), torch.full((num, 2), -1e5)
    scaled, unscale = mlp._scaled((small, large), (64, 8))
    assert scaled.isfinite().all()
    assert scaled.shape == (64, 8)
    assert not scaled[num:].any()
    assert not scaled[:, 5:].any()
    expected = torch.cat([small, large], 1)
    assert torch.allclose(scaled[:num, :5].float() * unscale, expected, rtol=1e-3)


def test_inputs_get_no_gradient():
    shapes = make_shapes(3, 0)
    inputs = random_inputs(4, 0).requires_grad_()
    perceptron(inputs, random_values(shapes), shapes, 0, OUTPUTS)[0].sum().backward()
    assert inputs.grad is None


def test_sizes_that_do_not_fit_half_precision_are_refused():
    shapes = make_shapes(3, 0)
    with pytest.raises(ValueError, match="multiples of 8"):
        perceptron(random_inputs(64, 0).half(), random_values(shapes), shapes, 0, OUTPUTS)


@pytest.mark.parametrize(("rows", "num_rows"), [(63, None), (64, 65)])
def test_numbers_of_inputs_that_do_not_fit_half_precision_are_refused(rows, num_rows):
    shapes = [(8, 8), (8, 8)]
    with pytest.raises(ValueError, match="a multiple of 64 inputs"):
        perceptron(torch.zeros(rows, 8).half(), random_values(shapes), shapes, 0, OUTPUTS, num_rows)


def test_half_precision_on_part_of_the_multiprocessors_is_refused(monkeypatch):
    monkeypatch.setattr(mlp, "_product", single_precision_product)
    shapes = [(8, 8), (8, 8)]
    inputs, values = torch.zeros(64, 8), random_values(shapes)
    for percentage in ("100", ""):
        monkeypatch.setenv("CUDA_MPS_ACTIVE_THREAD_PERCENTAGE", percentage)
        perceptron(inputs.half(), values, shapes, 0, OUTPUTS)
    monkeypatch.setenv("CUDA_MPS_ACTIVE_THREAD_PERCENTAGE", "35")
    perceptron(inputs, values, shapes, 0, OUTPUTS)
    with pytest.raises(ValueError, match=r"CUDA_MPS_ACTIVE_THREAD_PERCENTAGE=35: .* --model.no-half"):
        perceptron(inputs.half(), values, shapes, 0, OUTPUTS)


def random_half(*shape, seed=0):
    return torch.randn(*shape, generator=generator(seed)).half()


def empty_sums(gradients):
    return torch.full((num_sums(len(gradients)), gradients.shape[1]), torch.nan)


@pytest.mark.parametrize(
    ("num", "columns", "extra"), [(1, 8, 0), (37, 16, 24), (MAX_CHUNKS * ROWS_PER_CHUNK + 3, 8, 0)]
)
def test_gradients_pass_where_features_are_positive_and_are_summed(num, columns, extra):
    features = random_half(num, columns + extra)
    features[:, :columns].clamp_min_(0.0)
    features[0, 0] = 0.0
    gradients = random_half(num, columns, seed=1)
    expected, _ = reference.relu_backward(features[:, :columns], gradients)
    sums = empty_sums(gradients)
    relu_backward(features, gradients, sums)
    assert torch.equal(gradients, expected)
    assert torch.allclose(sums.double().sum(0), expected.double().sum(0), rtol=1e-6, atol=1e-5)


def test_tiny_features_and_nan_count_as_positive():
    features = torch.tensor([[6e-8, 0.0, torch.nan, torch.inf, 1.0, 0.0, 0.0, 0.0]]).half()
    gradients = torch.arange(1, 9).half()[None]
    relu_backward(features, gradients, empty_sums(gradients))
    assert gradients.tolist() == [[1, 0, 3, 4, 5, 0, 0, 0]]


def test_no_rows_have_no_partial_sums():
    assert num_sums(0) == 0
    relu_backward(random_half(0, 8), random_half(0, 8), torch.zeros(0, 8))


def test_sums_of_a_wrong_size_are_refused():
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
def test_relu_backward_refuses_inputs_that_do_not_fit(features, gradients, words):
    with pytest.raises(ValueError, match=words):
        relu_backward(features, gradients, empty_sums(gradients))
