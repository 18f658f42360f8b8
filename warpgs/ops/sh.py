"""View-dependent colour from spherical harmonics (kernels/sh.py)."""

from collections.abc import Sequence

import torch
from torch import Tensor

from warpgs.kernels import sh as kernels
from warpgs.runtime.checks import check_tensor
from warpgs.runtime.launch import launch

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


def sh_fwd(means: Tensor, sh: Tensor, viewmat: Tensor, degree: int) -> Tensor:
    """Colours of Gaussians seen from a camera, max(0, ½ + Σ Y_k(direction) sh_k).

    Args:
        means: [N, 3] centres in the world.
        sh: [N, bases, 3] coefficients with 1, 4, 9 or 16 bases (degree 0 to 3).
        viewmat: [4, 4] rigid world-to-camera transform.
        degree: Highest degree to use.

    Returns:
        [N, 3] RGB, not negative; NaN where the sum is not finite, without meaning for Gaussians that projection culls.
    """
    colors = torch.empty_like(means)
    launch(kernels.sh_fwd, means.shape[0], means, sh, viewmat, num_bases(degree), _in_fours(sh), colors)
    return colors


def sh_bwd(
    inputs: Sequence[Tensor], degree: int, colors: Tensor, v_colors: Tensor, v_means: Tensor
) -> tuple[Tensor, Tensor | None]:
    """Gradients of sh and, if it requires one, viewmat; that of the means is added to ``v_means``.

    Args:
        inputs: means, sh and viewmat, as in ``sh_fwd``.
        degree: As in ``sh_fwd``.
        colors: Its result.
        v_colors: [N, 3] gradient of the colours.
        v_means: [N, 3] gradient of the means through everything else.
    """
    means, sh, viewmat = inputs
    v_sh, v_viewpoints = torch.empty_like(sh), torch.empty_like(means) if viewmat.requires_grad else None
    outputs = (v_means, v_sh, v_viewpoints)
    launch(kernels.sh_bwd, means.shape[0], *inputs, num_bases(degree), _in_fours(sh), colors, v_colors, *outputs)
    if v_viewpoints is None:
        return v_sh, None
    # The viewpoint is -Wᵀ translation of the viewing matrix [W, translation].
    v_viewpoint = v_viewpoints.sum(0)
    # If it is not finite, all Gaussians are culled and v_viewpoint is 0, but 0 · NaN would be NaN.
    v_viewmat, finite = torch.zeros_like(viewmat), viewmat.nan_to_num(0.0, 0.0, 0.0)
    v_viewmat[:3, :3] = -torch.outer(finite[:3, 3], v_viewpoint)
    v_viewmat[:3, 3] = -finite[:3, :3] @ v_viewpoint
    return v_sh, v_viewmat


def _in_fours(sh: Tensor) -> int:
    """Whether kernels access four bases at once: on CUDA, if those of all Gaussians begin at multiples of 16 bytes."""
    return int(sh.is_cuda and sh.shape[1] % 4 == 0 and sh.data_ptr() % 16 == 0)
