"""Adam on the device: on CUDA in two launches (kernels/adam.py), on CPU in torch's."""

import math
from collections import defaultdict
from collections.abc import Sequence
from itertools import accumulate
from typing import Any

import torch
from torch.optim.adam import adam

from warpgs.kernels import adam as kernels
from warpgs.runtime.launch import launch


class Adam:
    """Adam as ``torch.optim.Adam(fused=True, capturable=True)`` computes it, with all parameters in one launch.

    Torch's CUDA kernel gives each block 65,536 numbers, so that the parameters of the Gaussians occupy only a few
    blocks. All state that changes between steps is on the device, so that a step can be part of a CUDA graph.

    It is no ``torch.optim.Optimizer``, whose constructor imports torch's compiler: two seconds, for nothing used here.

    Attributes:
        param_groups, betas, epsilon: The arguments.
        state: By parameter, once it had a gradient: ``step``, ``exp_avg`` and ``exp_avg_sq``, as in torch.

    Args:
        groups: Parameter groups with ``params`` and ``lr``, a tensor of one element that every step reads.
        betas: Decay rates of the first and of the second moment.
        epsilon: Added to the square root of the second moment.
    """

    def __init__(
        self, groups: list[dict[str, Any]], betas: tuple[float, float] = (0.9, 0.999), epsilon: float = 1e-8
    ) -> None:
        self.param_groups, self.betas, self.epsilon = groups, betas, epsilon
        self.state: defaultdict[torch.Tensor, dict[str, Any]] = defaultdict(dict)

    @torch.no_grad()
    def step(self) -> None:
        """Updates every parameter that has a gradient."""
        trained = [(group, p) for group in self.param_groups for p in group["params"] if p.grad is not None]
        if not trained:
            return
        for _, parameter in trained:
            state = self.state[parameter]
            if not state:
                state["step"] = torch.zeros((), dtype=torch.float32, device=parameter.device)
                state["exp_avg"] = torch.zeros_like(parameter)
                state["exp_avg_sq"] = torch.zeros_like(parameter)
        if trained[0][1].is_cuda:
            self._launch(trained)
        else:
            self._step_on_cpu(trained)

    def _launch(self, trained: list[tuple[dict[str, Any], Any]]) -> None:
        # Most threads are those of the largest parameters, and find these first.
        trained = sorted(trained, key=lambda pair: pair[1].numel(), reverse=True)
        for begin in range(0, len(trained), kernels.MAX_PARAMETERS):
            self._launch_some(trained[begin : begin + kernels.MAX_PARAMETERS])

    def _launch_some(self, trained: list[tuple[dict[str, Any], Any]]) -> None:
        """At most ``MAX_PARAMETERS`` parameters."""
        states = [self.state[parameter] for _, parameter in trained]
        gradients = [parameter.grad.contiguous() for _, parameter in trained]
        tensors = (
            [parameter for _, parameter in trained],
            gradients,
            [state["exp_avg"] for state in states],
            [state["exp_avg_sq"] for state in states],
            [group["lr"] for group, _ in trained],
            [state["step"] for state in states],
        )
        sizes = [gradient.numel() for gradient in gradients]
        blocks = [-(-size // (kernels.BLOCK * kernels.PER_THREAD)) for size in sizes]
        ends = [kernels.BLOCK * end for end in accumulate(blocks)]
        table = (
            gradients[0].new_empty(len(trained), 4, dtype=torch.int64),
            gradients[0].new_empty(len(trained), 2, dtype=torch.int32),
            gradients[0].new_empty(len(trained), 3),
        )
        addresses = [_padded([_address(tensor) for tensor in column]) for column in tensors]
        (beta1, beta2), counts = self.betas, (_padded(sizes), _padded(ends))
        launch(kernels.adam_begin, len(trained), *table, *addresses, *counts, math.log(beta1), math.log(beta2))
        launch(kernels.adam_step, ends[-1], *table, beta1, 1.0 - beta1, beta2, 1.0 - beta2, self.epsilon)

    def _step_on_cpu(self, trained: list[tuple[dict[str, Any], Any]]) -> None:
        """Torch's kernel, which is vectorized, as Warp's on CPU is not."""
        for group, parameter in trained:
            state = self.state[parameter]
            adam(
                [parameter],
                [parameter.grad.contiguous()],
                [state["exp_avg"]],
                [state["exp_avg_sq"]],
                [],
                [state["step"]],
                fused=True,
                amsgrad=False,
                beta1=self.betas[0],
                beta2=self.betas[1],
                lr=group["lr"],
                weight_decay=0.0,
                eps=self.epsilon,
                maximize=False,
            )

    def zero_grad(self) -> None:
        """Removes the gradients of all parameters."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None


def _address(tensor: torch.Tensor) -> int:
    """Where the numbers of a tensor are, of which kernels see nothing else."""
    if tensor.dtype != torch.float32 or not tensor.is_contiguous():
        raise ValueError(f"Adam needs contiguous torch.float32, got {tensor.dtype}, strides {list(tensor.stride())}")
    return tensor.data_ptr()


def _padded(numbers: Sequence[int]) -> tuple[int, ...]:
    """The numbers of all parameters as an argument of a launch."""
    return (*numbers, *[0] * (kernels.MAX_PARAMETERS - len(numbers)))
