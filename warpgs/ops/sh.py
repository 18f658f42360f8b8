"""View-dependent colour from spherical harmonics (kernels/sh.py)."""

import torch
from jaxtyping import Float, Int32
from torch import Tensor

from warpgs.kernels import sh as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import OpContext, differentiable

MAX_DEGREE = 3
"""Highest degree of spherical harmonics that the kernels support."""


def num_bases(degree: int) -> int:
    """Number of basis functions of spherical harmonics up to a degree."""
    return (degree + 1) ** 2


def degree_of(num: int) -> int:
    """Highest degree of ``num`` basis functions, the inverse of ``num_bases``."""
    return round(num**0.5) - 1


def check_coefficients(sizes: dict[str, int], sh: Tensor, degree: int | None) -> int:
    """Raises ``ValueError`` unless ``sh`` [N, bases, 3] has at least ``degree``; returns the degree to use."""
    check_tensor("sh", sh, ("N", "bases", 3), sizes)
    available = degree_of(sh.shape[1])
    if num_bases(available) != sh.shape[1] or not 0 <= available <= MAX_DEGREE:
        raise ValueError(f"sh must have shape [N, bases, 3] with 1, 4, 9 or 16 bases, got {list(sh.shape)}")
    if degree is None:
        return available
    if not isinstance(degree, int) or not 0 <= degree <= available:
        raise ValueError(f"sh_degree must be an int between 0 and {available}, the degree of sh, got {degree!r}")
    return degree


def record_sh(ctx: OpContext, means: Tensor, sh: Tensor, viewmat: Tensor, radii: Tensor, degree: int) -> Tensor:
    """``spherical_harmonics`` as a part of a larger op, without checks; Gaussians of radius 0 are black."""
    N = means.shape[0]
    colors = ctx.empty(N, 3)
    ctx.launch(kernels.sh_fwd, N, means, sh, viewmat, radii, num_bases(degree), colors)

    def backward(ctx: OpContext) -> None:
        v_colors = ctx.gradient(colors)
        if v_colors is None:
            return
        v_means, v_sh = ctx.empty(*means.shape), ctx.empty(*sh.shape)
        ctx.launch(kernels.sh_bwd, N, means, sh, viewmat, radii, num_bases(degree), colors, v_colors, v_means, v_sh)
        ctx.add_gradient(means, v_means)
        ctx.add_gradient(sh, v_sh)
        if ctx.needs_gradient(viewmat):
            _add_viewmat_gradient(ctx, viewmat, -v_means.sum(0))

    ctx.on_backward(backward, reads=(colors,))
    return colors


def _add_viewmat_gradient(ctx: OpContext, viewmat: Tensor, v_viewpoint: Float[Tensor, "3"]) -> None:
    """Adds what the viewpoint -Wᵀ translation passes on to the viewing matrix [W, translation]."""
    v_viewmat, finite = torch.zeros_like(viewmat), viewmat.nan_to_num(0.0, 0.0, 0.0)  # otherwise all are culled, v = 0
    v_viewmat[:3, :3] = -torch.outer(finite[:3, 3], v_viewpoint)
    v_viewmat[:3, 3] = -finite[:3, :3] @ v_viewpoint
    ctx.add_gradient(viewmat, v_viewmat)


def spherical_harmonics(
    means: Float[Tensor, "N 3"],
    sh: Float[Tensor, "N bases 3"],
    viewmat: Float[Tensor, "4 4"],
    *,
    degree: int | None = None,
    radii: Int32[Tensor, "N 2"] | None = None,
) -> Float[Tensor, "N 3"]:
    """Colours of Gaussians seen from a camera, max(0, ½ + Σ Y_k(direction) sh_k).

    Differentiable in means, sh and viewmat.

    Args:
        means: [N, 3] centres in the world.
        sh: [N, bases, 3] coefficients with 1, 4, 9 or 16 bases (degree 0 to 3).
        viewmat: [4, 4] rigid world-to-camera transform.
        degree: Highest degree to use; that of ``sh`` by default.
        radii: [N, 2] of a ``Projection``; culled Gaussians (radius 0) are black.

    Returns:
        [N, 3] RGB, not negative.

    Raises:
        ValueError: On a wrong shape, dtype or device.
    """
    sizes: dict[str, int] = {}
    check_tensor("means", means, ("N", 3), sizes)
    used = check_coefficients(sizes, sh, degree)
    check_tensor("viewmat", viewmat, (4, 4), sizes)
    if radii is None:
        radii = torch.ones(means.shape[0], 2, dtype=torch.int32, device=means.device)
    check_tensor("radii", radii, ("N", 2), sizes, (torch.int32,))
    check_same_device({"means": means, "sh": sh, "viewmat": viewmat, "radii": radii})

    def op(ctx: OpContext, means: Tensor, sh: Tensor, viewmat: Tensor, radii: Tensor) -> tuple[Tensor, ...]:
        return (record_sh(ctx, means, sh, viewmat, radii, used),)

    return differentiable(op, means, sh, viewmat, radii)[0]
