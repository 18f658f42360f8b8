"""Splat rows: what compositing needs of each Gaussian, in pieces of 16 bytes (kernels/rows.py)."""

from torch import Tensor, int32

from warpgs.kernels import rows as kernels
from warpgs.runtime.tape import OpContext

from .projection import Projection


class Rows:
    """Packed splats; the constructor packs their geometry, ``add_features`` their features.

    Binning needs the geometry alone, so that features may be computed meanwhile; compositing needs both.

    Args:
        ctx: Of the op that this is a part of.
        splats: N projected Gaussians. Radii of those that are skipped are set to 0.
        num_features: Number of features that will be added.
        with_depth: Whether depth is one more channel after the features.
        size: (width, height) of the image [px].

    Attributes:
        packed: [N, parts, 4] rows.
        num_features, with_depth: As given.
        num_channels: Number of features, plus one with depth.
        gradient_norms: [N, 2] length of the gradient of the screen-space mean and of a second one (``SecondNorm``;
            zero without), in normalised device coordinates (pixels × size / 2) as in the densification of 3DGS; zero
            until the backward pass.
        depth_keys, gaussian_from_rank: [2 N] int32 input of the depth sort, in the first half.
    """

    def __init__(
        self, ctx: OpContext, splats: Projection, num_features: int, with_depth: bool, size: tuple[int, int]
    ) -> None:
        N = len(splats.depths)
        self._splats, self._size = splats, size
        self.num_features, self.with_depth, self.num_channels = num_features, with_depth, num_features + int(with_depth)
        self.packed = ctx.empty(N, kernels.row_parts(self.num_channels), 4)
        self.gradient_norms = ctx.empty(N, 2)
        self.depth_keys = ctx.empty(2 * N, dtype=int32)
        self.gaussian_from_rank = ctx.empty(2 * N, dtype=int32)
        ctx.launch(
            kernels.pack,
            N,
            splats.means2d,
            splats.conics,
            splats.opacities,
            splats.depths,
            splats.radii,
            self.packed,
            self.depth_keys,
            self.gaussian_from_rank,
            self.gradient_norms,
        )

    def add_features(self, ctx: OpContext, features: Tensor) -> None:
        """Packs [N, num_features] features, and depth if it is a channel, beside the geometry."""
        kernel = kernels.make_pack_features(self.num_features, self.with_depth)
        depths = self._splats.depths if self.with_depth else None
        ctx.launch(kernel, len(features), features, depths, self.packed, self._splats.radii)
        ctx.outputs_written_in_backward.append(self.gradient_norms)
        ctx.on_backward(lambda ctx: self._backward(ctx, features))

    def _backward(self, ctx: OpContext, features: Tensor) -> None:
        gradients = ctx.gradient(self.packed)
        if gradients is None:
            return
        splats, N = self._splats, len(features)
        v_means2d, v_conics = ctx.empty(N, 2), ctx.empty(N, 3)
        v_opacities, v_features = ctx.empty(N), ctx.empty(N, self.num_features)
        v_depths = ctx.empty(N) if self.with_depth else None
        ctx.launch(
            kernels.make_unpack(self.num_features, self.with_depth),
            N,
            splats.conics,
            splats.opacities,
            self.packed,
            gradients,
            0.5 * self._size[0],
            0.5 * self._size[1],
            v_means2d,
            v_conics,
            v_opacities,
            v_features,
            v_depths,
            self.gradient_norms,
        )
        ctx.add_gradient(splats.means2d, v_means2d)
        ctx.add_gradient(splats.conics, v_conics)
        ctx.add_gradient(splats.opacities, v_opacities)
        ctx.add_gradient(features, v_features)
        if v_depths is not None:
            ctx.add_gradient(splats.depths, v_depths)
