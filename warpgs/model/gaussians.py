"""Gaussians as they are optimized."""

import copy

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from warpgs.ops.activation import Raw
from warpgs.ops.sh import MAX_DEGREE

SH_C0 = 0.28209479177387814
"""Value of the spherical harmonic of degree 0: colour = 0.5 + SH_C0 · coefficient."""

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest")
"""Names of the parameters of ``Gaussians``."""


class Gaussians(nn.Module):
    """N Gaussians as unconstrained parameters, activated where they are used.

    Attributes:
        means: [N, 3] positions.
        quats: [N, 4] rotations (w, x, y, z), not normalized.
        log_scales: [N, 3] logarithms of the standard deviations.
        logit_opacities: [N] logits of the opacities.
        sh_dc: [N, 1, 3] SH coefficients of degree 0.
        sh_rest: [N, 0 | 3 | 8 | 15, 3] SH coefficients of degrees 1 to 0 | 1 | 2 | 3.
        reflectances: [N, F] how they reflect light (``reflections``); None unless they do.
        segments: [N] the segment of time in which they are there (``model.segments``); None if there is one alone.
    """

    reflectances: nn.Parameter | None
    segments: Tensor | None

    def __init__(
        self,
        means: Float[Tensor, "N 3"],
        quats: Float[Tensor, "N 4"],
        log_scales: Float[Tensor, "N 3"],
        logit_opacities: Float[Tensor, " N"],
        sh_dc: Float[Tensor, "N 1 3"],
        sh_rest: Float[Tensor, "N rest 3"],
    ) -> None:
        super().__init__()
        self.means = nn.Parameter(means)
        self.quats = nn.Parameter(quats)
        self.log_scales = nn.Parameter(log_scales)
        self.logit_opacities = nn.Parameter(logit_opacities)
        self.sh_dc = nn.Parameter(sh_dc)
        self.sh_rest = nn.Parameter(sh_rest)
        self.register_parameter("reflectances", None)
        self.register_buffer("segments", None)

    @staticmethod
    def from_points(
        points: Float[Tensor, "N 3"],
        colors: Float[Tensor, "N 3"],
        scales: Float[Tensor, " N"],
        opacity: float,
        sh_degree: int = MAX_DEGREE,
    ) -> "Gaussians":
        """Isotropic Gaussians at points, with standard deviations ``scales``, colours in [0, 1] and one opacity."""
        N = points.shape[0]
        quats = points.new_zeros(N, 4)
        quats[:, 0] = 1.0
        return Gaussians(
            points.clone(),
            quats,
            scales.log()[:, None].repeat(1, 3),
            torch.logit(torch.full_like(scales, opacity)),
            ((colors - 0.5) / SH_C0)[:, None, :],
            points.new_zeros(N, (sh_degree + 1) ** 2 - 1, 3),
        )

    @staticmethod
    def empty(num: int, sh_degree: int = MAX_DEGREE) -> "Gaussians":
        """``num`` Gaussians with arbitrary values, to load a state into."""
        # Only calls that make new tensors: on torch's "meta" device others import torch's compiler, a second and 90 MB.
        rest = (sh_degree + 1) ** 2 - 1
        widths = ((3,), (4,), (3,), (), (1, 3), (rest, 3))
        return Gaussians(*(torch.zeros(num, *width, dtype=torch.float32) for width in widths))

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def opacities(self) -> Float[Tensor, " N"]:
        return self.logit_opacities.sigmoid()

    @property
    def scales(self) -> Float[Tensor, "N 3"]:
        return self.log_scales.exp()

    @property
    def sh(self) -> Float[Tensor, "N bases 3"]:
        return torch.cat([self.sh_dc, self.sh_rest], 1)

    def raw(self) -> Raw:
        """The parameters as arguments of ``ops.activation``."""
        return Raw(self.means, self.quats, self.log_scales, self.logit_opacities, self.sh_dc, self.sh_rest)

    def select(self, kept: Bool[Tensor, " N"]) -> "Gaussians":
        """Copies of the Gaussians to keep, in their order."""
        selected = copy.copy(self)
        selected._parameters = {
            name: None if p is None else nn.Parameter(p.detach()[kept], p.requires_grad)
            for name, p in self._parameters.items()
        }
        selected._buffers = {"segments": None if self.segments is None else self.segments[kept]}
        return selected

    @torch.no_grad()
    def gather(self, parents: Int64[Tensor, " M"]) -> None:
        """Replaces the Gaussians by copies of ``parents``, which are [M] indices.

        Gradients are dropped. ``training.density.operations.gather`` also updates the optimizer's state.
        """
        for parameter in self.parameters():
            parameter.data = parameter.data[parents]
            parameter.grad = None
        if self.segments is not None:
            self.segments = self.segments[parents]

    @torch.no_grad()
    def append(self, added: "Gaussians") -> None:
        """Appends Gaussians of the same degree of spherical harmonics, from any device; reflectances they lack are 0.

        Gradients are dropped. ``training.optimizer.append`` also updates the optimizer's state.
        """
        for name, parameter in self.named_parameters():
            new = getattr(added, name)
            new = parameter.new_zeros(len(added), *parameter.shape[1:]) if new is None else new.to(parameter.device)
            parameter.data = torch.cat([parameter.data, new])
            parameter.grad = None
        if self.segments is not None:
            assert added.segments is not None
            self.segments = torch.cat([self.segments, added.segments.to(self.segments.device)])
