"""The deformation network of the paper (Eq. 10)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig

from .trunk import Trunk


class MlpDeformation(nn.Module):
    """F_θ of paper Eq. 10: canonical position and time → offsets of position, rotation and scale.

    Attributes:
        units: [10] by which the outputs of the network are multiplied: of positions the length that counts as 1
            (``TrainConfig.offset_unit``) [scene units], which the initial scene sets; 1 of the others.
    """

    units: Tensor

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.trunk = Trunk(config, center, half_size, outputs=(10,))
        self.register_buffer("units", torch.ones(10, dtype=center.dtype, device=center.device))

    def forward(self, means: Float[Tensor, "N 3"], time: Float[Tensor, " T"]) -> Float[Tensor, "N 10"]:
        """Offsets at one time or at N; see ``fields.FIELDS``. No gradient flows to ``means``, as in Deformable-3DGS."""
        (offsets,) = self.trunk(means, time)
        return offsets * self.units
