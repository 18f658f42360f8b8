"""Covariances of Gaussians from quaternions and scales (kernels/covariance.py)."""

from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import covariance as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.tape import OpContext, differentiable, launch_with_generated_adjoint


def covariance(quats: Float[Tensor, "N 4"], scales: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3 3"]:
    """Σ = R diag(s)² Rᵀ, differentiable in both (3DGS, Eq. 6).

    Args:
        quats: [N, 4] as (w, x, y, z), of any length; a zero quaternion gives a zero covariance.
        scales: [N, 3] standard deviations along the Gaussian's own axes.

    Returns:
        [N, 3, 3] symmetric covariances.

    Raises:
        ValueError: On a wrong shape, dtype or device, or a tensor that is not contiguous.
    """
    sizes: dict[str, int] = {}
    check_tensor("quats", quats, ("N", 4), sizes)
    check_tensor("scales", scales, ("N", 3), sizes)
    check_same_device({"quats": quats, "scales": scales})

    def op(ctx: OpContext, quats: Tensor, scales: Tensor) -> tuple[Tensor, ...]:
        covariances = ctx.zeros(quats.shape[0], 3, 3)
        launch_with_generated_adjoint(ctx, kernels.covariance, quats.shape[0], [quats, scales], [covariances])
        return (covariances,)

    return differentiable(op, quats, scales)[0]
