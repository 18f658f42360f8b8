"""Alpha compositing of splats into one or three images, and the way back (kernels/compositing_{fwd,bwd}.py)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.kernels.compositing_bwd import make_composite_bwd
from warpgs.kernels.compositing_fwd import make_composite_fwd
from warpgs.kernels.constants import TILE_SIZE
from warpgs.kernels.lanes import BLOCK_DIM, WARP_COLUMNS, WARP_ROWS, WARP_SIZE
from warpgs.kernels.rows import gradient_stride
from warpgs.runtime.checks import check_image_size, check_same_device, check_tensor
from warpgs.runtime.launch import PerShard
from warpgs.runtime.tape import Run, differentiable

from .projection import Projection
from .rows import Rows
from .tiles import Tiles, record_tiles

NUM_BRANCH_IMAGES = 3
"""Joint, static only, dynamic only."""

CUDA_PIXELS = (1, 2)
"""Columns and rows of pixels that a lane composites on CUDA; the alternatives are in docs/performance.md."""

CUDA_PIXELS_OF_SMALL = (1, 1)
"""The same in small images, which else have too few lanes to keep a GPU busy."""

SMALL = 1 << 18
"""Pixels that a small image has at most."""

CPU_PIXELS = (TILE_SIZE, TILE_SIZE)

MAX_PIXELS = 1 << 31
"""Pixels that there must be fewer of in all images, because kernels count them with ints."""


class Composite(NamedTuple):
    """What compositing makes: one entry per image (joint; or joint, static, dynamic), and statistics if asked for.

    Attributes:
        images: [H, W, C] each.
        alphas: [H, W] each, the opacity that the splats leave, in [0, 1 - 1e-4).
        depths: [H, W] each, mean depth of what was drawn, weighted by its contribution [scene units], 0 where nothing
            was; none unless the rows have depth.
        norms: [N, 2] screen-space gradient norms, filled on the way back; see ``Rows``. No gradient flows from them.
        contributed: [N] whether the Gaussian changed a pixel of the joint image.
        weights: [N] sum over pixels of the joint image of alpha times transmittance; no gradient flows from them.
    """

    images: tuple[Float[Tensor, "H W C"], ...]
    alphas: tuple[Float[Tensor, "H W"], ...]
    depths: tuple[Float[Tensor, "H W"], ...]
    norms: Float[Tensor, "N 2"]
    contributed: Bool[Tensor, " N"] | None
    weights: Float[Tensor, " N"] | None

    def flat(self) -> tuple[Tensor, ...]:
        """As a tuple of tensors, the way ``differentiable`` wants it."""
        statistics = () if self.contributed is None or self.weights is None else (self.contributed, self.weights)
        return (*self.images, *self.alphas, *self.depths, self.norms, *statistics)

    @staticmethod
    def from_flat(tensors: tuple[Tensor, ...], num_images: int, with_depth: bool) -> "Composite":
        n, m = num_images, num_images * int(with_depth)
        norms, *statistics = tensors[2 * n + m :]
        contributed, weights = statistics or (None, None)
        # Nobody can go back from these; with autograd's node they would keep the memory of the way back.
        norms, weights = norms.detach(), None if weights is None else weights.detach()
        return Composite(tensors[:n], tensors[n : 2 * n], tensors[2 * n : 2 * n + m], norms, contributed, weights)


def is_small(size: tuple[int, int]) -> bool:
    """Whether an image of a size (width, height) is better cut into smaller pieces on a GPU."""
    return size[0] * size[1] <= SMALL


def _cut(run: Run, size: tuple[int, int], num_tiles: int) -> tuple[tuple[int, int], int, int]:
    """How an image is cut up: columns and rows of pixels of a lane, number of blocks, lanes of the group of each."""
    if not run.is_cuda:
        return CPU_PIXELS, num_tiles, 1
    columns, rows = CUDA_PIXELS_OF_SMALL if is_small(size) else CUDA_PIXELS
    blocks_of_tile = (TILE_SIZE // (WARP_COLUMNS * columns)) * (TILE_SIZE // (WARP_ROWS * rows))
    return (columns, rows), num_tiles * blocks_of_tile, WARP_SIZE


def record_composite(
    run: Run,
    rows: Rows,
    tiles: Tiles,
    size: tuple[int, int],
    background: Tensor | None,
    statistics: bool,
    absgrad: bool,
) -> Composite:
    """Composites packed rows. Of tiles with branches three images come out, otherwise one.

    ``background`` is [features], or [images, features] with another one for each image; none is black. There is none
    behind depth.

    Raises:
        ValueError: If all images together have too many pixels to be counted.
    """
    width, height = size
    C, num_features = rows.num_channels, rows.num_features
    N = rows.packed.shape[0]
    images = 1 if tiles.branch_lengths is None else NUM_BRANCH_IMAGES
    if images * height * width >= MAX_PIXELS:
        raise ValueError(f"{images} images of {width} x {height} pixels are too large to be drawn at once")
    image, alpha = run.empty(images, height, width, num_features), run.empty(images, height, width)
    depth = run.empty(images, height, width) if rows.with_depth else None
    layers = (tuple(image), tuple(alpha), () if depth is None else tuple(depth))
    transmittance, last = run.empty(alpha.numel()), run.empty(alpha.numel(), dtype=torch.int32)
    behind = None if background is None else background.view(-1)
    stride = 0 if background is None or background.ndim == 1 else num_features
    contributed = run.zeros(N, dtype=torch.uint8) if statistics else None
    weights = run.zeros(run.num_shards, N) if statistics else None

    pixels, blocks, lanes = _cut(run, size, len(tiles.ranges))
    looked = None if images == 1 else run.zeros(blocks, dtype=torch.int32)

    def launch(run: Run, make_kernel: Callable[..., Any], flag: bool, *arguments: Any) -> None:
        """Launches a compositing kernel over all blocks of pixels in all images."""
        run.launch(
            make_kernel(num_features, rows.with_depth, images, pixels, flag),
            images * blocks * lanes,
            *arguments,
            block_dim=BLOCK_DIM,
            work=TILE_SIZE * TILE_SIZE,
        )

    lists = (tiles.ranges, tiles.branch_lengths, tiles.gaussian_from_isect, tiles.half)
    drawn = None if depth is None else depth.view(-1)
    launch(
        run,
        make_composite_fwd,
        statistics,
        *lists,
        rows.packed,
        behind,
        stride,
        width,
        height,
        image.view(-1, num_features),
        drawn,
        alpha.view(-1),
        transmittance,
        last,
        looked,
        contributed,
        None if weights is None else PerShard(weights),
    )

    wanted_background = None if background is None or not run.wants(background) else background

    def backward(run: Run) -> None:
        v_layers = [[run.adjoint(t) for t in tensors] for tensors in layers]
        arrived = sum({1 << m for values in v_layers for m, v in enumerate(values) if v is not None})
        if arrived == 0:
            return
        missing: list[Tensor | None] = [None] * NUM_BRANCH_IMAGES
        gradients = run.zeros(run.num_shards, N, gradient_stride(C))
        launch(
            run,
            make_composite_bwd,
            absgrad,
            *lists,
            rows.packed,
            behind,
            stride,
            width,
            height,
            drawn,
            transmittance,
            last,
            looked,
            *(None if v is None else v.view(-1) for values in v_layers for v in (values + missing)[:NUM_BRANCH_IMAGES]),
            arrived,
            PerShard(gradients),
        )
        run.add_adjoint(rows.packed, gradients)
        if wanted_background is not None:
            seen = (1.0 - alpha).view(images, 1, -1)
            v_behind = run.zeros(images, num_features)
            for m, v_image in enumerate(v_layers[0]):
                if v_image is not None:
                    v_behind[m] = (seen[m] @ v_image.view(-1, num_features))[0]
            run.add_adjoint(wanted_background, v_behind.sum(0) if stride == 0 else v_behind)

    run.on_backward(backward, reads=(*layers[2], *(() if wanted_background is None else layers[1])))
    return Composite(
        *layers,
        norms=rows.norms,
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
    absgrad: bool = False,
) -> Composite:
    """Composites projected splats front to back; differentiable in their geometry, opacities, features, background.

    Args:
        splats: From ``project``. Splats with a conic that is not positive definite, an opacity outside [1/255, 1] or a
            value that is not finite are not drawn.
        features: [N, C] values to blend, any number of channels.
        size: (width, height) [px].
        background: [C] value behind everything; zero by default.
        is_dynamic: [N] branch of each splat; if given, three images are made: joint, static only, dynamic only.
        statistics: Whether to report what each splat contributed.
        absgrad: Whether the way back also gathers the absolute-value gradient norms.

    Returns:
        A ``Composite``.

    Raises:
        ValueError: On a wrong shape, dtype, device or size.
    """
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
    branch = None
    if is_dynamic is not None:
        check_tensor("is_dynamic", is_dynamic, ("N",), sizes, (torch.bool,))
        branch = is_dynamic.view(torch.uint8)
    check_same_device({**splats._asdict(), "features": features, "background": background, "is_dynamic": is_dynamic})
    check_image_size(*size)

    def op(
        run: Run,
        means2d: Tensor,
        conics: Tensor,
        depths: Tensor,
        opacities: Tensor,
        features: Tensor,
        behind: Tensor | None,
    ) -> tuple[Tensor, ...]:
        projection = Projection(means2d, conics, depths, opacities, splats.radii)
        rows = Rows(run, projection, features.shape[1], False, size)
        tiles = record_tiles(run, rows, size, branch)
        rows.add_features(run, features)
        return record_composite(run, rows, tiles, size, behind, statistics, absgrad).flat()

    tensors = differentiable(op, splats.means2d, splats.conics, splats.depths, splats.opacities, features, background)
    return Composite.from_flat(tensors, 1 if is_dynamic is None else NUM_BRANCH_IMAGES, with_depth=False)
