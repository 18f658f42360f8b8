"""Alpha compositing of splats into one or three images, and its backward pass (kernels/compositing_{fwd,bwd}.py)."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.kernels.compositing_bwd import make_composite_bwd
from warpgs.kernels.compositing_fwd import make_composite_fwd
from warpgs.kernels.constants import TILE_SIZE
from warpgs.kernels.lanes import BLOCK_DIM, WARP_COLUMNS, WARP_ROWS, WARP_SIZE
from warpgs.kernels.rows import gradient_stride
from warpgs.runtime.launch import is_small, launch, num_shards
from warpgs.runtime.tape import Gradients

from .rows import Rows
from .tiles import Tiles

NUM_BRANCH_IMAGES = 3
"""Joint, static only, dynamic only."""

CUDA_PIXELS = (1, 2)
"""Columns and rows of the pixels that a lane composites on CUDA (alternatives: docs/design/lane-groups.md)."""

SMALL_IMAGE_CUDA_PIXELS = (1, 1)
"""``CUDA_PIXELS`` of small images, which would otherwise have too few lanes to keep a GPU busy."""

CPU_PIXELS = (TILE_SIZE, TILE_SIZE)

WORK = TILE_SIZE * TILE_SIZE
"""``work`` of a thread on CPU, as ``launch`` counts it."""

MAX_PIXELS = 1 << 31
"""All images together must have fewer pixels than this, because kernels count pixels with ints."""


class Composite(NamedTuple):
    """Output of compositing: one entry per image (joint; or joint, static, dynamic), and optional statistics.

    Attributes:
        images: [H, W, C] each.
        alphas: [H, W] each, opacity in [0, 1 - 1e-4).
        depths: [H, W] each, mean depth weighted by contribution, or median depth [scene units], 0 in empty pixels; none
            without depth.
        statistics: Nothing, or [N] whether the Gaussian changed a pixel of the joint image and [N] sum of its alpha
            times transmittance over that image; not differentiable.
    """

    images: tuple[Float[Tensor, "H W C"], ...]
    alphas: tuple[Float[Tensor, "H W"], ...]
    depths: tuple[Float[Tensor, "H W"], ...]
    statistics: tuple[Tensor, ...]

    @property
    def layers(self) -> tuple[Tensor, ...]:
        """All images, then all alphas, then all depths: what has gradients."""
        return (*self.images, *self.alphas, *self.depths)


class PixelState(NamedTuple):
    """What the forward pass leaves of each pixel, as arguments of the backward kernel.

    Attributes:
        depth: [pixels of all images, in any shape] rendered depth; None without.
        transmittance: [the same] at the end of each pixel.
        last: [the same] int32 number of Gaussians of the list until the last one that contributed.
        joint_state: [blocks] int32, see ``equals_joint``; None for a single image.
    """

    depth: Tensor | None
    transmittance: Tensor
    last: Tensor
    joint_state: Tensor | None


class Traversal(NamedTuple):
    """What the forward pass leaves for the backward pass besides rows and layers.

    It is valid together with these lists only: the number of intersections may differ where a render is repeated.

    Attributes:
        num_images: 1, or 3 with branches.
        pixels: Columns and rows of the pixels of a lane.
        num_threads: Of both kernels.
        lists: Arguments of both kernels, from ``tile_ranges`` to ``half``: the Gaussians of each tile.
        view: Arguments of both kernels, from ``background_stride`` to ``max_alpha``.
        state: Of the pixels of all images.
    """

    num_images: int
    pixels: tuple[int, int]
    num_threads: int
    lists: tuple[Tensor, Tensor | None, Tensor, int]
    view: tuple[int, int, int, float]
    state: PixelState


def _layout(size: tuple[int, int], tiles: Tiles) -> tuple[tuple[int, int], int, int]:
    """Columns and rows of the pixels of a lane, number of blocks of an image, lanes per block."""
    num_tiles = tiles.ranges.shape[0]
    if tiles.ranges.is_cuda:
        columns, rows = SMALL_IMAGE_CUDA_PIXELS if is_small(size) else CUDA_PIXELS
        block_size, lanes = (WARP_COLUMNS * columns, WARP_ROWS * rows), WARP_SIZE
    else:
        columns, rows = block_size = CPU_PIXELS
        lanes = 1
    blocks_of_tile = (TILE_SIZE // block_size[0]) * (TILE_SIZE // block_size[1])
    return (columns, rows), num_tiles * blocks_of_tile, lanes


def composite_fwd(
    rows: Rows,
    tiles: Tiles,
    size: tuple[int, int],
    background: Tensor | None,
    statistics: bool,
    max_alpha: float,
    median: bool = False,
) -> tuple[Composite, Traversal]:
    """Composites packed rows: three images if the tiles have branches, otherwise one.

    Args:
        rows, tiles: N packed splats, and their tiles.
        size: (width, height) [px].
        background: [features], or [images, features] with one for each image; None is black. Depth has none.
        statistics: Whether to report the contribution of each Gaussian.
        max_alpha, median: As in ``RenderSettings``.

    Raises:
        ValueError: If all images together have too many pixels to be counted.
    """
    num_images, (packed, num_features, with_depth) = _num_images(tiles, size), rows
    new = packed.new_empty
    pixels, blocks, lanes = _layout(size, tiles)
    stride = 0 if background is None or background.ndim == 1 else num_features
    shape = size[::-1] if num_images == 1 else (num_images, *size[::-1])
    image, alpha, depth = new(*shape, num_features), new(*shape), new(*shape) if with_depth else None
    own_depth = None if depth is None else depth.detach()  # an output itself would keep its own node alive
    joint_state = None if num_images == 1 else tiles.ranges.new_zeros(blocks)
    state = PixelState(own_depth, new(*shape), tiles.ranges.new_empty(*shape), joint_state)
    lists = (tiles.ranges, tiles.branch_lengths, tiles.gaussian_from_isect, tiles.half)
    traversal = Traversal(num_images, pixels, num_images * blocks * lanes, lists, (stride, *size, max_alpha), state)
    contributed, weights = _statistics(packed) if statistics else (None, None)
    kernel = make_composite_fwd(num_features, with_depth, num_images, pixels, statistics, median)
    inputs = (*traversal.lists, packed, background, *traversal.view)
    outputs = (image, depth, alpha, state.transmittance, state.last, state.joint_state, contributed)
    launch(kernel, traversal.num_threads, *inputs, *outputs, per_shard=(weights,), block_dim=BLOCK_DIM, work=WORK)
    found = () if contributed is None or weights is None else (contributed.view(torch.bool), weights.sum(0))
    images, alphas, depths = (_layers(t, num_images) for t in (image, alpha, depth))
    return Composite(images, alphas, depths, found), traversal


def _num_images(tiles: Tiles, size: tuple[int, int]) -> int:
    """The number of images of tiles; raises ValueError if they have too many pixels."""
    (width, height), number = size, 1 if tiles.branch_lengths is None else NUM_BRANCH_IMAGES
    if number * height * width >= MAX_PIXELS:
        raise ValueError(f"{number} images of {width} x {height} pixels are too large to be rendered at once")
    return number


def _statistics(packed: Tensor) -> tuple[Tensor, Tensor]:
    """Zeros for ``contributed`` and, of each shard, ``weights``."""
    count = packed.shape[0]
    return packed.new_zeros(count, dtype=torch.uint8), packed.new_zeros(num_shards(packed), count)


def _layers(tensor: Tensor | None, num_images: int) -> tuple[Tensor, ...]:
    """The layer of each image, detached from each other, so that they may be modified in place."""
    if tensor is None:
        return ()
    return (tensor,) if num_images == 1 else tuple(layer.detach() for layer in tensor)


def composite_bwd(
    rows: Rows,
    background: Tensor | None,
    traversal: Traversal,
    v_layers: Gradients,
    absgrad: bool = False,
) -> Tensor:
    """Sums for ``project_bwd``, [shards, N, gradient_stride].

    Args:
        rows, background: As in ``composite_fwd``.
        traversal: Its second result.
        v_layers: Gradients of ``Composite.layers``; None for zeros.
        absgrad: Whether to sum the absolute values of each pixel's gradient of the means on screen, too.
    """
    num_images, images_with_gradient = traversal.num_images, 0  # a bit for each image
    v_arrays: list[Tensor | None] = [None] * (3 * NUM_BRANCH_IMAGES)  # images, alphas, depths
    for k, v in enumerate(v_layers):
        if v is not None:
            v_arrays[k // num_images * NUM_BRANCH_IMAGES + k % num_images] = v
            images_with_gradient |= 1 << (k % num_images)
    packed, num_features, with_depth = rows
    v_rows = packed.new_zeros(num_shards(packed), packed.shape[0], gradient_stride(rows.num_channels))
    kernel = make_composite_bwd(num_features, with_depth, num_images, traversal.pixels, absgrad)
    inputs = (*traversal.lists, packed, background, *traversal.view, *traversal.state, *v_arrays, images_with_gradient)
    launch(kernel, traversal.num_threads, *inputs, per_shard=(v_rows,), block_dim=BLOCK_DIM, work=WORK)
    return v_rows


def background_bwd(background: Tensor, alphas: Sequence[Tensor], v_images: Gradients) -> Tensor:
    """Gradient of the background: what passes through each image, Σ (1 − alpha) v_image over its pixels."""
    v_colors = background.new_zeros(len(alphas), background.shape[-1])
    for v_color, alpha, v_image in zip(v_colors, alphas, v_images, strict=True):
        if v_image is not None:
            v_color.copy_(((1.0 - alpha).view(1, -1) @ v_image.view(-1, len(v_color)))[0])
    return v_colors.sum(0) if background.ndim == 1 else v_colors
