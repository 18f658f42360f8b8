"""Splat rows: what compositing needs of each Gaussian, in pieces of 16 bytes (kernels/rows.py)."""

from typing import NamedTuple

from torch import Tensor, int32, int64

from warpgs.kernels import rows as kernels
from warpgs.kernels.scan import SCAN_BLOCK_DIM
from warpgs.runtime.launch import launch

from .projection import Geometry, Projection, View, new_camera_gradients, new_geometry, sum_camera_gradients
from .sort import new_counters

DEPTH_BITS = 31
"""Bits of a depth key: those of a positive float."""


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
    """Input of binning, which uses it up.

    Attributes:
        keys, gaussian_from_rank: [2 N] int32 keys and values of the depth sort, in the first half.
        scan_words: int64 words of the prefix sum of intersections (kernels/scan.py): [⌈N / SCAN_BLOCK_DIM⌉] zeros; on
            CPU, [N] without content.
        sort_counters: int32 zeros of the depth sort (``sort.new_counters``); None on CPU.
    """

    keys: Tensor
    gaussian_from_rank: Tensor
    scan_words: Tensor
    sort_counters: Tensor | None


def _new_order(radii: Tensor) -> DepthOrder:
    """Memory for the order of as many splats; it has no content."""
    N = radii.shape[0]
    num_words = -(-N // SCAN_BLOCK_DIM) if radii.is_cuda else N
    keys, values, words = radii.new_empty(2 * N), radii.new_empty(2 * N), radii.new_empty(num_words, dtype=int64)
    return DepthOrder(keys, values, words, new_counters(radii, N, DEPTH_BITS))


def pack(splats: Projection, features: Tensor, with_depth: bool) -> tuple[Rows, DepthOrder]:
    """Packs N splats with [N, num_features] features; sets the radii of those that are skipped to 0."""
    N, num_features = features.shape
    packed = features.new_empty(N, kernels.row_parts(num_features + int(with_depth)), 4)
    order = _new_order(splats.radii)
    launch(kernels.make_pack(num_features, with_depth), N, *splats, features, packed, *order)
    return Rows(packed, num_features, with_depth), order


class PackedSplats(NamedTuple):
    """Projected Gaussians: what compositing and the backward pass need.

    Attributes:
        radii: [N, 2] int32, as in ``Projection``.
        rows: N packed splats.
    """

    radii: Tensor
    rows: Rows


def project_and_pack(
    geometry: Geometry,
    features: Tensor,
    view: View,
    near: float,
    antialias: bool,
    with_depth: bool,
    screen_offsets: Tensor | None = None,
) -> tuple[PackedSplats, DepthOrder]:
    """``pack(project_fwd(…), features, with_depth)`` in one kernel."""
    N, num_features = features.shape
    packed = features.new_empty(N, kernels.row_parts(num_features + int(with_depth)), 4)
    radii = features.new_empty(N, 2, dtype=int32)
    order = _new_order(radii)
    inputs = (*geometry, *view, near, int(antialias), screen_offsets, features)
    launch(kernels.make_project_and_pack(num_features, with_depth), N, *inputs, radii, packed, *order)
    return PackedSplats(radii, Rows(packed, num_features, with_depth)), order


class PackGradients(NamedTuple):
    """Gradients of the inputs of ``pack``, and of offsets of the means on screen in halves of the image size."""

    means2d: Tensor
    conics: Tensor
    depths: Tensor | None
    opacities: Tensor
    features: Tensor
    screen_offsets: Tensor | None


def unpack(
    rows: Rows,
    v_rows: Tensor,
    size: tuple[int, int],
    with_offsets: bool = False,
    imagegrad: bool = False,
) -> PackGradients:
    """The backward pass of ``pack``.

    Args:
        rows: First result of ``pack``.
        v_rows: [shards, N, gradient_stride] sums from ``composite_bwd``.
        size: (width, height) of the image [px].
        with_offsets: Whether to return the gradient of ``screen_offsets``.
        imagegrad: As in ``composite_bwd``.
    """
    N, new = rows.packed.shape[0], rows.packed.new_empty
    v_splats = PackGradients(
        means2d=new(N, 2),
        conics=new(N, 3),
        depths=new(N) if rows.with_depth else None,
        opacities=new(N),
        features=new(N, rows.num_features),
        screen_offsets=new(N, 2) if with_offsets else None,
    )
    inputs = (rows.packed, v_rows, 0.5 * size[0], 0.5 * size[1], int(imagegrad))
    launch(kernels.make_unpack(rows.num_features, rows.with_depth), N, *inputs, *v_splats)
    return v_splats


def unpack_and_unproject(
    geometry: Geometry,
    view: View,
    antialias: bool,
    splats: PackedSplats,
    v_rows: Tensor,
    with_offsets: bool = False,
    imagegrad: bool = False,
) -> tuple[Geometry, tuple[Tensor | None, Tensor | None], Tensor, Tensor | None]:
    """The backward pass of ``project_and_pack``, in one kernel.

    Args:
        geometry, view, antialias: As in the forward pass.
        splats: Its first result.
        v_rows, with_offsets, imagegrad: As in ``unpack``.

    Returns:
        Gradients of the geometry; of ``viewmat`` and ``K``, if one of them requires a gradient; of the features; and of
        ``screen_offsets``.
    """
    (radii, rows), means = splats, geometry.means
    N = means.shape[0]
    v_features, v_offsets = means.new_empty(N, rows.num_features), means.new_empty(N, 2) if with_offsets else None
    v_geometry, v_cameras = new_geometry(geometry), new_camera_gradients(view, N)
    inputs = (*geometry, *view, int(antialias), radii, rows.packed, v_rows, int(imagegrad))
    kernel = kernels.make_unpack_and_unproject(rows.num_features, rows.with_depth)
    launch(kernel, N, *inputs, v_features, v_offsets, *v_geometry, v_cameras, None)
    return v_geometry, sum_camera_gradients(view, v_cameras), v_features, v_offsets
