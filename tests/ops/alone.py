"""The steps of a render on their own: each a forward and a backward function of ``warpgs.ops``."""

import torch
from torch import Tensor

from tests.reference import rows as reference
from tests.reference.projection import Projection
from warpgs.kernels.constants import CULLED_DEPTH, CULLED_LOG2_OPACITY
from warpgs.ops.compositing import NUM_BRANCH_IMAGES, Composite, background_bwd, composite_bwd, composite_fwd
from warpgs.ops.projection import Geometry, View, project_fwd
from warpgs.ops.rows import DepthOrder, Rows, new_order, new_rows
from warpgs.ops.sh import degree_of, sh_bwd, sh_fwd
from warpgs.ops.tiles import bin_splats
from warpgs.runtime.tape import Recorded, differentiable


def project(geometry: Geometry, view: View, *, near=0.01, antialias=False) -> Projection:
    """The splats that ``project_fwd`` packs."""
    rows, radii, _ = project_fwd(geometry, geometry.means[:, :1].contiguous(), view, near, antialias, with_depth=True)
    means2d, conics, opacities, features = reference.unpack(rows.packed)
    values = (means2d, conics, features[:, 1], opacities)
    culled = rows.packed[:, 1, 1] == CULLED_LOG2_OPACITY
    assert torch.equal(culled, (radii == 0).all(1))
    assert torch.equal(culled, (radii == 0).any(1))
    return Projection(*(torch.where(culled.view(-1, *[1] * (v.ndim - 1)), 0.0, v) for v in values), radii)


def pack(splats: Projection, features: Tensor, with_depth: bool) -> tuple[Rows, DepthOrder]:
    """The rows of any splats, and the input of binning them, as the kernel of ``project_fwd`` writes them."""
    means2d, conics, depths, opacities, radii = splats
    culled, rows, order = radii[:, 0] == 0, new_rows(features, with_depth), new_order(radii)
    channels = torch.cat([features, depths[:, None]], 1) if with_depth else features
    rows.packed.copy_(reference.pack(means2d, conics, opacities, channels).view(rows.packed.shape))
    rows.packed[culled, 1, 1] = CULLED_LOG2_OPACITY
    order.keys[: len(radii)] = torch.where(culled, CULLED_DEPTH, depths.contiguous().view(torch.int32))
    order.gaussian_from_rank[: len(radii)] = torch.arange(len(radii))
    for zeros in (order.scan_words, order.sort_counters):
        if zeros is not None:
            zeros.zero_()
    return rows, order


def spherical_harmonics(means, sh, viewmat, *, degree=None) -> torch.Tensor:
    degree = degree_of(sh.shape[1]) if degree is None else degree

    def op(*inputs):
        colors = sh_fwd(*inputs, degree)
        return Recorded((colors,), backward, (*inputs, colors))

    def backward(saved, v_outputs):
        *inputs, colors = saved
        v_means = torch.zeros_like(inputs[0])
        v_sh, v_viewmat = sh_bwd(inputs, degree, colors, v_outputs[0], v_means)
        return v_means, v_sh, v_viewmat

    return differentiable(op, means, sh, viewmat)[0]


def composite(
    splats, features, size, *, background=None, is_dynamic=None, statistics=False, max_alpha=0.999
) -> Composite:
    branch = None if is_dynamic is None else is_dynamic.view(torch.uint8)
    n = 1 if is_dynamic is None else NUM_BRANCH_IMAGES

    def op(*tensors):
        means2d, conics, depths, opacities, features, background = tensors
        rows, order = pack(Projection(means2d, conics, depths, opacities, splats.radii), features, with_depth=False)
        tiles = bin_splats(rows, order, size, branch)
        result, traversal = composite_fwd(rows, tiles, size, background, statistics, max_alpha)

        def backward(saved, v_layers):
            conics, opacities, background, *alphas = saved
            v_rows = composite_bwd(rows, background, traversal, v_layers).sum(0)
            v_features, sums = v_rows[:, : rows.num_channels], v_rows[:, rows.num_channels :]
            v_means2d, v_conics, v_opacities = reference.splat_gradients(conics, opacities, sums)
            v_background = None if background is None else background_bwd(background, alphas, v_layers[:n])
            return v_means2d, v_conics, None, v_opacities, v_features, v_background

        saved = (conics, opacities, background, *result.alphas)
        return Recorded(result.layers, backward, saved, constants=result.statistics)

    tensors = differentiable(op, *splats[:4], features, background)
    return Composite(tensors[:n], tensors[n : 2 * n], (), tensors[2 * n :])
