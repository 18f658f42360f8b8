"""Adam (Kingma and Ba 2015, algorithm 1) in plain torch, any dtype."""

import torch
from torch import Tensor


def adam(parameter: Tensor, gradients: list[Tensor], rate: float, betas: tuple[float, float], epsilon: float):
    """The parameter and both moments after one step for each gradient."""
    mean, square = torch.zeros_like(parameter), torch.zeros_like(parameter)
    for step, gradient in enumerate(gradients, start=1):
        mean = betas[0] * mean + (1 - betas[0]) * gradient
        square = betas[1] * square + (1 - betas[1]) * gradient**2
        unbiased_mean, unbiased_square = mean / (1 - betas[0] ** step), square / (1 - betas[1] ** step)
        parameter = parameter - rate * unbiased_mean / (unbiased_square.sqrt() + epsilon)
    return parameter, mean, square
