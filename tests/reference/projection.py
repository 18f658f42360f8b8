"""EWA projection in plain torch, any dtype: through Σ and its full 2D image, unlike the kernel."""

from typing import NamedTuple

import torch
from torch import Tensor

from tests.reference import lenses, shutter
from tests.reference.covariance import covariance
from warpgs.ops.projection import Geometry, View

LOW_PASS = 0.3
ALPHA_MIN = 1.0 / 255.0


class Projection(NamedTuple):
    """N Gaussians as a camera sees them; all values of a culled Gaussian are zero.

    Attributes:
        means2d: [N, 2] centres [px].
        conics: [N, 3] entries xx, xy, yy of the inverse 2D covariance [1/px²].
        depths: [N] z in camera space, for a wide lens the distance from the camera, at the row of a rolling
            shutter [scene units].
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
    W, translation = view.viewmat[:3, :3], view.viewmat[:3, 3]
    t = means @ W.T + translation
    depth, seen = depth_and_visibility(t, view, near)
    t = torch.where(seen[:, None], t, torch.tensor([0.1, 0.1, 1.0], dtype=t.dtype))
    if view.motion is None:
        means2d, J = lenses.point_and_jacobian(t, view)
    else:
        means2d, J, t = shutter.point_and_jacobian(t, view)
        depth, seen_at_row = depth_and_visibility(t, view, near)
        seen = seen & seen_at_row
    sharp = J @ W @ covariance(quats, scales) @ W.T @ J.mT
    blurred = sharp + LOW_PASS * torch.eye(2, dtype=means.dtype)
    det = torch.linalg.det(blurred)
    if antialias:
        opacities = opacities * (torch.linalg.det(sharp) / det).clamp(min=0).sqrt()
    inverse = torch.linalg.inv(blurred)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    reach = (2 * (opacities.detach() / ALPHA_MIN).clamp(min=1).log()).sqrt()
    radii = (reach[:, None] * blurred.detach().diagonal(dim1=1, dim2=2).sqrt()).ceil()
    limit = torch.tensor([view.width, view.height], dtype=means.dtype)
    on_screen = ((means2d + radii > 0) & (means2d - radii < limit)).all(-1)
    visible = seen & on_screen & (opacities >= ALPHA_MIN)
    return means2d, conics, depth, opacities, visible


def depth_and_visibility(t: Tensor, view: View, near: float) -> tuple[Tensor, Tensor]:
    """[N] depths, the distance from a camera with a wide lens, and whether the lens sees them at all."""
    if view.lens not in ("fisheye", "equirectangular"):
        return t[:, 2], t[:, 2] > near
    distance = t.norm(dim=1)
    return distance, (distance > near) & (torch.acos(t[:, 2] / distance) < view.limit)
