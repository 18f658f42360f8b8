"""A multilayer perceptron with its own way back: few launches, few passes over memory, half precision where it is fast.

Layer k computes h_{k+1} = max(0, W_k x_k + b_k) in one call, the last one without max, where x_k is h_k and, where the
encoding e enters, [h_k, e]. Room for h beside e is left in the tensor that e comes in. On the way back
g_k = (g_{k+1} W_k) · [h_k > 0]; the gradients of W_k and b_k are g_{k+1}ᵀ x_k and the sum of g_{k+1}.

All weights and biases are one tensor, and so are their gradients: what is done to all of them is done in one launch.
"""

from collections.abc import Sequence
from itertools import chain
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from .encoding import ALIGNMENT
from .relu import num_sums, relu_backward

MAX_GRADIENT = 1024.0
"""In half precision gradients are scaled until the largest one at the output has this size: far enough from the largest
number, 65504, and with 34 bits below it until a gradient becomes zero."""


class Layer(NamedTuple):
    """One layer's part of the one tensor.

    Attributes:
        weight: [rows, columns].
        bias: [rows].
    """

    weight: Float[Tensor, "rows columns"]
    bias: Float[Tensor, " rows"]


def num_values(shapes: Sequence[tuple[int, int]]) -> int:
    """Weights and biases of layers whose weights have these shapes."""
    return sum(rows * columns + rows for rows, columns in shapes)


def split(values: Float[Tensor, " values"], shapes: Sequence[tuple[int, int]]) -> list[Layer]:
    """The layers, as views: in memory the weights of all of them come first, then all biases."""
    rows = [r for r, _ in shapes]
    *weights, biases = values.split([r * c for r, c in shapes] + [sum(rows)])
    pairs = zip(weights, biases.split(rows), shapes, strict=True)
    return [Layer(weight.view(shape), bias) for weight, bias, shape in pairs]


def perceptron(
    inputs: Float[Tensor, "N columns"],
    values: Float[Tensor, " values"],
    shapes: Sequence[tuple[int, int]],
    skip: int,
    num_outputs: int,
) -> Float[Tensor, "N outputs"]:
    """Runs the layers. No gradient flows to ``inputs``.

    Args:
        inputs: [N, R + E] whose last E columns are the encoding that the first layer reads; the first R are overwritten
            by the features that enter layer ``skip`` beside it, R of them, 0 without ``skip``. If it has half
            precision, so have all factors of products; sums, gradients of ``values`` and the result are single
            precision.
        values: Weights and biases, as ``split`` finds them.
        shapes: Of the weights: [width, E], [width, width] …; the one at ``skip`` is [width, R + E], the last one has
            ``num_outputs`` rows or more. In half precision all numbers are multiples of 8, and hidden layers have
            one width.
        skip: Index of the layer that reads the encoding again, after its features; 0 if none does.
        num_outputs: Rows of the last layer that count; what the others give is left out.

    Returns:
        [N, num_outputs].

    Raises:
        ValueError: In half precision, unless the numbers are such.
    """
    if inputs.dtype == torch.float16 and any(number % ALIGNMENT for number in chain([inputs.shape[1]], *shapes)):
        raise ValueError(f"in half precision rows and columns must be multiples of {ALIGNMENT}, got {list(shapes)}")
    return _Perceptron.apply(inputs, values, tuple(shapes), skip, num_outputs)


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, inputs: Tensor, values: Tensor, shapes: tuple[tuple[int, int], ...], skip: int, num_outputs: int
    ) -> Tensor:
        copy = values.to(inputs.dtype)
        *hidden, head = split(copy, shapes)
        x = inputs[:, inputs.shape[1] - shapes[0][1] :]
        read = []
        for k, layer in enumerate(hidden):
            if skip and k == skip:
                # A product that wrote here by itself would need two more passes, for the bias and for max.
                _in_pieces(inputs)[:, : _in_pieces(x).shape[1]] = _in_pieces(x)
                x = inputs
            read.append(x)
            x = torch._addmm_activation(layer.bias, x, layer.weight.t())
        ctx.save_for_backward(*read, x, copy)
        ctx.shapes = shapes
        bias = split(values, shapes)[-1].bias[:num_outputs]
        return _product(x, head.weight.t())[:, :num_outputs] + bias

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        *read, copy = ctx.saved_tensors
        layers = split(copy, ctx.shapes)
        is_half = copy.dtype == torch.float16
        v_values = torch.empty_like(copy, dtype=gradient.dtype)
        v_layers = split(v_values, ctx.shapes)
        num_padding = len(layers[-1].bias) - gradient.shape[1]
        v_head_bias = torch.nn.functional.pad(gradient.sum(0), (0, num_padding))
        if is_half:
            gradient, unscale = _scaled(gradient, len(layers[-1].bias))
            sums = v_values.new_empty(len(layers) - 1, num_sums(len(gradient)), len(layers[0].bias))
        else:
            gradient = torch.nn.functional.pad(gradient, (0, num_padding))
        for k in reversed(range(len(layers))):
            _product(gradient.t(), read[k], v_layers[k].weight)
            if k > 0:
                gradient = torch.mm(gradient, layers[k].weight[:, : len(layers[k - 1].bias)])
                if is_half:
                    relu_backward(read[k], gradient, sums[k - 1])
                else:
                    features = read[k][:, : gradient.shape[1]]
                    torch.ops.aten.threshold_backward(gradient, features, 0, grad_input=gradient)
                    torch.sum(gradient, 0, out=v_layers[k - 1].bias)
        if is_half:
            v_biases = v_values[-len(v_head_bias) - sums.shape[0] * sums.shape[2] : -len(v_head_bias)]
            torch.sum(sums, 1, out=v_biases.view(sums.shape[0], sums.shape[2]))
            v_values *= unscale
        v_layers[-1].bias.copy_(v_head_bias)
        return None, v_values, None, None, None


def _scaled(gradient: Tensor, columns: int) -> tuple[Tensor, Tensor]:
    """The gradient at the output in half precision, with zeros up to ``columns``, and what undoes its scale."""
    # With a row of zeros, because of no rows at all there is no largest.
    largest = torch.linalg.vector_norm(torch.nn.functional.pad(gradient, (0, 0, 0, 1)), torch.inf)
    largest = largest.clamp_min(torch.finfo(torch.float32).tiny * MAX_GRADIENT)
    scaled = gradient.new_zeros(len(gradient), columns, dtype=torch.float16)
    torch.mul(gradient, MAX_GRADIENT / largest, out=scaled[:, : gradient.shape[1]])
    return scaled, largest / MAX_GRADIENT


def _in_pieces(matrix: Tensor) -> Tensor:
    """Seen as numbers of 16 bytes, which are copied faster, where rows are made of such."""
    return matrix.view(torch.complex128) if matrix.shape[1] * matrix.element_size() % 16 == 0 else matrix


def _product(a: Tensor, b: Tensor, out: Tensor | None = None) -> Tensor:
    """The product in single precision."""
    if a.dtype != torch.float16:
        return torch.mm(a, b, out=out)
    if out is None:
        return torch.mm(a, b, out_dtype=torch.float32)
    return torch.ops.aten.mm.dtype_out(a, b, torch.float32, out=out)
