"""The scene of the paper: static Gaussians whose appearance changes, dynamic ones that move (Eq. 5)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig
from warpgs.fields.mlp import AppearanceField, DeformationField

from .gaussians import Gaussians
from .splats import Splats


class SplitScene(nn.Module):
    """G_s ∪ G_d with their networks (paper Eq. 5).

    Attributes:
        static: Gaussians of fixed geometry; w⁰ of Eq. 8 is their own appearance.
        dynamic: Gaussians in canonical space, of fixed appearance.
        deformation: F_θ of Eq. 10.
        appearance: MLP_app of Eq. 8.
    """

    no_turn: Tensor

    def __init__(
        self,
        static: Gaussians,
        dynamic: Gaussians,
        config: ModelConfig,
        center: Float[Tensor, "3"],
        half_size: Float[Tensor, "3"],
    ) -> None:
        super().__init__()
        self.static = static
        self.dynamic = dynamic
        self.deformation = DeformationField(config, center, half_size)
        self.appearance = AppearanceField(config, center, half_size)
        # On the device from the start: making it in every step would wait for the device.
        self.register_buffer("no_turn", torch.tensor([1.0, 0.0, 0.0, 0.0]), persistent=False)

    @staticmethod
    def empty(num_static: int, num_dynamic: int, config: ModelConfig) -> "SplitScene":
        """A scene of no particular values, to load a checkpoint into."""
        static, dynamic = Gaussians.empty(num_static), Gaussians.empty(num_dynamic)
        return SplitScene(static, dynamic, config, torch.zeros(3), torch.ones(3))

    def splats(
        self,
        time: Float[Tensor, "1"],
        moving: bool = True,
        relit: bool = True,
        sh_degree: int = 3,
        time_noise: Float[Tensor, "1"] | None = None,
    ) -> Splats:
        """The scene at a moment, static Gaussians first.

        Args:
            time: Moment in [0, 1].
            moving: Whether the deformation network moves the dynamic Gaussians (paper Eq. 11).
            relit: Whether the appearance network changes the static ones (paper Eq. 8).
            sh_degree: Highest degree of spherical harmonics in use.
            time_noise: Added to the time that the deformation network sees (Deformable-3DGS, annealed smoothing).
        """
        static, dynamic = self.static, self.dynamic
        sh, logits = static.sh, static.logit_opacities
        if relit and len(static):
            sh_residual, logit_residual = self.appearance(static.means, time)
            sh = torch.cat([sh[:, : sh_residual.shape[1]] + sh_residual, sh[:, sh_residual.shape[1] :]], 1)
            logits = logits + logit_residual
        moves = moving and len(dynamic) > 0
        moment = time if time_noise is None else time + time_noise
        geometry = self._deform(moment) if moves else (dynamic.means, dynamic.quats, dynamic.log_scales)
        means, quats, log_scales = geometry
        is_dynamic = torch.arange(len(static) + len(dynamic), device=means.device) >= len(static)
        return Splats(
            means=torch.cat([static.means, means]),
            quats=torch.cat([static.quats, quats]),
            scales=torch.cat([static.log_scales, log_scales]).exp(),
            opacities=torch.cat([logits, dynamic.logit_opacities]).sigmoid(),
            sh=torch.cat([sh, dynamic.sh]),
            is_dynamic=is_dynamic,
            sh_degree=sh_degree,
        )

    def static_splats(self, sh_degree: int = 3) -> Splats:
        """The static Gaussians alone, with their own appearance w⁰."""
        static = self.static
        return Splats(static.means, static.quats, static.scales, static.opacities, sh=static.sh, sh_degree=sh_degree)

    def _deform(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Paper Eq. 11: μ + δμ, and A Σ Aᵀ with A = R(δr) · R exp(δs) Rᵀ, where Σ = R S² Rᵀ.

        So A R S = R(δr) R exp(δs) S: the rotation is multiplied from the left, the log-scales are added to.
        """
        dynamic = self.dynamic
        shift, turn, stretch = self.deformation(dynamic.means, time)
        return dynamic.means + shift, multiply(turn + self.no_turn, dynamic.quats), dynamic.log_scales + stretch


def multiply(a: Float[Tensor, "N 4"], b: Float[Tensor, "N 4"]) -> Float[Tensor, "N 4"]:
    """Hamilton product a · b of quaternions (w, x, y, z): first b turns, then a."""
    aw, ax, ay, az = a.unbind(1)
    bw, bx, by, bz = b.unbind(1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        1,
    )
