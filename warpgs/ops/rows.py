"""Splat rows: what compositing needs of each Gaussian, in 16-byte pieces (kernels/rows.py)."""

from torch import Tensor, int32

from warpgs.kernels import rows as kernels
from warpgs.runtime.tape import Run

from .projection import Projection


class Rows:
    """Packed splats, and what the way back leaves of them.

    Their features come later, by ``add_features``: binning does without, compositing and the way back do not.

    Attributes:
        packed: [N, parts, 4] rows.
        num_features, with_depth: Features, and whether depth is one more channel after them.
        num_channels: All of these.
        norms: [N, 2] length of the gradient of the screen-space mean and its absolute-value variant (the lengths'
            terms summed over pixels before squaring), in normalised device coordinates (pixels × size / 2) as the
            densification of 3DGS expects; zero until the way back has been gone.
        depth_keys, gaussian_from_rank: [2 N] int32, first half filled: what the depth sort starts from.
    """

    def __init__(self, run: Run, splats: Projection, num_features: int, with_depth: bool, size: tuple[int, int]):
        N = len(splats.depths)
        self._splats, self._size = splats, size
        self.num_features, self.with_depth, self.num_channels = num_features, with_depth, num_features + int(with_depth)
        self.packed = run.empty(N, kernels.row_parts(self.num_channels), 4)
        self.norms = run.empty(N, 2)
        self.depth_keys = run.empty(2 * N, dtype=int32)
        self.gaussian_from_rank = run.empty(2 * N, dtype=int32)
        run.launch(
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
            self.norms,
        )

    def add_features(self, run: Run, features: Tensor) -> None:
        """Writes [N, num_features] features beside the geometry."""
        splats, num_features, with_depth, size = self._splats, self.num_features, self.with_depth, self._size
        N = len(features)
        depths = splats.depths if with_depth else None
        run.launch(kernels.make_pack_features(num_features, with_depth), N, features, depths, self.packed)

        packed, norms = self.packed, self.norms
        run.filled.append(norms)

        def backward(run: Run) -> None:
            gradients = run.adjoint(packed)
            if gradients is None:
                return
            v_means2d, v_conics = run.empty(N, 2), run.empty(N, 3)
            v_opacities, v_features = run.empty(N), run.empty(N, num_features)
            v_depths = run.empty(N) if with_depth else None
            run.launch(
                kernels.make_unpack(num_features, with_depth),
                N,
                splats.conics,
                splats.opacities,
                packed,
                gradients,
                0.5 * size[0],
                0.5 * size[1],
                v_means2d,
                v_conics,
                v_opacities,
                v_features,
                v_depths,
                norms,
            )
            run.add_adjoint(splats.means2d, v_means2d)
            run.add_adjoint(splats.conics, v_conics)
            run.add_adjoint(splats.opacities, v_opacities)
            run.add_adjoint(features, v_features)
            if v_depths is not None:
                run.add_adjoint(splats.depths, v_depths)

        run.on_backward(backward)
