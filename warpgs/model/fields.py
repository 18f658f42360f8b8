"""The trunk that both networks share, and the two networks: deformation (Eq. 10) and appearance (Eq. 8)."""

from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig
from warpgs.ops.encoding import ALIGNMENT, aligned, encode, encoded_size
from warpgs.ops.mlp import Layer, num_values, perceptron, split


class Trunk(nn.Module):
    """[γ(μ), γ(t)] → outputs: ``depth`` ReLU layers of ``width`` units, the encoding entering again after ``skip``.

    The last layer, the head, starts at zero, so that a network starts as "no change"; the others as ``nn.Linear`` does.

    Attributes:
        center, half_size: [3] box of the scene; positions are normalised by it to about [-1, 1].
        values: Weights and biases of all layers, see ``layers``. Those that the padding of the encoding and of the
            outputs is multiplied by are and stay 0.
    """

    center: Tensor
    half_size: Tensor

    def __init__(
        self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"], outputs: int
    ) -> None:
        super().__init__()
        self.bands = (config.position_bands, config.time_bands)
        self.skip = config.skip if config.skip < config.depth else 0
        self.room = config.width if self.skip else 0
        self.uses_half = config.half and config.width % ALIGNMENT == 0
        self.register_buffer("center", center.clone())
        self.register_buffer("half_size", half_size.clone())
        encoded = encoded_size(*self.bands)
        columns = [encoded] + [config.width + (encoded if k == self.skip else 0) for k in range(1, config.depth)]
        self.sizes = [*((config.width, c) for c in columns), (outputs, config.width)]
        padding = aligned(encoded) - encoded
        self.shapes = [(rows, c + (padding if k in (0, self.skip) else 0)) for k, (rows, c) in enumerate(self.sizes)]
        self.shapes[-1] = (aligned(outputs), config.width)
        self.values = nn.Parameter(center.new_zeros(num_values(self.shapes)))
        for layer, (rows, c) in zip(self.layers(self.values.data)[:-1], self.sizes, strict=False):
            start = nn.Linear(c, rows)
            layer.weight.copy_(start.weight.data)
            layer.bias.copy_(start.bias.data)

    def layers(self, values: Float[Tensor, " values"]) -> list[Layer]:
        """The layers in ``values`` or in its gradient, as views without padding; the last one is the head."""
        layers = split(values, self.shapes)
        return [Layer(weight[:r, :c], bias[:r]) for (weight, bias), (r, c) in zip(layers, self.sizes, strict=True)]

    def forward(self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]) -> Float[Tensor, "N outputs"]:
        """Evaluates the network at N positions and one time. No gradient flows to the positions."""
        half = self.uses_half and means.is_cuda
        inputs = encode(means.detach(), time, self.bands, self.center, self.half_size, self.room, half)
        return perceptron(inputs, self.values, self.shapes, self.skip, self.sizes[-1][0])


class DeformationField(nn.Module):
    """F_θ of paper Eq. 10: canonical position and time → offsets of position, rotation and scale."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.trunk = Trunk(config, center, half_size, outputs=10)

    def forward(self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]) -> Float[Tensor, "N 10"]:
        """Offsets: of positions (3), of quaternions, to be added to the unit rotation (4), of log-scales (3).

        No gradient flows back to ``means`` from here, as in Deformable-3DGS.
        """
        return self.trunk(means, time)


class AppearanceField(nn.Module):
    """MLP_app of paper Eq. 8b: position and time → residuals of SH coefficients and of the opacity's logit."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.changes_opacity = config.appearance_opacity
        self.bases = (config.appearance_degree + 1) ** 2
        self.trunk = Trunk(config, center, half_size, outputs=3 * self.bases + int(self.changes_opacity))

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]
    ) -> tuple[Float[Tensor, "N bases 3"], Float[Tensor, " N"] | None]:
        """Residuals of the coefficients of the lowest degrees, and of the logits of the opacities if they change."""
        residuals = self.trunk(means, time)
        if not self.changes_opacity:
            return residuals.unflatten(1, (self.bases, 3)), None
        return residuals[:, :-1].unflatten(1, (self.bases, 3)).contiguous(), residuals[:, -1].contiguous()
