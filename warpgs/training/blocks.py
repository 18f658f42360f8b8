"""Blocks of pixels: a coarse grid over an image of any size."""

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

GRID = 64
"""Blocks of an image along its larger side; they can be taken for dynamic one by one."""


def num_blocks(height: int, width: int) -> tuple[int, int]:
    """Rows and columns of the blocks of an image."""
    size = _block_size(height, width)
    return -(-height // size), -(-width // size)


def _block_size(height: int, width: int) -> int:
    """Side of the blocks of an image [px]; those at the right and lower edge may be smaller."""
    return -(-max(height, width) // GRID)


def block_means(values: Float[Tensor, "H W C"]) -> Float[Tensor, "h w C"]:
    """Means over the blocks of an image."""
    size = _block_size(*values.shape[:2])
    pooled = avg_pool2d(values.movedim(-1, 0), size, ceil_mode=True, count_include_pad=False)
    return pooled.movedim(0, -1)


def from_blocks(blocks: Bool[Tensor, "h w"], height: int, width: int) -> Bool[Tensor, "H W"]:
    """The value of its block for every pixel."""
    size = _block_size(height, width)
    return blocks.repeat_interleave(size, 0).repeat_interleave(size, 1)[:height, :width]
