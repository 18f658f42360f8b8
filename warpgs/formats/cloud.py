"""The Gaussians of a scene at one time as plain arrays, in the form in which files store them."""

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float32, Int64, Integer
from torch import Tensor

from warpgs.model.splats import Splats
from warpgs.ops.sh import num_bases

MIN_SCALE = 1e-20
"""Lower bound of a scale, so that its logarithm is finite; a Gaussian this thin covers far less than a pixel."""

OPACITY_MARGIN = 1e-6
"""Minimum distance of an opacity from 0 and 1, so that its logit is finite."""


@dataclass(frozen=True)
class Cloud:
    """N Gaussians at one time.

    Attributes:
        means: [N, 3] centres [scene units].
        quats: [N, 4] unit quaternions (w, x, y, z).
        log_scales: [N, 3] logarithms of the standard deviations.
        logit_opacities: [N] logits of the opacities.
        sh: [N, 1 | 4 | 9 | 16, 3] spherical harmonics coefficients.
        is_dynamic: [N] whether a Gaussian is dynamic; files do not store it.
        objects: [N] object that a Gaussian belongs to, 0 for none; None if they are not known.
        antialias: Whether opacities compensate for the low-pass filter of the renderer (Mip-Splatting).
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    log_scales: Float32[np.ndarray, "N 3"]
    logit_opacities: Float32[np.ndarray, " N"]
    sh: Float32[np.ndarray, "N bases 3"]
    is_dynamic: Bool[np.ndarray, " N"]
    objects: Int64[np.ndarray, " N"] | None = None
    antialias: bool = False

    @staticmethod
    def of_splats(splats: Splats, antialias: bool = False) -> "Cloud":
        """The cloud of splats that are coloured by spherical harmonics, up to the degree in use.

        Gaussians with values that are not finite are kept; ``finite`` marks the others. Reflections are omitted.
        """
        assert splats.sh is not None
        bases = splats.sh.shape[1] if splats.sh_degree is None else num_bases(splats.sh_degree)
        dynamic = splats.is_dynamic
        opacities = splats.opacities.double().clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)
        return Cloud(
            means=_to_numpy(splats.means),
            quats=_to_numpy(torch.nn.functional.normalize(splats.quats, dim=1)),
            log_scales=_to_numpy(splats.scales.clamp_min(MIN_SCALE).log()),
            logit_opacities=_to_numpy(torch.logit(opacities)),
            sh=_to_numpy(splats.sh[:, :bases]),
            is_dynamic=np.zeros(len(splats.means), bool) if dynamic is None else dynamic.cpu().numpy(),
            objects=None if splats.objects is None else splats.objects.cpu().numpy(),
            antialias=antialias,
        )

    def splats(self, device: torch.device | str = "cpu") -> Splats:
        """The cloud as input of the renderer."""

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
        """Whether all values of a Gaussian are finite; the renderer skips the others."""
        parts = (self.means, self.quats, self.log_scales, self.logit_opacities[:, None])
        return np.logical_and.reduce([*(np.isfinite(part).all(1) for part in parts), np.isfinite(self.sh).all((1, 2))])

    def select(self, rows: Integer[np.ndarray, " M"] | Bool[np.ndarray, " N"]) -> "Cloud":
        """The Gaussians of some rows, in the order of the rows."""
        objects = None if self.objects is None else self.objects[rows]
        return self.replaced(**{name: getattr(self, name)[rows] for name in ARRAYS}, objects=objects)

    def replaced(self, **arrays: Any) -> "Cloud":
        """The cloud with other arrays."""
        return dataclasses.replace(self, **arrays)


ARRAYS = tuple(field.name for field in dataclasses.fields(Cloud) if field.name not in ("objects", "antialias"))
"""Arrays that every cloud has."""


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), in the precision of ``logits``."""
    return 1.0 / (1.0 + np.exp(-logits))


def logit(opacities: np.ndarray) -> np.ndarray:
    """log(p / (1 - p)) of opacities, which are first clipped to ``OPACITY_MARGIN`` from 0 and 1."""
    opacities = np.clip(opacities, OPACITY_MARGIN, 1 - OPACITY_MARGIN)
    return np.log(opacities / (1 - opacities))


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Normalised quaternions; a zero quaternion, which is not a rotation, becomes NaN."""
    with np.errstate(invalid="ignore", over="ignore"):
        return (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32)


def _to_numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().float().cpu().contiguous().numpy()
