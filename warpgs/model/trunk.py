"""The multilayer perceptron that the networks are built on."""

from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig
from warpgs.ops.encoding import ALIGNMENT, aligned, encode, encoded_size
from warpgs.ops.mlp import Layer, num_values, perceptron, split


class Trunk(nn.Module):
    """[γ(μ), γ(t)] → outputs: ``depth`` ReLU layers of ``width`` units; the encoding is concatenated after ``skip``.

    The last layer, the head, is initialized to zero, so that a network starts as "no change"; the other layers are
    initialized as ``nn.Linear`` does.

    Positions are in the box ``center`` ± ``half_size``, [3] each. ``outputs`` are the numbers of columns of the tensors
    that the network returns.

    Attributes:
        center, half_size: [3] box that positions are normalized by, to about [-1, 1].
        values: Weights and biases of all layers in one tensor; ``layers`` are views of it. The padding of the encoding
            and of the outputs is 0 and stays 0.
    """

    center: Tensor
    half_size: Tensor

    def __init__(
        self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"], outputs: tuple[int, ...]
    ) -> None:
        super().__init__()
        self.bands, self.raw = (config.position_bands, config.time_bands), config.raw_input
        self.outputs = outputs
        self.skip = config.skip if config.skip < config.depth else 0
        self.reserved_columns = config.width if self.skip else 0
        self.uses_half = config.half and config.width % ALIGNMENT == 0
        self.register_buffer("center", center.clone())
        self.register_buffer("half_size", half_size.clone())
        encoded = encoded_size(*self.bands, self.raw)
        columns = [encoded] + [config.width + (encoded if k == self.skip else 0) for k in range(1, config.depth)]
        self.sizes = [*((config.width, c) for c in columns), (sum(outputs), config.width)]
        padding = aligned(encoded) - encoded
        self.shapes = [(rows, c + (padding if k in (0, self.skip) else 0)) for k, (rows, c) in enumerate(self.sizes)]
        self.shapes[-1] = (aligned(sum(outputs)), config.width)
        self.values = nn.Parameter(center.new_zeros(num_values(self.shapes)))
        for layer, (rows, c) in zip(self.layers(self.values.data)[:-1], self.sizes, strict=False):
            initial = nn.Linear(c, rows, dtype=center.dtype)
            layer.weight.copy_(initial.weight.data)
            layer.bias.copy_(initial.bias.data)

    def layers(self, values: Float[Tensor, " values"]) -> list[Layer]:
        """The layers in ``values`` or in its gradient, as views without padding; the last one is the head."""
        layers = split(values, self.shapes)
        return [Layer(weight[:r, :c], bias[:r]) for (weight, bias), (r, c) in zip(layers, self.sizes, strict=True)]

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, " T"], values: Float[Tensor, " values"] | None = None
    ) -> tuple[Tensor, ...]:
        """Evaluates the network at N positions and one or N times in [0, 1]: [N, number] for each of ``outputs``.

        No gradient flows to the positions. ``values`` are others than its own.
        """
        values = self.values if values is None else values
        half = self.uses_half and means.is_cuda
        box = (self.center, self.half_size)
        inputs = encode(means.detach(), time, self.bands, box, self.reserved_columns, half, self.raw)
        return perceptron(inputs, values, self.shapes, self.skip, self.outputs, len(means))


def in_single_precision(model: nn.Module) -> nn.Module:
    """The same model, changed in place so that its trunks are evaluated in single precision."""
    for module in model.modules():
        if isinstance(module, Trunk):
            module.uses_half = False
    return model
