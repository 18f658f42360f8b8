"""Density control by absolute gradients: AbsGS (Ye et al. 2024), gsplat's ``absgrad``."""

from dataclasses import replace

from warpgs.config import RenderSettings

from .gradient import GradientStrategy


class AbsoluteGradientStrategy(GradientStrategy):
    """The rule of 3DGS on sums of absolute values.

    Gradients of single pixels that point away from each other cancel in the gradient of 3DGS: a Gaussian that blurs
    fine texture stays as it is.
    """

    def settings(self, settings: RenderSettings) -> RenderSettings:
        """With absolute gradients of positions on screen."""
        return replace(settings, absgrad=True)
