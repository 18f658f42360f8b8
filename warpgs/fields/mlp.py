"""The trunk that both networks share, and the two networks: deformation (Eq. 10) and appearance (Eq. 8)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig

from .encoding import encode, encoded_size


class Trunk(nn.Module):
    """[γ(μ), γ(t)] → features: ``depth`` ReLU layers of ``width`` units, the encoding entering again after ``skip``.

    Attributes:
        center, half_size: [3] box of the scene; positions are normalised by it to about [-1, 1].
    """

    center: Tensor
    half_size: Tensor

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.position_bands, self.time_bands, self.skip = config.position_bands, config.time_bands, config.skip
        self.register_buffer("center", center.clone())
        self.register_buffer("half_size", half_size.clone())
        encoded = encoded_size(3, config.position_bands) + encoded_size(1, config.time_bands)
        sizes = [encoded] + [config.width + (encoded if k == config.skip else 0) for k in range(1, config.depth)]
        self.layers = nn.ModuleList([nn.Linear(size, config.width) for size in sizes])

    def forward(self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]) -> Float[Tensor, "N width"]:
        position = encode((means - self.center) / self.half_size, self.position_bands)
        moment = encode(time[:, None], self.time_bands).expand(means.shape[0], -1)
        encoding = torch.cat([position, moment], 1)
        features = encoding
        for index, layer in enumerate(self.layers):
            if index == self.skip:
                features = torch.cat([features, encoding], 1)
            features = layer(features).relu()
        return features


def _zero_head(width: int, outputs: int) -> nn.Linear:
    """A last layer that starts at zero, so that a network starts as "no change"."""
    head = nn.Linear(width, outputs)
    nn.init.zeros_(head.weight)
    nn.init.zeros_(head.bias)
    return head


class DeformationField(nn.Module):
    """F_θ of paper Eq. 10: canonical position and time → offsets of position, rotation and scale."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.trunk = Trunk(config, center, half_size)
        self.head = _zero_head(config.width, 10)

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]
    ) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 4"], Float[Tensor, "N 3"]]:
        """Offsets of [N, 3] positions, [N, 4] quaternions (to be added to the unit rotation) and [N, 3] log-scales.

        No gradient flows back to ``means`` from here, as in Deformable-3DGS.
        """
        offsets = self.head(self.trunk(means.detach(), time))
        return offsets[:, :3], offsets[:, 3:7], offsets[:, 7:]


class AppearanceField(nn.Module):
    """MLP_app of paper Eq. 8b: position and time → residuals of SH coefficients and of the opacity's logit."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.trunk = Trunk(config, center, half_size)
        self.changes_opacity = config.appearance_opacity
        self.head = _zero_head(config.width, 3 * (config.appearance_degree + 1) ** 2 + 1)

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]
    ) -> tuple[Float[Tensor, "N bases 3"], Float[Tensor, " N"]]:
        """Residuals of the coefficients of the lowest degrees, and of the logits of the opacities."""
        residuals = self.head(self.trunk(means.detach(), time))
        logit_residuals = residuals[:, 0] if self.changes_opacity else torch.zeros_like(residuals[:, 0])
        return residuals[:, 1:].unflatten(1, (-1, 3)), logit_residuals
