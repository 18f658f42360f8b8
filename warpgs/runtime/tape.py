"""The bridge between autograd and Warp's tape.

An op is a pair of plain functions, ``x_fwd`` and ``x_bwd``, that launch kernels on tensors. ``differentiable`` makes a
node of autograd of it. A render is several pairs on one ``Tape``: each records its backward function
(``tape.record_func``), and ``tape.backward()`` calls them in reverse order.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import warp as wp
from torch import Tensor
from torch.autograd.function import once_differentiable

Tape = wp.Tape

Gradients = Sequence[Tensor | None]


class Recorded(NamedTuple):
    """What the forward pass of an op returns to ``differentiable``.

    Attributes:
        outputs: Differentiable outputs.
        backward: ``backward(saved, v_outputs)`` returns the gradients of the inputs, in their order. It may hold other
            tensors, but not the inputs and outputs: a reference cycle would keep their memory until garbage collection.
        saved: Those inputs, outputs and other tensors that ``backward`` reads; none of them may be modified before.
        constants: Outputs without gradients, returned after the differentiable ones.
    """

    outputs: tuple[Tensor, ...]
    backward: Callable[[tuple[Any, ...], Gradients], Gradients]
    saved: tuple[Tensor | None, ...]
    constants: tuple[Tensor, ...] = ()


class _Node(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, op: Callable[..., Recorded], *tensors: Tensor | None) -> tuple[Tensor, ...]:
        outputs, ctx.backward_function, saved, constants = op(*tensors)
        ctx.num_outputs = len(outputs)
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*saved)
        ctx.mark_non_differentiable(*constants)
        return outputs + constants

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        if torch.is_grad_enabled():  # with create_graph=True only; the host would take longer to disable it always
            return _backward_once(ctx, *gradients)
        v_outputs = [None if v is None else v.contiguous() for v in gradients[: ctx.num_outputs]]
        return None, *ctx.backward_function(ctx.saved_tensors, v_outputs)


_backward_once = once_differentiable(_Node.backward)


def differentiable(op: Callable[..., Recorded], *tensors: Tensor | None) -> tuple[Tensor, ...]:
    """Calls ``op(*tensors)``, as a node of autograd if an input requires a gradient; returns outputs and constants.

    Args:
        op: Runs without autograd. Those tensors whose gradients its backward function must return require gradients.
        tensors: Inputs, contiguous and all on one device; None is passed on.
    """
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in tensors):
        return _Node.apply(op, *tensors)
    with torch.no_grad():
        recorded = op(*(t.detach() if t is not None and t.requires_grad else t for t in tensors))
    return recorded.outputs + recorded.constants
