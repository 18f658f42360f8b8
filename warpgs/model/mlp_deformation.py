"""The deformation network of the paper (Eq. 10)."""

from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig

from .trunk import Trunk


class MlpDeformation(nn.Module):
    """F_θ of paper Eq. 10: canonical position and time → offsets of position, rotation and scale."""

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.trunk = Trunk(config, center, half_size, outputs=(10,))

    def forward(self, means: Float[Tensor, "N 3"], time: Float[Tensor, "1"]) -> Float[Tensor, "N 10"]:
        """Offsets; see ``fields.FIELDS``. No gradient flows to ``means``, as in Deformable-3DGS."""
        (offsets,) = self.trunk(means, time)
        return offsets
