"""Raw Gaussians of both branches as splats, in plain torch, any dtype."""

import torch
from torch import Tensor

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0])


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product a · b of quaternions (w, x, y, z): the rotation b followed by the rotation a."""
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


def activate(static, dynamic, static_changes, dynamic_changes):
    """Paper Eq. 5, 8 and 11; arguments and results as those of ``warpgs.ops.activation.activate``."""
    branches = [_branch(*static[:4], *static_changes), _branch(*dynamic[:4], *dynamic_changes)]
    return tuple(torch.cat(parts) for parts in zip(*branches, strict=True))


def join_sh(static, dynamic, residuals):
    """Paper Eq. 8; arguments and result as those of ``warpgs.ops.activation.join_sh``."""
    sh = torch.cat([static.sh_dc, static.sh_rest], 1)
    if residuals is not None:
        changed = residuals.shape[1]
        sh = torch.cat([sh[:, :changed] + residuals, sh[:, changed:]], 1)
    return torch.cat([sh, torch.cat([dynamic.sh_dc, dynamic.sh_rest], 1)])


def _branch(means, quats, log_scales, logits, offsets, logit_residuals):
    if offsets is not None:
        means = means + offsets[:, :3]
        quats = multiply(offsets[:, 3:7] + IDENTITY.to(offsets.dtype), quats)
        log_scales = log_scales + offsets[:, 7:]
    if logit_residuals is not None:
        logits = logits + logit_residuals
    return means, quats, log_scales.exp(), logits.sigmoid()
