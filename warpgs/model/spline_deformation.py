"""Deformation along paths: each object moves along a spline of its own, and a network adds what is left."""

from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from warpgs.config import ModelConfig

from .mlp_deformation import MlpDeformation

MIN_POINTS = 4
"""Number of control points of a spline of one piece."""


class SplineDeformation(nn.Module):
    """The movement of the nearest home, a uniform cubic B-spline over time, plus the offsets of ``MlpDeformation``.

    For small objects that move far between frames, which a network alone finds neither nor follows exactly.

    Args:
        config: Sizes of the network; there is one spline, until ``resize`` or a state that is loaded gives others.
        center, half_size: [3] box of the scene.

    Attributes:
        homes: [K, 3] canonical positions of the objects [scene units].
        paths: [K, C, 3] control points of their positions over time, from 0 to 1, in the units of the network's offsets
            of positions.
    """

    homes: Tensor

    def __init__(self, config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> None:
        super().__init__()
        self.network = MlpDeformation(config, center, half_size)
        self.register_buffer("homes", center.new_zeros(1, 3))
        self.paths = nn.Parameter(center.new_zeros(1, MIN_POINTS, 3))

    def resize(self, num_paths: int, num_points: int) -> None:
        """Replaces homes and paths by zeros for other numbers of objects, and of control points of each."""
        self.homes = self.homes.new_zeros(num_paths, 3)
        self.paths = nn.Parameter(self.paths.new_zeros(num_paths, num_points, 3))

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *args: Any) -> None:
        paths = state_dict.get(f"{prefix}paths")
        if paths is not None and paths.ndim == 3 and paths.shape[1] >= MIN_POINTS and paths.shape[2] == 3:
            self.resize(*paths.shape[:2])
        super()._load_from_state_dict(state_dict, prefix, *args)

    def forward(self, means: Float[Tensor, "N 3"], time: Float[Tensor, " T"]) -> Float[Tensor, "N 10"]:
        """Offsets at one time or at N; see ``fields.FIELDS``. No gradient flows to ``means``."""
        nearest = torch.cdist(means.detach(), self.homes).argmin(1)
        # The backward pass of indexing by brackets is 20 times as slow where few rows are chosen often.
        homes = self.homes.index_select(0, nearest)
        positions = self.positions(time).index_select(0, nearest) if len(time) == 1 else self.positions(time, nearest)
        return self.network(means, time) + nn.functional.pad(positions - homes, (0, 7))

    def positions(self, time: Float[Tensor, " T"], objects: Int64[Tensor, " M"] | None = None) -> Float[Tensor, "M 3"]:
        """Positions of objects on their paths, by default of all of them, at one time or at M.

        Outside [0, 1], the first or last piece of the splines goes on.
        """
        objects = torch.arange(len(self.paths), device=time.device) if objects is None else objects
        pieces = self.paths.shape[1] - 3
        first = (time * pieces).floor().clamp(0, pieces - 1)
        f = time * pieces - first
        weights = torch.stack([(1 - f) ** 3, 3 * f**3 - 6 * f**2 + 4, -3 * f**3 + 3 * f**2 + 3 * f + 1, f**3], 1) / 6
        chosen = (objects * self.paths.shape[1] + first.long())[:, None] + torch.arange(4, device=time.device)
        points = self.paths.flatten(0, 1).index_select(0, chosen.flatten()).view(-1, 4, 3)
        return (points * weights[:, :, None]).sum(1) * self.network.units[:3]
