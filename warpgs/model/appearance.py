"""The appearance network of the static Gaussians (paper Eq. 8)."""

import dataclasses

from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig

from .trunk import Trunk


class AppearanceField(nn.Module):
    """MLP_app of paper Eq. 8b: position and time → residuals of SH coefficients and of the opacity's logit."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.changes_opacity = config.appearance_opacity
        self.bases = (config.appearance_degree + 1) ** 2
        depth, width = config.appearance_depth or config.depth, config.appearance_width or config.width
        config = dataclasses.replace(config, depth=depth, width=width)
        self.trunk = Trunk(config, center, half_size, outputs=3 * self.bases + int(self.changes_opacity))

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]
    ) -> tuple[Float[Tensor, "N bases 3"], Float[Tensor, " N"] | None]:
        """Residuals at N positions and one time in [0, 1].

        Returns:
            [N, bases, 3] residuals of the SH coefficients of the lowest degrees, and [N] residuals of the opacities'
            logits, or None if the network does not change opacities.
        """
        residuals = self.trunk(means, time)
        if not self.changes_opacity:
            return residuals.unflatten(1, (self.bases, 3)), None
        return residuals[:, :-1].unflatten(1, (self.bases, 3)).contiguous(), residuals[:, -1].contiguous()
