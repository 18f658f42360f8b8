"""Dropout of Gaussians while they are trained (kernels/dropout.py)."""

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels import dropout as kernels
from warpgs.runtime.checks import check_same_device, check_tensor
from warpgs.runtime.launch import LITTLE_WORK, launch

MAX_SEED = 2**24
"""Seeds are integers below this, which a single-precision number represents exactly."""


def dropout(opacities: Float[Tensor, " N"], seed: Float[Tensor, "1"], fraction: float) -> Float[Tensor, " N"]:
    """Opacities of which a random fraction is 0 and the others are divided by 1 − fraction, at most 1; differentiable.

    Opacities above 1 − fraction have no gradient while they are not omitted, because they are clamped to 1.

    Args:
        opacities: [N] in [0, 1].
        seed: [1] an integer below ``MAX_SEED``, on the device. The same seed omits the same indices on every device.
        fraction: Expected fraction that is omitted, in [0, 1).

    Raises:
        ValueError: On a wrong shape, dtype or device, or a fraction outside [0, 1).
    """
    check_tensor("opacities", opacities, ("N",), {})
    check_tensor("seed", seed, (1,), {})
    check_same_device({"opacities": opacities, "seed": seed})
    if not 0.0 <= fraction < 1.0:
        raise ValueError(f"fraction must be in [0, 1), got {fraction}")
    factors = torch.empty_like(opacities)
    launch(kernels.dropout_factors, len(opacities), seed, fraction, factors, work=LITTLE_WORK)
    return (opacities * factors).clamp_max(1.0)
