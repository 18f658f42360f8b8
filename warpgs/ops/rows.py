"""Splat rows: what compositing needs of each Gaussian, in pieces of 16 bytes (kernels/rows.py)."""

from typing import NamedTuple

import torch
from torch import Tensor, int32

from warpgs.kernels import rows as kernels
from warpgs.kernels.rows import OffsetGradient
from warpgs.runtime.launch import launch

from .projection import Geometry, Projection, View


class Rows(NamedTuple):
    """Packed splats.

    Attributes:
        packed: [N, parts, 4] rows.
        num_features: Number of features.
        with_depth: Whether depth is one more channel after the features.
    """

    packed: Tensor
    num_features: int
    with_depth: bool

    @property
    def num_channels(self) -> int:
        """Number of features, plus one with depth."""
        return self.num_features + int(self.with_depth)


class DepthOrder(NamedTuple):
    """Keys and values of the depth sort, [2 N] int32 in the first half."""

    keys: Tensor
    gaussian_from_rank: Tensor


def pack(splats: Projection, features: Tensor, with_depth: bool) -> tuple[Rows, DepthOrder]:
    """Packs N splats with [N, num_features] features; sets the radii of those that are skipped to 0."""
    N, num_features = features.shape
    packed = features.new_empty(N, kernels.row_parts(num_features + int(with_depth)), 4)
    order = DepthOrder(*(splats.radii.new_empty(2 * N) for _ in range(2)))
    launch(kernels.make_pack(num_features, with_depth), N, *splats, features, packed, *order)
    return Rows(packed, num_features, with_depth), order


def project_and_pack(
    geometry: Geometry,
    features: Tensor,
    view: View,
    near: float,
    antialias: bool,
    with_depth: bool,
    screen_offsets: Tensor | None = None,
) -> tuple[tuple[Tensor, Tensor, Tensor], Rows, DepthOrder]:
    """``pack(project_fwd(…), features, with_depth)`` in one kernel: conics, opacities and radii; rows; depth order."""
    N, num_features = features.shape
    new, radii = features.new_empty, features.new_empty(N, 2, dtype=int32)
    splats = new(N, 3), new(N), radii
    rows = Rows(new(N, kernels.row_parts(num_features + int(with_depth)), 4), num_features, with_depth)
    order = DepthOrder(radii.new_empty(2 * N), radii.new_empty(2 * N))
    inputs = (*geometry, *view, near, int(antialias), screen_offsets, features)
    launch(kernels.make_project_and_pack(num_features, with_depth), N, *inputs, *splats, rows.packed, *order)
    return splats, rows, order


class PackGradients(NamedTuple):
    """Gradients of the inputs of ``pack``, and of offsets of the means on screen in halves of the image size."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor | None
    opacities: Tensor
    features: Tensor
    screen_offsets: Tensor | None


def unpack(
    splats: tuple[Tensor, Tensor],
    rows: Rows,
    v_rows: Tensor,
    size: tuple[int, int],
    with_offsets: bool = False,
    offset_gradient: OffsetGradient = None,
) -> PackGradients:
    """The backward pass of ``pack``.

    Args:
        splats: Conics and opacities of the splats.
        rows: First result of ``pack``.
        v_rows: [shards, N, gradient_stride] sums from ``composite_bwd``.
        size: (width, height) of the image [px].
        with_offsets: Whether to return the gradient of ``screen_offsets``.
        offset_gradient: As in ``composite_bwd``.
    """
    conics, opacities = splats
    N = conics.shape[0]
    v_splats = PackGradients(
        means2d=conics.new_empty(N, 2),
        conics=torch.empty_like(conics),
        depths=conics.new_empty(N) if rows.with_depth else None,
        opacities=torch.empty_like(opacities),
        features=conics.new_empty(N, rows.num_features),
        screen_offsets=conics.new_empty(N, 2) if with_offsets else None,
    )
    sign = {None: 0.0, "absolute": 1.0, "images": -1.0}[offset_gradient]
    inputs = (*splats, rows.packed, v_rows, 0.5 * size[0], 0.5 * size[1], sign)
    launch(kernels.make_unpack(rows.num_features, rows.with_depth), N, *inputs, *v_splats)
    return v_splats
