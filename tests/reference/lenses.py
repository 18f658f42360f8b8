"""Lenses in plain torch, any dtype: their formulas as printed, with Jacobians by automatic differentiation."""

from functools import partial

import torch
from torch import Tensor

from warpgs.ops.projection import View


def radial(slopes: Tensor, k: Tensor) -> Tensor:
    """[N, 2] distorted slopes (OpenCV's documentation of calib3d)."""
    x, y = slopes.unbind(-1)
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = k
    r2 = x**2 + y**2
    d = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return torch.stack(
        [
            x * d + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2,
            y * d + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
        ],
        -1,
    )


def fisheye(t: Tensor, k: Tensor) -> Tensor:
    """[N, 2] θ_d in the direction of (x, y) (OpenCV's documentation of fisheye)."""
    rho = t[:, :2].norm(dim=1)
    theta = torch.atan2(rho, t[:, 2])
    bent = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    return t[:, :2] * (bent / rho)[:, None]


def equirectangular(t: Tensor, k: Tensor) -> Tensor:
    """[N, 2] longitude and latitude of a panorama, x to the right and y downward (OpenSfM's, without coefficients)."""
    x, y, z = t.unbind(-1)
    return torch.stack([torch.atan2(x, z), torch.asin(y / t.norm(dim=1))], -1)


def _jacobian(function, points: Tensor) -> Tensor:
    """[N, 2, D] derivatives of a function of [N, D] points, each of which decides its own value."""
    with torch.enable_grad():
        points = points if points.requires_grad else points.detach().requires_grad_()
        value = function(points)
        rows = [torch.autograd.grad(value[:, k].sum(), points, create_graph=True)[0] for k in range(2)]
    return torch.stack(rows, 1)


def point_and_jacobian(t: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """[N, 2] points of the image and [N, 2, 3] the Jacobian of the local affine approximation."""
    focal, center = view.K.diagonal()[:2], view.K[:2, 2]
    if view.lens in (wide := {"fisheye": fisheye, "equirectangular": equirectangular}):
        function = partial(wide[view.lens], k=view.distortion)
        return focal * function(t) + center, focal[:, None] * _jacobian(function, t)
    z, slopes = t[:, 2], t[:, :2] / t[:, 2:]
    if view.lens == "pinhole":
        size = torch.tensor([view.width, view.height], dtype=t.dtype)
        margin = 0.15 * size / focal
        q = torch.maximum(torch.minimum(slopes, (size - center) / focal + margin), -center / focal - margin)
        bent, D = slopes, torch.eye(2, dtype=t.dtype).expand(len(t), 2, 2)
    else:
        q = slopes * (view.limit / slopes.norm(dim=1, keepdim=True)).clamp(max=1.0)
        D = _jacobian(lambda q: radial(q, view.distortion), q)
        bent = radial(q, view.distortion) + (D @ (slopes - q)[..., None])[..., 0]
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    pinhole = torch.stack([one / z, zero, -q[:, 0] / z, zero, one / z, -q[:, 1] / z], -1).reshape(-1, 2, 3)
    return focal * bent + center, focal[:, None] * (D @ pinhole)
