"""Alpha compositing of splats into one or three images, and its backward pass (kernels/compositing_{fwd,bwd}.py)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels.compositing_bwd import make_composite_bwd
from warpgs.kernels.compositing_fwd import make_composite_fwd
from warpgs.kernels.constants import TILE_SIZE
from warpgs.kernels.lanes import BLOCK_DIM, WARP_COLUMNS, WARP_ROWS, WARP_SIZE
from warpgs.kernels.rows import SecondNorm, gradient_stride
from warpgs.runtime.checks import check_image_size, check_same_device, check_tensor
from warpgs.runtime.launch import PerShard
from warpgs.runtime.tape import OpContext, differentiable

from .projection import Projection
from .rows import Rows
from .tiles import Tiles, record_tiles

NUM_BRANCH_IMAGES = 3
"""Joint, static only, dynamic only."""

CUDA_PIXELS = (1, 2)
"""Columns and rows of the pixels that a lane composites on CUDA (alternatives: docs/design/lane-groups.md)."""

SMALL_IMAGE_CUDA_PIXELS = (1, 1)
"""As ``CUDA_PIXELS``, for small images, which would otherwise have too few lanes to keep a GPU busy."""

MAX_SMALL_IMAGE_PIXELS = 1 << 18
"""Images of at most this number of pixels are small."""

CPU_PIXELS = (TILE_SIZE, TILE_SIZE)

MAX_PIXELS = 1 << 31
"""All images together must have fewer pixels than this, because kernels count pixels with ints."""


class Composite(NamedTuple):
    """Output of compositing: one entry per image (joint; or joint, static, dynamic), and optional statistics.

    Attributes:
        images: [H, W, C] each.
        alphas: [H, W] each, opacity in [0, 1 - 1e-4).
        depths: [H, W] each, mean depth weighted by contribution [scene units], 0 in empty pixels; an empty tuple unless
            the rows have depth.
        gradient_norms: [N, 2] screen-space gradient norms, filled by the backward pass; see ``Rows``. Not
            differentiable.
        contributed: [N] whether the Gaussian changed a pixel of the joint image.
        weights: [N] sum of alpha times transmittance over the pixels of the joint image; not differentiable.
    """

    images: tuple[Float[Tensor, "H W C"], ...]
    alphas: tuple[Float[Tensor, "H W"], ...]
    depths: tuple[Float[Tensor, "H W"], ...]
    gradient_norms: Float[Tensor, "N 2"]
    contributed: Bool[Tensor, " N"] | None
    weights: Float[Tensor, " N"] | None

    def flat(self) -> tuple[Tensor, ...]:
        """All tensors in one tuple, for ``differentiable``."""
        statistics = () if self.contributed is None or self.weights is None else (self.contributed, self.weights)
        return (*self.images, *self.alphas, *self.depths, self.gradient_norms, *statistics)

    @staticmethod
    def from_flat(tensors: tuple[Tensor, ...], num_images: int, with_depth: bool) -> "Composite":
        """The inverse of ``flat``."""
        n, m = num_images, num_images * int(with_depth)
        norms, *statistics = tensors[2 * n + m :]
        contributed, weights = statistics or (None, None)
        # These are not differentiable; with autograd's node attached they would keep the saved tensors alive.
        norms, weights = norms.detach(), None if weights is None else weights.detach()
        return Composite(tensors[:n], tensors[n : 2 * n], tensors[2 * n : 2 * n + m], norms, contributed, weights)


def is_small(size: tuple[int, int]) -> bool:
    """Whether an image of a size (width, height) should be split into smaller pieces on a GPU."""
    return size[0] * size[1] <= MAX_SMALL_IMAGE_PIXELS


def _layout(ctx: OpContext, size: tuple[int, int], num_tiles: int) -> tuple[tuple[int, int], int, int]:
    """Columns and rows of the pixels of a lane, number of blocks of an image, lanes per block."""
    if not ctx.is_cuda:
        return CPU_PIXELS, num_tiles, 1
    columns, rows = SMALL_IMAGE_CUDA_PIXELS if is_small(size) else CUDA_PIXELS
    blocks_of_tile = (TILE_SIZE // (WARP_COLUMNS * columns)) * (TILE_SIZE // (WARP_ROWS * rows))
    return (columns, rows), num_tiles * blocks_of_tile, WARP_SIZE


class _Images:
    """The images of one compositing, and what its forward and backward kernels have in common.

    Raises:
        ValueError: If all images together have too many pixels to be counted.
    """

    def __init__(
        self, ctx: OpContext, rows: Rows, tiles: Tiles, size: tuple[int, int], background: Tensor | None
    ) -> None:
        width, height = size
        images = 1 if tiles.branch_lengths is None else NUM_BRANCH_IMAGES
        if images * height * width >= MAX_PIXELS:
            raise ValueError(f"{images} images of {width} x {height} pixels are too large to be rendered at once")
        self._rows, self._num_images = rows, images
        self._background = None if background is None or not ctx.needs_gradient(background) else background
        self._stride = 0 if background is None or background.ndim == 1 else rows.num_features
        self._image = ctx.empty(images, height, width, rows.num_features)
        self._alpha = ctx.empty(images, height, width)
        depth = ctx.empty(images, height, width) if rows.with_depth else None
        self.layers = (tuple(self._image), tuple(self._alpha), () if depth is None else tuple(depth))
        self._depth = None if depth is None else depth.view(-1)
        num_pixels = images * height * width
        self._pixels, blocks, lanes = _layout(ctx, size, len(tiles.ranges))
        self._dim = images * blocks * lanes
        joint_state = None if images == 1 else ctx.zeros(blocks, dtype=torch.int32)
        self._saved = (ctx.empty(num_pixels), ctx.empty(num_pixels, dtype=torch.int32), joint_state)
        lists = (tiles.ranges, tiles.branch_lengths, tiles.gaussian_from_isect, tiles.half)
        colors = None if background is None else background.view(-1)
        self._inputs = (*lists, rows.packed, colors, self._stride, width, height)

    def composite(self, ctx: OpContext, contributed: Tensor | None, weights: Tensor | None) -> None:
        """Fills the images and, unless they are None, the statistics: [N] uint8 and [shards, N]; records backward."""
        image, alpha = self._image.view(-1, self._rows.num_features), self._alpha.view(-1)
        statistics = (contributed, None if weights is None else PerShard(weights))
        outputs = (image, self._depth, alpha, *self._saved, *statistics)
        self._launch(ctx, make_composite_fwd, weights is not None, *outputs)

    def record_backward(self, ctx: OpContext, second_norm: SecondNorm) -> None:
        """Records the backward pass, with a second gradient norm or without."""
        _, alphas, depths = self.layers
        ctx.on_backward(
            lambda ctx: self._backward(ctx, second_norm), reads=(*depths, *(() if self._background is None else alphas))
        )

    def _backward(self, ctx: OpContext, second_norm: SecondNorm) -> None:
        v_layers = [[ctx.gradient(t) for t in tensors] for tensors in self.layers]
        images_with_gradient = sum({1 << m for values in v_layers for m, v in enumerate(values) if v is not None})
        if images_with_gradient == 0:
            return
        rows = self._rows
        missing: list[Tensor | None] = [None] * NUM_BRANCH_IMAGES
        v_arrays = [None if v is None else v.view(-1) for vs in v_layers for v in (vs + missing)[:NUM_BRANCH_IMAGES]]
        gradients = ctx.zeros(ctx.num_shards, len(rows.packed), gradient_stride(rows.num_channels))
        inputs = (self._depth, *self._saved, *v_arrays, images_with_gradient)
        self._launch(ctx, make_composite_bwd, second_norm, *inputs, PerShard(gradients))
        ctx.add_gradient(rows.packed, gradients)
        if self._background is not None:
            ctx.add_gradient(self._background, self._background_gradient(ctx, v_layers[0]))

    def _background_gradient(self, ctx: OpContext, v_images: list[Tensor | None]) -> Tensor:
        num_features = self._rows.num_features
        transmittance = (1.0 - self._alpha).view(self._num_images, 1, -1)
        v_colors = ctx.zeros(self._num_images, num_features)
        for m, v_image in enumerate(v_images):
            if v_image is not None:
                v_colors[m] = (transmittance[m] @ v_image.view(-1, num_features))[0]
        return v_colors.sum(0) if self._stride == 0 else v_colors

    def _launch(
        self, ctx: OpContext, make_kernel: Callable[..., Any], variant: bool | SecondNorm, *arguments: Any
    ) -> None:
        """Launches a compositing kernel over all blocks of pixels of all images."""
        rows = self._rows
        kernel = make_kernel(rows.num_features, rows.with_depth, self._num_images, self._pixels, variant)
        work = TILE_SIZE * TILE_SIZE
        ctx.launch(kernel, self._dim, *self._inputs, *arguments, block_dim=BLOCK_DIM, work=work)


def record_composite(
    ctx: OpContext,
    rows: Rows,
    tiles: Tiles,
    size: tuple[int, int],
    background: Tensor | None,
    statistics: bool,
    second_norm: SecondNorm,
) -> Composite:
    """Composites packed rows as a part of a larger op: three images if the tiles have branches, otherwise one.

    Args:
        ctx: Of the op.
        rows: With features.
        tiles: Of the same rows.
        size: (width, height) [px].
        background: [features], or [images, features] with one for each image; None is black. Depth has none.
        statistics: Whether to fill ``contributed`` and ``weights``.
        second_norm: What the second column of ``gradient_norms`` is; zeros if None.

    Raises:
        ValueError: If all images together have too many pixels to be counted.
    """
    images = _Images(ctx, rows, tiles, size, background)
    N = len(rows.packed)
    contributed = ctx.zeros(N, dtype=torch.uint8) if statistics else None
    weights = ctx.zeros(ctx.num_shards, N) if statistics else None
    images.composite(ctx, contributed, weights)
    images.record_backward(ctx, second_norm)
    return Composite(
        *images.layers,
        gradient_norms=rows.gradient_norms,
        contributed=None if contributed is None else contributed.view(torch.bool),
        weights=None if weights is None else weights.sum(0),
    )


def composite(
    splats: Projection,
    features: Float[Tensor, "N C"],
    size: tuple[int, int],
    *,
    background: Float[Tensor, " C"] | None = None,
    is_dynamic: Bool[Tensor, " N"] | None = None,
    statistics: bool = False,
    second_norm: SecondNorm = None,
) -> Composite:
    """Composites projected splats front to back; differentiable in their geometry, opacities, features, background.

    Args:
        splats: From ``project``. Splats with a conic that is not positive definite, an opacity outside [1/255, 1] or a
            value that is not finite are skipped.
        features: [N, C] values to blend, any number of channels.
        size: (width, height) [px].
        background: [C] value behind everything; zero by default.
        is_dynamic: [N] branch of each splat; if given, three images are made: joint, static only, dynamic only.
        statistics: Whether to report the contribution of each splat.
        second_norm: What the second column of ``gradient_norms`` is; zeros if None.

    Raises:
        ValueError: On a wrong shape, dtype, device or size.
    """
    _check_inputs(splats, features, size, background, is_dynamic)
    branch = None if is_dynamic is None else is_dynamic.view(torch.uint8)

    def op(ctx: OpContext, *tensors: Any) -> tuple[Tensor, ...]:
        means2d, conics, depths, opacities, features, background = tensors
        projection = Projection(means2d, conics, depths, opacities, splats.radii.clone())  # packing writes to radii
        rows = Rows(ctx, projection, features.shape[1], False, size)
        tiles = record_tiles(ctx, rows, size, branch)
        rows.add_features(ctx, features)
        return record_composite(ctx, rows, tiles, size, background, statistics, second_norm).flat()

    tensors = differentiable(op, *splats[:4], features, background)
    return Composite.from_flat(tensors, 1 if is_dynamic is None else NUM_BRANCH_IMAGES, with_depth=False)


def _check_inputs(
    splats: Projection,
    features: Tensor,
    size: tuple[int, int],
    background: Tensor | None,
    is_dynamic: Tensor | None,
) -> None:
    sizes: dict[str, int] = {}
    check_tensor("splats.means2d", splats.means2d, ("N", 2), sizes)
    check_tensor("splats.conics", splats.conics, ("N", 3), sizes)
    check_tensor("splats.depths", splats.depths, ("N",), sizes)
    check_tensor("splats.opacities", splats.opacities, ("N",), sizes)
    check_tensor("splats.radii", splats.radii, ("N", 2), sizes, (torch.int32,))
    check_tensor("features", features, ("N", "C"), sizes)
    if features.shape[1] == 0:
        raise ValueError("features must have at least one channel, got none")
    if background is not None:
        check_tensor("background", background, ("C",), sizes)
    if is_dynamic is not None:
        check_tensor("is_dynamic", is_dynamic, ("N",), sizes, (torch.bool,))
    check_same_device({**splats._asdict(), "features": features, "background": background, "is_dynamic": is_dynamic})
    check_image_size(*size)
