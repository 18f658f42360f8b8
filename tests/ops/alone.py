"""The steps of a render as nodes of autograd of their own, each a forward and a backward function of ``warpgs.ops``."""

import torch

from warpgs.ops.compositing import NUM_BRANCH_IMAGES, Composite, background_bwd, composite_bwd, composite_fwd
from warpgs.ops.projection import Geometry, Projection, View, project_bwd, project_fwd
from warpgs.ops.rows import pack, unpack
from warpgs.ops.sh import degree_of, sh_bwd, sh_fwd
from warpgs.ops.tiles import bin_splats
from warpgs.runtime.tape import Recorded, differentiable


def project(geometry, view, *, near=0.01, antialias=False) -> Projection:
    size = view[2:]

    def op(*tensors):
        *tensors, viewmat, K = tensors
        splats = project_fwd(Geometry(*tensors), View(viewmat, K, *size), near, antialias)
        saved = (*tensors, viewmat, K, splats.radii)
        return Recorded(splats[:4], backward, saved, constants=(splats.radii,))

    def backward(saved, v_splats):
        *tensors, viewmat, K, radii = saved
        view = View(viewmat, K, *size)
        v_geometry, *v_camera = project_bwd(Geometry(*tensors), view, antialias, radii, v_splats)
        return *v_geometry, *v_camera

    return Projection(*differentiable(op, *geometry, view.viewmat, view.K))


def spherical_harmonics(means, sh, viewmat, *, degree=None, radii=None) -> torch.Tensor:
    degree = degree_of(sh.shape[1]) if degree is None else degree
    radii = torch.ones(len(means), 2, dtype=torch.int32) if radii is None else radii

    def op(*inputs):
        colors = sh_fwd(*inputs, degree)
        return Recorded((colors,), backward, (*inputs, colors))

    def backward(saved, v_outputs):
        *inputs, colors = saved
        return *sh_bwd(inputs, degree, colors, v_outputs[0]), None

    return differentiable(op, means, sh, viewmat, radii)[0]


def composite(
    splats, features, size, *, background=None, is_dynamic=None, statistics=False, max_alpha=0.999
) -> Composite:
    """Splats that are skipped keep their radii."""
    branch = None if is_dynamic is None else is_dynamic.view(torch.uint8)
    n = 1 if is_dynamic is None else NUM_BRANCH_IMAGES

    def op(*tensors):
        *geometry, features, background = tensors
        rows, order = pack(Projection(*geometry, splats.radii.clone()), features, with_depth=False)
        tiles = bin_splats(rows, order, size, branch)
        result, traversal = composite_fwd(rows, tiles, size, background, statistics, max_alpha)

        def backward(saved, v_layers):
            background, *alphas = saved
            v_splats = unpack(rows, composite_bwd(rows, background, traversal, v_layers), size)
            v_background = None if background is None else background_bwd(background, alphas, v_layers[:n])
            return *v_splats[:5], v_background

        return Recorded(result.layers, backward, (background, *result.alphas), constants=result.statistics)

    tensors = differentiable(op, *splats[:4], features, background)
    return Composite(tensors[:n], tensors[n : 2 * n], (), tensors[2 * n :])
