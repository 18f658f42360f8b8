"""The multilayer perceptron, and the backward pass of a layer in half precision."""

import pytest
import torch

from tests.reference import mlp as reference
from tests.scenes import error, generator, random_like, relative_error
from warpgs.ops import mlp
from warpgs.ops.mlp import ROWS_PER_PRODUCT, layer_bwd, num_tiles, num_values, perceptron, split

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


def gradient_in_half_precision(num, shapes, skip):
    """[values] gradient of all weights and biases."""
    inputs = torch.randn(num, 8 + WIDTH, generator=generator()).half()
    values = random_values(shapes)
    outputs = torch.cat(perceptron(inputs, values, shapes, skip, OUTPUTS), 1)
    outputs.backward(torch.randn(num, sum(OUTPUTS), generator=generator(2)))
    return values.grad


@pytest.mark.parametrize("num", [64, ROWS_PER_PRODUCT, ROWS_PER_PRODUCT + 128])
@pytest.mark.parametrize("skip", [1, 3, 5])
def test_stacked_layers_have_the_gradients_of_single_ones(skip, num, monkeypatch):
    shapes = [(WIDTH, 8), *((WIDTH, WIDTH + 8 * (k == skip)) for k in range(1, 6)), (8, WIDTH)]
    products = []

    def count(*arguments):
        products.append(arguments)
        return single_precision_product(*arguments)

    monkeypatch.setattr(mlp, "_product", count)
    stacked = gradient_in_half_precision(num, shapes, skip)
    num_stacked = len(products)
    monkeypatch.setattr(mlp, "MAX_STACKED_ROWS", num - 1)
    single = gradient_in_half_precision(num, shapes, skip)
    assert relative_error(stacked, single) < 1e-6
    num_runs = 2 if skip == 3 else 1
    assert (num_stacked, len(products) - num_stacked) == (4 + num_runs, 8)


def test_layers_are_not_stacked_without_gradients(monkeypatch):
    monkeypatch.setattr(mlp, "_product", single_precision_product)
    monkeypatch.setattr(mlp, "_new_stack", None)
    shapes = [(WIDTH, 8), (WIDTH, WIDTH), (8, WIDTH)]
    inputs, values = torch.zeros(64, 8).half(), random_values(shapes)
    with torch.no_grad():
        perceptron(inputs, values, shapes, 0, OUTPUTS)
    perceptron(inputs, values.detach(), shapes, 0, OUTPUTS)
    with pytest.raises(TypeError):
        perceptron(inputs, values, shapes, 0, OUTPUTS)


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
    scaled, unscale, sums = mlp._scaled((small, large), (64, 8))
    assert scaled.isfinite().all()
    assert scaled.shape == (64, 8)
    assert not scaled[num:].any()
    assert not scaled[:, 5:].any()
    expected = torch.cat([small, large], 1)
    assert torch.allclose(scaled[:num, :5].float() * unscale, expected, rtol=1e-3)
    assert torch.equal(sums.sum(1)[:5], expected.sum(0))
    assert not sums[5:].any()


def test_gradients_that_are_all_zero_stay_zero_in_half_precision():
    scaled, unscale, sums = mlp._scaled((torch.zeros(5, 3),), (64, 8))
    assert not scaled.any()
    assert not sums.any()
    assert unscale.isfinite()


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


def empty_sums(num, columns):
    return torch.full((num_tiles(num), columns), torch.nan)


LAYERS = [
    (1, 8, 8, (0, 0)),
    (37, 8, 24, (16, 8)),
    (128, 32, 128, (0, 0)),
    (300, 40, 136, (0, 88)),
    (150, 104, 264, (8, 0)),
]
"""Rows, outputs, columns of the gradient, and further columns of the weights and of the features."""


def random_layer(num, outputs, columns, more):
    """Gradient of the outputs, weights, features, and unwritten sums; what must not be read is NaN."""
    v_outputs, weight = random_half(num, outputs), random_half(outputs, columns + more[0], seed=1)
    features = random_half(num, columns + more[1], seed=2)
    features[0, :8] = torch.tensor([6e-8, 0.0, torch.nan, torch.inf, 1.0, -1.0, -0.0, -torch.inf])
    weight[:, columns:], features[:, columns:] = torch.nan, torch.nan
    return v_outputs, weight, features, empty_sums(num, columns)


@pytest.mark.parametrize("sizes", LAYERS)
def test_the_gradient_before_a_layer_is_masked_and_summed(sizes):
    v_outputs, weight, features, sums = random_layer(*sizes)
    actual, columns = layer_bwd(v_outputs, weight, features, sums), sizes[2]
    expected = reference.layer_bwd(v_outputs.double(), weight[:, :columns].double(), features[:, :columns])
    assert actual.shape == expected.shape
    assert torch.equal(actual == 0, expected == 0)
    assert error(actual, expected) <= 2**-11 * expected.abs().max()  # rounded to half precision
    assert torch.allclose(sums.double().sum(0), actual.double().sum(0), rtol=1e-6, atol=1e-4)


def test_nan_passes_the_backward_pass_of_a_layer():
    assert_nan_stays_in_its_row("cpu")


def assert_nan_stays_in_its_row(device):
    v_outputs, weight, features = (torch.ones(shape).half().to(device) for shape in ((2, 8), (8, 8), (2, 8)))
    v_outputs[1, 3] = torch.nan
    sums = empty_sums(2, 8).to(device)
    actual = layer_bwd(v_outputs, weight, features, sums)
    assert actual[0].eq(8.0).all()
    assert actual[1].isnan().all()
    assert sums.isnan().all()


def test_no_rows_have_no_tiles():
    assert num_tiles(0) == 0
    v_inputs = layer_bwd(random_half(0, 8), random_half(8, 16), random_half(0, 16), torch.zeros(0, 16))
    assert v_inputs.shape == (0, 16)


LAYER = {"v_outputs": (3, 8), "weight": (8, 16), "features": (3, 24)}


@pytest.mark.parametrize(
    ("changed", "shape_of_sums", "words"),
    [
        ({}, (2, 16), "sums must"),
        ({}, (1, 12), "sums must have a multiple of 8"),
        ({"v_outputs": random_half(3, 12), "weight": random_half(12, 16)}, (1, 16), "v_outputs must have a multiple"),
        ({"weight": random_half(8, 20)}, (1, 16), "weight must have a multiple"),
        ({"features": random_half(3, 20)}, (1, 16), "features must have a multiple"),
        ({"weight": random_half(16, 16)}, (1, 16), "weight must"),
        ({"weight": random_half(16, 8).T}, (1, 16), "weight must be contiguous"),
        ({"features": random_half(4, 16)}, (1, 16), "features must"),
        ({"features": random_half(3, 16).float()}, (1, 16), "features must"),
        ({"features": torch.empty(3, 24, dtype=torch.float16, device="meta")}, (1, 16), "one device"),
        ({}, (1, 24), "weight must .* at least 24, got 16"),
        ({"weight": random_half(8, 32)}, (1, 32), "features must .* at least 32, got 24"),
    ],
)
@pytest.mark.usefixtures("contracts_off")
def test_the_backward_pass_of_a_layer_refuses_inputs_that_do_not_fit(changed, shape_of_sums, words):
    inputs = {name: random_half(*shape) for name, shape in LAYER.items()} | changed
    with pytest.raises(ValueError, match=words):
        layer_bwd(**inputs, sums=torch.zeros(shape_of_sums))
