"""The scene of the paper: static Gaussians whose appearance changes, dynamic ones that move (Eq. 5)."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig
from warpgs.ops.activation import Changes, activate, join_sh
from warpgs.runtime.streams import join, on_side_stream

from .fields import AppearanceField, DeformationField
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

    @staticmethod
    def empty(num_static: int, num_dynamic: int, config: ModelConfig) -> "SplitScene":
        """A scene of no particular values, to load a checkpoint into."""
        static, dynamic = (Gaussians.empty(num, config.sh_degree) for num in (num_static, num_dynamic))
        return SplitScene(static, dynamic, config, torch.zeros(3), torch.ones(3))

    def splats(
        self,
        time: Float[Tensor, "1"],
        moving: bool = True,
        relit: bool = True,
        sh_degree: int | None = None,
        time_noise: Float[Tensor, "1"] | None = None,
        late_sh: bool = False,
    ) -> Splats:
        """The scene at a moment, static Gaussians first.

        Args:
            time: Moment in [0, 1].
            moving: Whether the deformation network moves the dynamic Gaussians (paper Eq. 11).
            relit: Whether the appearance network changes the static ones (paper Eq. 8).
            sh_degree: Highest degree of spherical harmonics in use; all that there are if None.
            time_noise: Added to the time that the deformation network sees (Deformable-3DGS, annealed smoothing).
            late_sh: Whether ``sh`` may still be on its way on ``sh_stream``, for ``render`` to wait for; ``time`` must
                stay alive until then.
        """
        static, dynamic, device = self.static, self.dynamic, self.static.means.device
        residuals = logit_residuals = None
        with on_side_stream(device) as stream:
            if relit and len(static):
                residuals, logit_residuals = self.appearance(static.means, time)
            sh = join_sh(static.raw(), dynamic.raw(), residuals)
        offsets = None
        if moving and len(dynamic):
            offsets = self.deformation(dynamic.means, time if time_noise is None else time + time_noise)
        if not late_sh or logit_residuals is not None:
            join(stream)
            stream = None
        relit_by, moved_by = Changes(logit_residuals=logit_residuals), Changes(offsets)
        geometry = activate(static.raw(), dynamic.raw(), relit_by, moved_by)
        is_dynamic = torch.arange(len(static) + len(dynamic), device=device) >= len(static)
        return Splats(**geometry._asdict(), sh=sh, is_dynamic=is_dynamic, sh_degree=sh_degree, sh_stream=stream)

    def static_splats(self, sh_degree: int | None = None) -> Splats:
        """The static Gaussians alone, with their own appearance w⁰."""
        static = self.static
        return Splats(static.means, static.quats, static.scales, static.opacities, sh=static.sh, sh_degree=sh_degree)
