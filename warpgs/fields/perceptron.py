"""A multilayer perceptron with its own way back: few launches, few passes over memory, half precision where it is fast.

Layer k computes h_{k+1} = max(0, W_k x_k + b_k) in one call, the last one without max, where x_k is h_k and, where the
encoding e enters, [h_k, e]. Room for h beside e is left in the tensor that e comes in, so nothing is ever concatenated.
On the way back g_k = (g_{k+1} W_k) · [h_k > 0]; the gradients of W_k and b_k are g_{k+1}ᵀ x_k and the sum of g_{k+1}.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

LARGEST_GRADIENT = 1024.0
"""In half precision gradients are scaled until the largest one at the output has this size: far enough from the largest
number, 65504, and with 34 bits below it until a gradient becomes zero."""


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
                x = inputs
            weight = torch.nn.functional.pad(copies[k], (0, x.shape[1] - copies[k].shape[1]))
            read.append(x)
            weights.append(weight)
            if k + 1 < num:
                out = inputs[:, :room] if k + 1 == skip else inputs.new_empty(len(inputs), len(weight))
                x = torch._addmm_activation(copies[num + k], x, weight.t(), out=out)
        ctx.save_for_backward(*read, *weights)
        ctx.columns = [parameter.shape[1] for parameter in parameters[:num]]
        return _product(x, weights[-1].t()) + parameters[-1]

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        num = len(ctx.columns)
        read, weights = ctx.saved_tensors[:num], ctx.saved_tensors[num:]
        unscale: Tensor | None = None
        if weights[0].dtype == torch.float16:
            # With a row of zeros, because of no rows at all there is no largest.
            largest = torch.linalg.vector_norm(torch.nn.functional.pad(gradient, (0, 0, 0, 1)), torch.inf)
            largest = largest.clamp_min(torch.finfo(torch.float32).tiny * LARGEST_GRADIENT)
            gradient = (gradient * (LARGEST_GRADIENT / largest)).half()
            unscale = largest / LARGEST_GRADIENT
        v_weights: list[Tensor] = [gradient] * num
        v_biases: list[Tensor] = [gradient] * num
        for k in reversed(range(num)):
            v_weights[k] = _product(gradient.t(), read[k])
            v_biases[k] = gradient.sum(0, dtype=torch.float32 if unscale is not None else None)
            if k > 0:
                features = read[k][:, : len(weights[k - 1])]
                back = torch.mm(gradient, weights[k][:, : features.shape[1]])
                gradient = torch.ops.aten.threshold_backward(back, features, 0, grad_input=back)
        if unscale is not None:
            torch._foreach_mul_([*v_weights, *v_biases], unscale)
        columns = [v[:, :used] for v, used in zip(v_weights, ctx.columns, strict=True)]
        return None, None, *columns, *v_biases


def _copies(parameters: Sequence[Tensor], dtype: torch.dtype) -> Sequence[Tensor]:
    """The parameters in a dtype; themselves if it is theirs."""
    if parameters[0].dtype == dtype:
        return parameters
    copies = [torch.empty_like(parameter, dtype=dtype) for parameter in parameters]
    torch._foreach_copy_(copies, list(parameters))
    return copies


def _product(a: Tensor, b: Tensor) -> Tensor:
    return torch.mm(a, b, out_dtype=torch.float32) if a.dtype == torch.float16 else torch.mm(a, b)
