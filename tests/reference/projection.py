"""EWA projection in plain torch, any dtype: through Σ and its full 2D image, unlike the kernel."""

from typing import NamedTuple

import torch
from torch import Tensor

from tests.reference.covariance import covariance
from warpgs.ops.projection import Geometry, View

LOW_PASS = 0.3
ALPHA_MIN = 1.0 / 255.0


class Projection(NamedTuple):
    """N Gaussians as a camera sees them; all values of a culled Gaussian are zero.

    Attributes:
        means2d: [N, 2] centres [px].
        conics: [N, 3] entries xx, xy, yy of the inverse 2D covariance [1/px²].
        depths: [N] z in camera space [scene units].
        opacities: [N] in [0, 1], with antialiasing compensated for the low-pass filter.
        radii: [N, 2] int32 half sizes on screen [px]; 0 = culled.
    """

    means2d: Tensor
    conics: Tensor
    depths: Tensor
    opacities: Tensor
    radii: Tensor


def project(
    geometry: Geometry, view: View, near: float = 0.01, antialias: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """means2d, conics, depths, opacities, visible [N] bool. Values of invisible Gaussians are undefined."""
    means, quats, scales, opacities = geometry
    viewmat, K, width, height = view
    W, translation = viewmat[:3, :3], viewmat[:3, 3]
    t = means @ W.T + translation
    x, y, z = t.unbind(-1)
    in_front = z > near
    z = torch.where(in_front, z, torch.ones_like(z))
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    u = (x / z).clamp(min=-cx / fx - margin_x, max=(width - cx) / fx + margin_x)
    v = (y / z).clamp(min=-cy / fy - margin_y, max=(height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * u / z, zero, fy / z, -fy * v / z], -1).reshape(-1, 2, 3)
    sharp = J @ W @ covariance(quats, scales) @ W.T @ J.mT
    blurred = sharp + LOW_PASS * torch.eye(2, dtype=means.dtype)
    det = torch.linalg.det(blurred)
    if antialias:
        opacities = opacities * (torch.linalg.det(sharp) / det).clamp(min=0).sqrt()
    inverse = torch.linalg.inv(blurred)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    reach = (2 * (opacities.detach() / ALPHA_MIN).clamp(min=1).log()).sqrt()
    radii = (reach[:, None] * blurred.detach().diagonal(dim1=1, dim2=2).sqrt()).ceil()
    limit = torch.tensor([width, height], dtype=means.dtype)
    on_screen = ((means2d + radii > 0) & (means2d - radii < limit)).all(-1)
    visible = in_front & on_screen & (opacities >= ALPHA_MIN)
    return means2d, conics, z, opacities, visible
