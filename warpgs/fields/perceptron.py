"""A multilayer perceptron with its own way back: few passes over memory, and half precision where that is fast.

Layer k computes h_{k+1} = max(0, W_k x_k + b_k), the last one without max, where x_k is h_k and, where the encoding e
enters, [h_k, e]. At these widths all is memory traffic, so inputs are kept with a constant column, x̃ = [h, e, 1], and
weights with their bias, W̃ = [W, b]: neither the bias nor the skip connection needs a pass of its own, and one product,
gᵀ x̃, is the gradient of weights and bias. On the way back g_k = (g_{k+1} W_k) · [h_k > 0].
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

ALIGNMENT = 8
"""Columns are padded to multiples of this: tensor cores want rows of 16 bytes."""

LARGEST_GRADIENT = 1024.0
"""In half precision gradients are scaled until the largest one at the output has this size: far enough from the largest
number, 65504, and with 34 bits below it until a gradient becomes zero."""


def perceptron(
    encoding: Float[Tensor, "N E"], weights: Sequence[Tensor], biases: Sequence[Tensor], skip: int
) -> Float[Tensor, "N outputs"]:
    """Runs the layers. No gradient flows to ``encoding``.

    Args:
        encoding: [N, E] what the first layer reads. If it has half precision, so have all factors of products; sums,
            gradients of weights and the result are single precision.
        weights: Of each layer, [width, E], [width, width] …; the one at ``skip`` is [width, width + E].
        biases: [width] of each layer.
        skip: Index of the layer that reads the encoding again, after its features.

    Returns:
        [N, outputs].
    """
    return _Perceptron.apply(encoding, skip, *weights, *biases)


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, encoding: Tensor, skip: int, *parameters: Tensor) -> Tensor:
        num = len(parameters) // 2
        pairs = zip(parameters[:num], parameters[num:], strict=True)
        weights = [_padded(torch.cat([weight, bias[:, None]], 1).to(encoding.dtype)) for weight, bias in pairs]
        one = torch.nn.functional.pad(encoding.new_ones(1), (0, ALIGNMENT - 1))
        inputs: list[Tensor] = []
        width = 0
        for k, weight in enumerate(weights):
            x = encoding.new_empty(len(encoding), weight.shape[1])
            if k > 0:
                torch.mm(inputs[-1], weights[k - 1].t(), out=x[:, :width])
                x.relu_()  # All columns, because that is faster than some; the others are written after it.
            if k in (0, skip):
                x[:, width : width + encoding.shape[1]] = encoding
                width += encoding.shape[1]
            x[:, width:] = one[: x.shape[1] - width]
            inputs.append(x)
            width = len(weight)
        ctx.save_for_backward(*inputs, *weights)
        ctx.columns = [parameter.shape[1] for parameter in parameters[:num]]
        return _product(inputs[-1], weights[-1].t())

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        num = len(ctx.columns)
        inputs, weights = ctx.saved_tensors[:num], ctx.saved_tensors[num:]
        unscale: Tensor | float = 1.0
        if weights[0].dtype == torch.float16:
            # With a row of zeros, because of no rows at all there is no largest.
            largest = torch.linalg.vector_norm(torch.nn.functional.pad(gradient, (0, 0, 0, 1)), torch.inf)
            largest = largest.clamp_min(torch.finfo(torch.float32).tiny * LARGEST_GRADIENT)
            gradient = (gradient * (LARGEST_GRADIENT / largest)).half()
            unscale = largest / LARGEST_GRADIENT
        v_weights: list[Tensor | None] = [None] * num
        v_biases: list[Tensor | None] = [None] * num
        for k in reversed(range(num)):
            both = _product(gradient.t(), inputs[k]) * unscale
            columns = ctx.columns[k]
            v_weights[k], v_biases[k] = both[:, :columns], both[:, columns]
            if k > 0:
                back = torch.ops.aten.threshold_backward(torch.mm(gradient, weights[k]), inputs[k], 0)
                gradient = back[:, : len(weights[k - 1])]
        return None, None, *v_weights, *v_biases


def _padded(matrix: Tensor) -> Tensor:
    """With zero columns up to the next multiple of ``ALIGNMENT``."""
    return torch.nn.functional.pad(matrix, (0, -matrix.shape[1] % ALIGNMENT))


def _product(a: Tensor, b: Tensor) -> Tensor:
    return torch.mm(a, b, out_dtype=torch.float32) if a.dtype == torch.float16 else torch.mm(a, b)
