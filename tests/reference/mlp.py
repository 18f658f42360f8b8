"""The multilayer perceptron in plain torch, any dtype."""

import torch
from torch import Tensor


def perceptron(encoding: Tensor, layers: list[tuple[Tensor, Tensor]], skip: int) -> Tensor:
    """Layers of (weight, bias) with ReLU after all but the last one; layer ``skip`` > 0 reads the encoding again."""
    values = encoding
    for k, (weight, bias) in enumerate(layers):
        if k > 0 and k == skip:
            values = torch.cat([values, encoding], 1)
        values = values @ weight.T + bias
        if k < len(layers) - 1:
            values = values.clamp_min(0.0)
    return values


def layer_bwd(v_outputs: Tensor, weight: Tensor, features: Tensor) -> Tensor:
    """Gradients of the inputs of the ReLU before a layer, given its outputs' gradients, weights and inputs."""
    return torch.where(features <= 0, 0.0, v_outputs @ weight)
