"""The numbers of metrics.json, as evaluation, reports and sweeps show them.

To add one, write a ``Metric`` in a new file, add a line to ``METRICS`` and a test. ``psnr_static`` and the like are
over that region of the view's mask, ``masked_psnr`` and the like over the co-visible pixels of iPhone captures, as in
DyCheck.
"""

from collections.abc import Callable
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from .image_quality import MIN_MS_SSIM_SIDE, masked_ssim, ms_ssim, psnr, ssim
from .metric import Comparison, Metric
from .scene_metrics import flicker, playback_rate

Function = Callable[[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"], Bool[Tensor, "H W"]], float | Tensor]
"""A metric of image and truth within a region."""


def within(
    function: Function, region: Literal["static", "dynamic", "covisible"]
) -> Callable[[Comparison], float | None]:
    """The function within a region of a view; None where the view has no pixel of it."""

    def measure(view: Comparison) -> float | None:
        pixels: Tensor | None = getattr(view, region)
        if pixels is not None and view.shown is not None:
            pixels = pixels & view.shown
        if pixels is None or not bool(pixels.any()):
            return None
        return float(function(view.image, view.truth, pixels))

    return measure


def _lpips(view: Comparison) -> float | None:
    return None if view.lpips is None else float(view.lpips(view.image, view.truth))


def _masked_lpips(view: Comparison) -> float | None:
    return None if view.lpips is None else within(view.lpips.masked, "covisible")(view)


METRICS: dict[str, Metric] = {
    "psnr": Metric("PSNR", lambda view: psnr(view.image, view.truth, view.shown), unit="dB", digits=2, better="higher"),
    "ssim": Metric("SSIM", lambda view: ssim(view.image, view.truth, view.shown), better="higher"),
    "ms_ssim": Metric(
        "MS-SSIM",
        lambda view: ms_ssim(view.image, view.truth),
        better="higher",
        reason=f"a side is below {MIN_MS_SSIM_SIDE} px",
    ),
    "lpips": Metric(
        "LPIPS", _lpips, better="lower", reason="no weights: give their folder with --lpips or in WARPGS_LPIPS"
    ),
    "psnr_static": Metric("static PSNR", within(psnr, "static"), unit="dB", digits=2, better="higher", line="scene"),
    "psnr_dynamic": Metric("dynamic PSNR", within(psnr, "dynamic"), unit="dB", digits=2, better="higher", line="scene"),
    "ssim_static": Metric("static SSIM", within(ssim, "static"), better="higher", line="", is_column=False),
    "ssim_dynamic": Metric("dynamic SSIM", within(ssim, "dynamic"), better="higher", line="", is_column=False),
    "masked_psnr": Metric("mPSNR", within(psnr, "covisible"), unit="dB", digits=2, better="higher", line="co-visible"),
    "masked_ssim": Metric("mSSIM", within(masked_ssim, "covisible"), better="higher", line="co-visible"),
    "masked_lpips": Metric("mLPIPS", _masked_lpips, better="lower", line="co-visible"),
    "flicker": Metric("flicker", of_scene=flicker, digits=5, better="lower", line="scene", is_column=False),
    "jitter": Metric("jitter", digits=3, better="lower", line="scene", is_column=False),
    "train_seconds": Metric("time", unit="min", scale=60.0, digits=1, better="lower", line=""),
    "peak_bytes": Metric("memory", unit="GB", scale=1e9, digits=2, better="lower", line=""),
    "num_gaussians": Metric("Gaussians", digits=0, line=""),
    "num_static": Metric("static Gaussians", digits=0, line="", is_column=False),
    "num_dynamic": Metric("dynamic Gaussians", digits=0, line="", is_column=False),
    "fps": Metric("FPS", of_scene=playback_rate, digits=1, better="higher", line="scene"),
    "mask_trial_psnr_with": Metric("PSNR of a trial with the masks", unit="dB", digits=2, line="", is_column=False),
    "mask_trial_psnr_without": Metric(
        "PSNR of a trial without the masks", unit="dB", digits=2, line="", is_column=False
    ),
}
"""Metrics by their name in metrics.json, in the order in which they are shown; ``num_gaussians`` is the sum of both."""
