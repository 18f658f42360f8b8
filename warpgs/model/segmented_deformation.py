"""One deformation network for each segment of time."""

import copy

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from warpgs.config import ModelConfig

from .mlp_deformation import MlpDeformation
from .segments import SegmentRows, active, local_time


class SegmentedDeformation(nn.Module):
    """K networks ``MlpDeformation``, of which a device chooses those that are evaluated (``segments``).

    Args:
        config: Sizes of each network; ``segments`` is K > 1.
        center, half_size: [3] box of the scene.

    Attributes:
        network: The networks: the weights and biases of its trunk are [K, values].
        is_complete: Whether Gaussians whose segment is not active are deformed, too, as at its nearest end. Programs
            that interpolate between key times need that.
    """

    is_complete = False

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        assert config.segments is not None
        self.num = config.segments
        self.network = MlpDeformation(config, center, half_size)
        others = [MlpDeformation(config, center, half_size) for _ in range(self.num - 1)]
        self.network.trunk.values = nn.Parameter(
            torch.stack([network.trunk.values.data for network in (self.network, *others)])
        )

    def forward(
        self, means: Float[Tensor, "N 3"], time: Float[Tensor, " T"], now: Float[Tensor, "1"], rows: SegmentRows
    ) -> Float[Tensor, "N 10"]:
        """Offsets at one time or at N, all around ``now``; 0 where no segment is active, unless ``is_complete``."""
        means, found = means.detach(), means.new_zeros(len(means), 10)
        chosen = torch.arange(self.num, device=now.device) if self.is_complete else active(now, self.num)
        for segment in chosen.split(1):
            own, counts = (values.index_select(0, segment)[0] for values in rows)
            at = time if len(time) == 1 else time.index_select(0, own)
            offsets = self.at(segment, means.index_select(0, own), at)
            found = found.index_add(0, own, offsets * counts[:, None])
        return found

    def at(
        self, segment: Int64[Tensor, "1"], means: Float[Tensor, "N 3"], time: Float[Tensor, " T"]
    ) -> Float[Tensor, "N 10"]:
        """Offsets in a segment, at one time of the capture or at N."""
        trunk = self.network.trunk
        values = trunk.values.index_select(0, segment)[0]
        local = local_time(time, segment, self.num)
        (offsets,) = trunk(means, local.clamp(0.0, 1.0) if self.is_complete else local, values)
        return offsets * self.network.units

    def of(self, segment: int) -> MlpDeformation:
        """A copy of the network of a segment, which gets the time in its window, from 0 to 1."""
        network = copy.deepcopy(self.network)
        network.trunk.values = nn.Parameter(self.network.trunk.values.data[segment].clone())
        return network

    def replace(self, segment: int, network: MlpDeformation) -> None:
        """Gives a segment the weights and biases of another network."""
        self.network.trunk.values.data[segment] = network.trunk.values.data
