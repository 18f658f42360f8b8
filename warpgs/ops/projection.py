"""EWA projection of Gaussians to splats (kernels/projection.py)."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor, int32

from warpgs.config import RenderSettings
from warpgs.kernels import projection as kernels
from warpgs.runtime.checks import check_image_size, check_same_device, check_tensor
from warpgs.runtime.tape import OpContext, differentiable


class Geometry(NamedTuple):
    """Where N Gaussians are and how opaque they are.

    Attributes:
        means: [N, 3] centres in the world.
        quats: [N, 4] rotations (w, x, y, z) of any length but zero.
        scales: [N, 3] standard deviations along the Gaussians' own axes.
        opacities: [N] in [0, 1].
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]


class View(NamedTuple):
    """A pinhole camera.

    Attributes:
        viewmat: [4, 4] rigid world-to-camera transform, x right, y down, z forward.
        K: [3, 3] intrinsics [px] with pixel centres at +0.5; skew is not used.
        width, height: Size of the image [px].
    """

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int


class Projection(NamedTuple):
    """N Gaussians as a camera sees them; all values of a culled Gaussian are zero.

    Attributes:
        means2d: [N, 2] centres [px], x right, y down, pixel centres at +0.5.
        conics: [N, 3] entries xx, xy, yy of the inverse 2D covariance [1/px²].
        depths: [N] z in camera space [scene units].
        opacities: [N] in [0, 1], with antialiasing compensated for the low-pass filter.
        radii: [N, 2] int32 half sizes of the box outside which alpha is below 1/255 [px]; 0 = culled.
    """

    means2d: Float[Tensor, "N 2"]
    conics: Float[Tensor, "N 3"]
    depths: Float[Tensor, " N"]
    opacities: Float[Tensor, " N"]
    radii: Int32[Tensor, "N 2"]


def record_projection(ctx: OpContext, geometry: Geometry, view: View, near: float, antialias: bool) -> Projection:
    """``project`` as a part of a larger op, without checks."""
    N = len(geometry.means)
    splats = Projection(ctx.empty(N, 2), ctx.empty(N, 3), ctx.empty(N), ctx.empty(N), ctx.empty(N, 2, dtype=int32))
    ctx.launch(
        kernels.project_fwd,
        N,
        *geometry,
        *view,
        near,
        int(antialias),
        splats.means2d,
        splats.conics,
        splats.depths,
        splats.radii,
        splats.opacities,
    )

    def backward(ctx: OpContext) -> None:
        v_splats = [ctx.gradient(t) for t in (splats.means2d, splats.conics, splats.depths, splats.opacities)]
        v_geometry = [ctx.empty(*t.shape) for t in geometry]
        with_camera = ctx.needs_gradient(view.viewmat) or ctx.needs_gradient(view.K)
        v_cameras = ctx.empty(N, kernels.CAMERA_GRADIENTS if with_camera else 0)
        inputs = (*geometry, *view, int(antialias), splats.conics, splats.radii)
        ctx.launch(kernels.project_bwd, N, *inputs, *v_splats, *v_geometry, v_cameras)
        for tensor, gradient in zip(geometry, v_geometry, strict=True):
            ctx.add_gradient(tensor, gradient)
        if with_camera:
            _add_camera_gradients(ctx, view, v_cameras.sum(0))

    ctx.on_backward(backward, reads=(splats.conics, splats.radii))
    return splats


def _add_camera_gradients(ctx: OpContext, view: View, sums: Float[Tensor, "16"]) -> None:
    """Adds to the gradients of ``viewmat`` and ``K``; their constant last rows get none."""
    if ctx.needs_gradient(view.viewmat):
        v_viewmat = torch.zeros_like(view.viewmat)
        v_viewmat[:3, :3], v_viewmat[:3, 3] = sums[:9].view(3, 3), sums[9:12]
        ctx.add_gradient(view.viewmat, v_viewmat)
    if ctx.needs_gradient(view.K):
        v_K = torch.zeros_like(view.K)
        v_K[0, 0], v_K[1, 1], v_K[0, 2], v_K[1, 2] = sums[12:].unbind()
        ctx.add_gradient(view.K, v_K)


def project(
    geometry: Geometry, view: View, *, near: float = RenderSettings.near, antialias: bool = False
) -> Projection:
    """Projects Gaussians into a pinhole camera; differentiable in them and in the camera.

    The formulas are at the head of ``kernels/projection.py``.

    Args:
        geometry: N Gaussians.
        view: The camera.
        near: Near plane: Gaussians at this depth or closer are culled [scene units].
        antialias: Scales opacities by sqrt(|Σ'| / |Σ' + 0.3 I|), so that thin Gaussians do not swell (Mip-Splatting).

    Returns:
        A ``Projection``. Gaussians that are behind the near plane, 1e10 or more from the camera, outside the image,
        fainter than 1/255 or that have an opacity above 1 or a value that is not finite are culled.

    Raises:
        ValueError: On a wrong shape, dtype, device or size.
    """
    _check_inputs(geometry, view)
    size = view[2:]

    def op(ctx: OpContext, *tensors: Tensor) -> tuple[Tensor, ...]:
        *geometry, viewmat, K = tensors
        return record_projection(ctx, Geometry(*geometry), View(viewmat, K, *size), near, antialias)

    return Projection(*differentiable(op, *geometry, view.viewmat, view.K))


def _check_inputs(geometry: Geometry, view: View) -> None:
    """Raises ``ValueError`` unless the tensors describe Gaussians and a camera on one device."""
    sizes: dict[str, int] = {}
    check_tensor("means", geometry.means, ("N", 3), sizes)
    check_tensor("quats", geometry.quats, ("N", 4), sizes)
    check_tensor("scales", geometry.scales, ("N", 3), sizes)
    check_tensor("opacities", geometry.opacities, ("N",), sizes)
    check_tensor("viewmat", view.viewmat, (4, 4), sizes)
    check_tensor("K", view.K, (3, 3), sizes)
    check_same_device({**geometry._asdict(), "viewmat": view.viewmat, "K": view.K})
    check_image_size(view.width, view.height)
