"""Gaussians of one moment as plain arrays: what the files of other programs hold."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Integer
from torch import Tensor

from warpgs.model.splats import Splats

MIN_SCALE = 1e-20
"""Keeps logarithms of scales finite; such a Gaussian is far thinner than any pixel."""

OPACITY_MARGIN = 1e-6
"""Keeps logits finite: an opacity is at least this far from 0 and 1."""


@dataclass(frozen=True)
class Cloud:
    """N Gaussians of one moment.

    Attributes:
        means: [N, 3] centres [scene units].
        quats: [N, 4] rotations (w, x, y, z) of length 1.
        log_scales: [N, 3] logarithms of the standard deviations.
        logit_opacities: [N] logits of the opacities.
        sh: [N, 1 | 4 | 9 | 16, 3] spherical harmonics coefficients.
        is_dynamic: [N] branch; files do not keep it.
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    log_scales: Float32[np.ndarray, "N 3"]
    logit_opacities: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N bases 3"]
    is_dynamic: Bool[np.ndarray, " N"]

    @staticmethod
    def of_splats(splats: Splats) -> "Cloud":
        """The cloud of splats that are coloured by spherical harmonics, of the degree that they use.

        Splats with a value that is not finite are kept as they are: ``finite`` tells them.
        """
        assert splats.sh is not None
        degree = splats.sh_degree
        bases = splats.sh.shape[1] if degree is None else (degree + 1) ** 2
        dynamic = splats.is_dynamic
        opacities = splats.opacities.double().clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
        return Cloud(
            means=_plain(splats.means),
            quats=_plain(torch.nn.functional.normalize(splats.quats, dim=1)),
            log_scales=_plain(splats.scales.clamp_min(MIN_SCALE).log()),
            logit_opacities=_plain(torch.logit(opacities)),
            sh=_plain(splats.sh[:, :bases]),
            is_dynamic=np.zeros(len(splats.means), bool) if dynamic is None else dynamic.cpu().numpy(),
        )

    def splats(self, device: torch.device | str = "cpu") -> Splats:
        """The cloud as the renderer wants it."""

        def tensor(values: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device)

        return Splats(
            means=tensor(self.means),
            quats=tensor(self.quats),
            scales=tensor(self.log_scales).exp(),
            opacities=tensor(self.logit_opacities).sigmoid(),
            sh=tensor(self.sh),
            is_dynamic=tensor(self.is_dynamic),
        )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def finite(self) -> Bool[np.ndarray, " N"]:
        """Which Gaussians have no value that is infinite or NaN; the renderer draws no other."""
        parts = (self.means, self.quats, self.log_scales, self.logit_opacities[:, None])
        return np.logical_and.reduce([*(np.isfinite(part).all(1) for part in parts), np.isfinite(self.sh).all((1, 2))])

    def select(self, rows: Integer[np.ndarray, " M"] | Bool[np.ndarray, " N"]) -> "Cloud":
        """The Gaussians of some rows, in their order."""
        return Cloud(**{field.name: getattr(self, field.name)[rows] for field in dataclasses.fields(self)})


def _plain(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().contiguous().numpy()
