"""The appearance network of the static Gaussians (paper Eq. 8)."""

import dataclasses

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from warpgs.config import ModelConfig

from .trunk import Trunk


class AppearanceField(nn.Module):
    """MLP_app of paper Eq. 8b: position and time → residuals of SH coefficients and of the opacity's logit."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.bases = (config.appearance_degree + 1) ** 2
        depth, width = config.appearance_depth or config.depth, config.appearance_width or config.width
        config = dataclasses.replace(config, depth=depth, width=width)
        outputs = (3 * self.bases, 1) if config.appearance_opacity else (3 * self.bases,)
        self.trunk = Trunk(config, center, half_size, outputs)

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"], is_fixed: Bool[Tensor, " N"] | None = None
    ) -> tuple[Float[Tensor, "N bases 3"], Float[Tensor, " N"] | None]:
        """Residuals at N positions and one time in [0, 1]; no gradient flows from those that are fixed.

        Returns:
            [N, bases, 3] residuals of the SH coefficients of the lowest degrees, and [N] residuals of the opacities'
            logits, or None if the network does not change opacities.
        """
        residuals, *logits = self.trunk(means, time)
        if is_fixed is not None:
            residuals, *logits = (torch.where(is_fixed[:, None], r.detach(), r) for r in (residuals, *logits))
        return residuals.unflatten(1, (self.bases, 3)), logits[0][:, 0] if logits else None
