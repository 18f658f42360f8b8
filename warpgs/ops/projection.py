"""EWA projection of Gaussians to splats (kernels/projection.py)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int32
from torch import Tensor, int32

from warpgs.kernels import projection as kernels
from warpgs.runtime.launch import launch


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


def project_fwd(
    geometry: Geometry, view: View, near: float, antialias: bool, screen_offsets: Tensor | None = None
) -> Projection:
    """Projects Gaussians into a pinhole camera.

    Gaussians that are at the near plane or behind it, 1e10 or more from the camera, outside the image, fainter than
    1/255 or that have an opacity above 1 or a value that is not finite are culled.

    Args:
        geometry: N Gaussians.
        view: The camera.
        near: Depth of the near plane [scene units].
        antialias: Scales opacities by sqrt(|Σ'| / |Σ' + 0.3 I|), so that thin Gaussians do not swell (Mip-Splatting).
        screen_offsets: [N, 2] added to the means on screen, in halves of the image size.
    """
    means = geometry.means
    N = means.shape[0]
    splats = Projection(
        means2d=means.new_empty(N, 2),
        conics=means.new_empty(N, 3),
        depths=means.new_empty(N),
        opacities=means.new_empty(N),
        radii=means.new_empty(N, 2, dtype=int32),
    )
    launch(kernels.project_fwd, N, *geometry, *view, near, int(antialias), screen_offsets, *splats)
    return splats


def project_bwd(
    geometry: Geometry,
    view: View,
    antialias: bool,
    radii: Tensor,
    v_splats: Sequence[Tensor | None],
    v_means_of_colors: Tensor | None = None,
) -> tuple[Geometry, Tensor | None, Tensor | None]:
    """Gradients of the geometry, and of ``viewmat`` and ``K`` if one of them requires a gradient.

    Args:
        geometry, view, antialias: As in ``project_fwd``.
        radii: Of its result.
        v_splats: Gradients of means2d, conics, depths and opacities of its result; None for zeros.
        v_means_of_colors: [N, 3] gradient of the means through the colours, to be added; overwritten.
    """
    N = geometry.means.shape[0]
    v_geometry = new_geometry(geometry)
    if v_means_of_colors is not None:
        v_geometry = v_geometry._replace(means=v_means_of_colors)
    v_cameras = new_camera_gradients(view, N)
    inputs = (*geometry, *view, int(antialias), radii)
    launch(kernels.project_bwd, N, *inputs, *v_splats, *v_geometry, v_cameras, v_means_of_colors)
    return v_geometry, *sum_camera_gradients(view, v_cameras)


def new_geometry(geometry: Geometry) -> Geometry:
    """Memory of the same shapes; ``torch.empty_like`` takes the host longer."""
    N, new = geometry.means.shape[0], geometry.means.new_empty
    return Geometry(new(N, 3), new(N, 4), new(N, 3), new(N))


def new_camera_gradients(view: View, num_gaussians: int) -> Tensor | None:
    """Memory for what each Gaussian contributes to the gradient of the camera; None if the camera requires none."""
    if view.viewmat.requires_grad or view.K.requires_grad:
        return view.viewmat.new_empty(num_gaussians, kernels.CAMERA_GRADIENTS)
    return None


def sum_camera_gradients(view: View, v_cameras: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
    """Gradients of ``viewmat`` and ``K``; None if the camera requires none."""
    if v_cameras is None:
        return None, None
    sums = v_cameras.sum(0)
    v_viewmat, v_K = torch.zeros_like(view.viewmat), torch.zeros_like(view.K)  # their last rows are constant
    v_viewmat[:3, :3], v_viewmat[:3, 3] = sums[:9].view(3, 3), sums[9:12]
    v_K[0, 0], v_K[1, 1], v_K[0, 2], v_K[1, 2] = sums[12:].unbind()
    return v_viewmat, v_K
