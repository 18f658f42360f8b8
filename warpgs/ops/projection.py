"""EWA projection of Gaussians to splats (kernels/projection.py)."""

from typing import NamedTuple

from jaxtyping import Float, Int32
from torch import Tensor, int32

from warpgs.config import RenderSettings
from warpgs.kernels import projection as kernels
from warpgs.runtime.checks import check_image_size, check_same_device, check_tensor
from warpgs.runtime.tape import Run, differentiable


class Projection(NamedTuple):
    """N Gaussians as a camera sees them; everything is zero for a culled one.

    Attributes:
        means2d: [N, 2] centres [px], x right, y down, pixel centres at +0.5.
        conics: [N, 3] entries xx, xy, yy of the inverse 2D covariance [1/px²].
        depths: [N] camera-space z, in scene units.
        opacities: [N] in [0, 1], compensated for the low-pass filter where that was asked for.
        radii: [N, 2] int32 half sizes of the box outside which alpha is below 1/255 [px]; 0 = culled.
    """

    means2d: Float[Tensor, "N 2"]
    conics: Float[Tensor, "N 3"]
    depths: Float[Tensor, " N"]
    opacities: Float[Tensor, " N"]
    radii: Int32[Tensor, "N 2"]


def record_projection(
    run: Run,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    size: tuple[int, int],
    near: float,
    antialias: bool,
) -> Projection:
    """``project`` as a step of a run; ``size`` is (width, height)."""
    N = means.shape[0]
    width, height = size
    splats = Projection(run.empty(N, 2), run.empty(N, 3), run.empty(N), run.empty(N), run.empty(N, 2, dtype=int32))
    geometry = (means, quats, scales, opacities, viewmat, K, width, height)
    run.launch(
        kernels.project_fwd,
        N,
        *geometry,
        near,
        int(antialias),
        splats.means2d,
        splats.conics,
        splats.depths,
        splats.radii,
        splats.opacities,
    )

    def backward(run: Run) -> None:
        cotangents = [run.adjoint(t) for t in (splats.means2d, splats.conics, splats.depths, splats.opacities)]
        inputs = (means, quats, scales, opacities)
        gradients = [run.empty(*t.shape) for t in inputs]
        run.launch(
            kernels.project_bwd, N, *geometry, int(antialias), splats.conics, splats.radii, *cotangents, *gradients
        )
        for tensor, gradient in zip(inputs, gradients, strict=True):
            run.add_adjoint(tensor, gradient)

    run.on_backward(backward, reads=(splats.conics, splats.radii))
    return splats


def check_geometry(
    sizes: dict[str, int], means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmat: Tensor, K: Tensor
) -> None:
    """Raises ``ValueError`` unless the tensors describe Gaussians and a camera on one device."""
    check_tensor("means", means, ("N", 3), sizes)
    check_tensor("quats", quats, ("N", 4), sizes)
    check_tensor("scales", scales, ("N", 3), sizes)
    check_tensor("opacities", opacities, ("N",), sizes)
    check_tensor("viewmat", viewmat, (4, 4), sizes)
    check_tensor("K", K, (3, 3), sizes)
    check_same_device(
        {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "viewmat": viewmat, "K": K}
    )


def project(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    viewmat: Float[Tensor, "4 4"],
    K: Float[Tensor, "3 3"],
    size: tuple[int, int],
    *,
    near: float = RenderSettings.near,
    antialias: bool = False,
) -> Projection:
    """Projects Gaussians into a pinhole camera; differentiable in means, quats, scales and opacities.

    Args:
        means: [N, 3] centres in the world.
        quats: [N, 4] rotations (w, x, y, z) of any length but zero.
        scales: [N, 3] standard deviations along the Gaussians' own axes.
        opacities: [N] in [0, 1].
        viewmat: [4, 4] rigid world-to-camera transform, x right, y down, z forward.
        K: [3, 3] intrinsics [px] with pixel centres at +0.5; skew is not used.
        size: (width, height) of the image [px].
        near: Depth at which Gaussians are cut off.
        antialias: Scales opacities by sqrt(|Σ'| / |Σ' + 0.3 I|), so that thin Gaussians do not swell (Mip-Splatting).

    Returns:
        A ``Projection``. Gaussians that are behind the near plane, outside the image, fainter than 1/255 or that have
        a value that is not finite are culled.

    Raises:
        ValueError: On a wrong shape, dtype, device or size.
    """
    check_geometry({}, means, quats, scales, opacities, viewmat, K)
    check_image_size(*size)

    def op(
        run: Run, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmat: Tensor, K: Tensor
    ) -> tuple[Tensor, ...]:
        return record_projection(run, means, quats, scales, opacities, viewmat, K, size, near, antialias)

    return Projection(*differentiable(op, means, quats, scales, opacities, viewmat, K))
