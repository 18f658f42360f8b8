"""A multilayer perceptron with its own way back: few launches, few passes over memory, half precision where it is fast.

Layer k computes h_{k+1} = max(0, W_k x_k + b_k) in one call, the last one without max, where x_k is h_k and, where the
encoding e enters, [h_k, e]. Room for h beside e is left in the tensor that e comes in. On the way back
g_k = (g_{k+1} W_k) · [h_k > 0]; the gradients of W_k and b_k are g_{k+1}ᵀ x_k and the sum of g_{k+1}.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.ops.relu import relu_backward

LARGEST_GRADIENT = 1024.0
"""In half precision gradients are scaled until the largest one at the output has this size: far enough from the largest
number, 65504, and with 34 bits below it until a gradient becomes zero."""

ALIGNMENT = 8
"""In half precision, units of every layer are padded to a multiple of this: tensor cores want rows of 16 bytes."""


def perceptron(
    inputs: Float[Tensor, "N columns"], weights: Sequence[Tensor], biases: Sequence[Tensor], skip: int
) -> Float[Tensor, "N outputs"]:
    """Runs the layers. No gradient flows to ``inputs``.

    Args:
        inputs: [N, R + E] whose last E columns are the encoding that the first layer reads; the first R are overwritten
            by the features that enter layer ``skip`` beside it, R of them, 0 without ``skip``. If it has half
            precision, so have all factors of products; sums, gradients of parameters and the result are single
            precision. Columns beyond those that weights have are padding, to be zero.
        weights: Of each layer, [width, ≤ E], [width, width] …; the one at ``skip`` is [width, R + ≤ E].
        biases: [width] of each layer.
        skip: Index of the layer that reads the encoding again, after its features; 0 if none does.

    Returns:
        [N, outputs].
    """
    return _Perceptron.apply(inputs, skip, *weights, *biases)


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, inputs: Tensor, skip: int, *parameters: Tensor) -> Tensor:
        num = len(parameters) // 2
        room = len(parameters[skip - 1]) if skip else 0
        copies = _copies(parameters, inputs.dtype)
        x = inputs[:, room:]
        read, weights = [], []
        for k in range(num):
            if skip and k == skip:
                # A product that wrote here by itself would need two more passes, for the bias and for max.
                _in_pieces(inputs)[:, : _in_pieces(x).shape[1]] = _in_pieces(x)
                x = inputs
            weight = _padded(copies[k], x.shape[1])
            read.append(x)
            weights.append(weight)
            if k + 1 < num:
                x = torch._addmm_activation(copies[num + k], x, weight.t())
        ctx.save_for_backward(*read, *weights)
        ctx.shapes = [parameter.shape for parameter in parameters[:num]]
        return _product(x, weights[-1].t())[:, : len(copies[num - 1])] + parameters[-1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        num = len(ctx.shapes)
        read, weights = ctx.saved_tensors[:num], ctx.saved_tensors[num:]
        is_half = weights[0].dtype == torch.float16
        v_weights: list[Tensor] = [gradient] * num
        v_biases: list[Tensor] = [gradient] * num
        v_biases[-1] = gradient.sum(0)
        if is_half:
            gradient, unscale = _scaled(gradient, len(weights[-1]))
        sums = []
        for k in reversed(range(num)):
            v_weights[k] = _product(gradient.t(), read[k])
            if k > 0:
                gradient = torch.mm(gradient, weights[k][:, : len(weights[k - 1])])
                if is_half:
                    sums.append(relu_backward(read[k], gradient))
                else:
                    features = read[k][:, : gradient.shape[1]]
                    torch.ops.aten.threshold_backward(gradient, features, 0, grad_input=gradient)
                    v_biases[k - 1] = gradient.sum(0)
        if is_half:
            v_biases[:-1] = torch.stack(sums[::-1]).sum(1).unbind() if sums else []
            torch._foreach_mul_([*v_weights, *v_biases[:-1]], unscale)
        v_weights = [v[:rows, :columns] for v, (rows, columns) in zip(v_weights, ctx.shapes, strict=True)]
        return None, None, *v_weights, *v_biases


def _scaled(gradient: Tensor, columns: int) -> tuple[Tensor, Tensor]:
    """The gradient at the output in half precision, with zeros up to ``columns``, and what undoes its scale."""
    # With a row of zeros, because of no rows at all there is no largest.
    largest = torch.linalg.vector_norm(torch.nn.functional.pad(gradient, (0, 0, 0, 1)), torch.inf)
    largest = largest.clamp_min(torch.finfo(torch.float32).tiny * LARGEST_GRADIENT)
    scaled = gradient.new_zeros(len(gradient), columns, dtype=torch.float16)
    torch.mul(gradient, LARGEST_GRADIENT / largest, out=scaled[:, : gradient.shape[1]])
    return scaled, largest / LARGEST_GRADIENT


def _padded(weight: Tensor, columns: int) -> Tensor:
    """With columns of zeros for the padding of what it multiplies, and in half precision with rows for whole pieces."""
    rows = -len(weight) % ALIGNMENT if weight.dtype == torch.float16 else 0
    missing = columns - weight.shape[1]
    return torch.nn.functional.pad(weight, (0, missing, 0, rows)) if missing or rows else weight


def _in_pieces(matrix: Tensor) -> Tensor:
    """Seen as numbers of 16 bytes, which are copied faster, where rows are made of such."""
    return matrix.view(torch.complex128) if matrix.shape[1] * matrix.element_size() % 16 == 0 else matrix


def _copies(parameters: Sequence[Tensor], dtype: torch.dtype) -> Sequence[Tensor]:
    """The parameters in a dtype; themselves if it is theirs."""
    if parameters[0].dtype == dtype:
        return parameters
    copies = [torch.empty_like(parameter, dtype=dtype) for parameter in parameters]
    torch._foreach_copy_(copies, list(parameters))
    return copies


def _product(a: Tensor, b: Tensor) -> Tensor:
    return torch.mm(a, b, out_dtype=torch.float32) if a.dtype == torch.float16 else torch.mm(a, b)
