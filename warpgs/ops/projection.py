"""EWA projection of Gaussians to rows of splats (kernels/projection.py)."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, int32

from warpgs.kernels import projection as kernels
from warpgs.runtime.launch import launch

from .rows import DepthOrder, Rows, new_order, new_rows


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
    """A camera.

    Attributes:
        viewmat: [4, 4] rigid world-to-camera transform, x right, y down, z forward.
        K: [3, 3] intrinsics [px] with pixel centres at +0.5; skew is not used.
        width, height: Size of the image [px].
        distortion: [C] coefficients of the lens, in the order of its kernel; None for a pinhole.
        limit: How far from the axis the lens' formula holds: a radius on the plane z = 1 (radial), or an angle
            (fisheye) [radians], beyond which nothing is seen.
        lens: Name of the lens, a key of ``kernels.lenses.LENSES``.
        motion: [2, 3] how the camera turns (rotation vector [radians]) and moves while its rows are read from first to
            last, in its own axes; ``viewmat`` is at the middle row then. None for a global shutter.
        by_columns: Whether columns take the place of rows in ``motion``.
    """

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int
    distortion: Float[Tensor, " C"] | None = None
    limit: float = 0.0
    lens: str = "pinhole"
    motion: Float[Tensor, "2 3"] | None = None
    by_columns: bool = False

    @property
    def arguments(self) -> tuple[Tensor | int | float | None, ...]:
        """Of the kernels."""
        return (*self[:6], self.motion)

    @property
    def variant(self) -> tuple[str, bool, bool]:
        """Of the kernels: lens and shutter."""
        is_rolling = self.motion is not None
        return self.lens, is_rolling, is_rolling and self.by_columns


class SplatGradients(NamedTuple):
    """Gradients of the inputs of ``project_fwd``; None if an input requires none."""

    geometry: Geometry
    features: Tensor
    viewmat: Tensor | None
    K: Tensor | None
    screen_offsets: Tensor | None
    distortion: Tensor | None = None
    motion: Tensor | None = None


def project_fwd(
    geometry: Geometry,
    features: Tensor,
    view: View,
    near: float,
    antialias: bool,
    with_depth: bool,
    screen_offsets: Tensor | None = None,
) -> tuple[Rows, Tensor, DepthOrder]:
    """Projects Gaussians into a camera and packs the splats.

    Gaussians that are at the near plane or behind it, 1e10 or more from the camera, outside the image, fainter than
    1/255 or that have an opacity above 1, a value that is not finite, or a conic that is singular in single precision
    are culled.

    Args:
        geometry: N Gaussians.
        features: [N, num_features] colours or other values to composite.
        view: The camera.
        near: Depth of the near plane [scene units].
        antialias: Scales opacities by sqrt(|Σ'| / |Σ' + 0.3 I|), so that thin Gaussians do not swell (Mip-Splatting).
        with_depth: Whether depth in camera space becomes one more channel.
        screen_offsets: [N, 2] added to the means on screen, in halves of the image size.

    Returns:
        The rows; [N, 2] int32 half sizes of the box outside which alpha is below 1/255 [px], 0 = culled; and the input
        of binning.
    """
    rows, radii = new_rows(features, with_depth), features.new_empty(features.shape[0], 2, dtype=int32)
    order, kernel = new_order(radii), kernels.make_project_fwd(rows.num_features, with_depth, *view.variant)
    inputs = (*geometry, *view.arguments, near, int(antialias), screen_offsets, features)
    launch(kernel, features.shape[0], *inputs, radii, rows.packed, *order)
    return rows, radii, order


def project_bwd(
    geometry: Geometry,
    view: View,
    antialias: bool,
    rows: Rows,
    v_rows: Tensor,
    with_offsets: bool = False,
    absgrad: bool = False,
) -> SplatGradients:
    """The backward pass of ``project_fwd``.

    Args:
        geometry, view, antialias: As in ``project_fwd``.
        rows: Its first result.
        v_rows: [shards, N, gradient_stride] sums from ``composite_bwd``.
        with_offsets: Whether to return the gradient of ``screen_offsets``.
        absgrad: As in ``composite_bwd``.
    """
    new, N = geometry.means.new_empty, geometry.means.shape[0]
    v_geometry = Geometry(new(N, 3), new(N, 4), new(N, 3), new(N))  # torch.empty_like takes the host longer
    v_features, v_offsets = new(N, rows.num_features), new(N, 2) if with_offsets else None
    others = [part for part in (view.distortion, view.motion) if part is not None]
    is_trained = any(part.requires_grad for part in (view.viewmat, view.K, *others))
    num_others = sum(part.numel() for part in others)
    v_cameras = new(N, kernels.CAMERA_GRADIENTS + num_others) if is_trained else None
    v_parts = v_rows.view(*v_rows.shape[:2], v_rows.shape[2] // 4, 4)  # pieces of 16 bytes
    inputs = (*geometry, *view.arguments, int(antialias), rows.packed, v_parts, int(absgrad))
    kernel = kernels.make_project_bwd(rows.num_features, rows.with_depth, *view.variant)
    launch(kernel, N, *inputs, v_features, v_offsets, *v_geometry, v_cameras)
    v_viewmat, v_K, *v_others = (None,) * 4 if v_cameras is None else _sum_over_gaussians(view, v_cameras)
    return SplatGradients(v_geometry, v_features, v_viewmat, v_K, v_offsets, *v_others)


def _sum_over_gaussians(view: View, v_cameras: Tensor) -> tuple[Tensor | None, ...]:
    """Gradients of ``viewmat``, ``K``, ``distortion`` and ``motion`` from what each Gaussian contributes."""
    sums = v_cameras.sum(0)
    v_viewmat, v_K = torch.zeros_like(view.viewmat), torch.zeros_like(view.K)  # their last rows are constant
    v_viewmat[:3, :3], v_viewmat[:3, 3] = sums[:9].view(3, 3), sums[9:12]
    v_K[0, 0], v_K[1, 1], v_K[0, 2], v_K[1, 2] = sums[12:16].unbind()
    num = 0 if view.distortion is None else len(view.distortion)
    v_distortion = None if view.distortion is None else sums[16 : 16 + num]
    return v_viewmat, v_K, v_distortion, None if view.motion is None else sums[16 + num :].view(2, 3)
