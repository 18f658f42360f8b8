"""The sky: colours by direction, infinitely far behind all Gaussians.

The colours are an equirectangular image, not a cube map: one texture without seams between faces, and the image that
dome lights and environment maps are. Its columns go once around the world's z axis,

    column = W atan2(y, x) / 2π  (mod W),        row = H (1/2 − atan2(z, √(x² + y²)) / π),

for a direction (x, y, z), and are interpolated linearly between the centres of texels.
"""

import copy
import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from warpgs.cameras import Camera

ROWS, COLUMNS = 512, 1024
"""Size of the image: a texel is 0.35 degrees across."""

MIN_SEEN = 0.5
"""What must pass through the Gaussians of a pixel for it to change the colours behind them: Adam would follow what
passes through walls as readily as the open sky."""

BEYOND = 1.5
"""The sky is this many times as far as the farthest points, as far as depth tells. Pixels in between may show it, whose
depth may be wrong; nearer ones do not, even while Gaussians let it through."""


class Dome(nn.Module):
    """Colours by direction.

    Attributes:
        texels: [3, ROWS, COLUMNS] red, green and blue, from the z axis down.
        far: [] inverse depth up to which a pixel shows the dome, as far as depth is known; negative if no depth tells
            the sky [1 / scene units].
    """

    far: Tensor

    def __init__(self, texels: Float[Tensor, "3 rows columns"] | None = None, far: float = -1.0) -> None:
        super().__init__()
        self.texels = nn.Parameter(torch.zeros(3, ROWS, COLUMNS, dtype=torch.float32) if texels is None else texels)
        self.register_buffer("far", torch.tensor(far, dtype=torch.float32))

    def forward(self, camera: Camera, rays: Float[Tensor, "P 3"] | None = None) -> Float[Tensor, "H W 3"]:
        """The colours that a camera sees where nothing is in front; poses get no gradient.

        ``rays`` are those of ``Camera.directions``.
        """
        _, rows, columns = self.texels.shape
        column, row = torch.unbind(positions(camera, rows, columns, rays), -1)
        wrapped = torch.cat([self.texels[..., -1:], self.texels, self.texels[..., :1]], 2)
        grid = torch.stack([2.0 * (column + 1.0) / (columns + 1.0), 2.0 * row / (rows - 1.0)], -1) - 1.0
        return grid_sample(wrapped[None], grid[None], "bilinear", "border", align_corners=True)[0].permute(1, 2, 0)

    def hidden(self, inverse_depth: Float[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
        """Pixels that do not show the sky, by their inverse depth, NaN where unknown [1 / scene units]."""
        return (inverse_depth > BEYOND * self.far) & (self.far > 0.0)

    def image(self) -> UInt8[np.ndarray, "rows columns 3"]:
        """The colours as an image, for programs that show it."""
        return (255.0 * self.texels.detach().permute(1, 2, 0).clamp(0.0, 1.0)).round().byte().cpu().numpy()

    def moved_to(self, device: torch.device | str) -> "Dome":
        """A copy on another device."""
        return copy.deepcopy(self).to(device)


@torch.no_grad()
def positions(
    camera: Camera, rows: int, columns: int, rays: Float[Tensor, "P 3"] | None = None
) -> Float[Tensor, "H W 2"]:
    """(column, row) of the colour that each pixel of a camera shows, 0 at the centre of the first texel."""
    x, y, z = camera.directions(rays).nan_to_num(0.0).unbind(1)
    column = (torch.atan2(y, x) / (2.0 * math.pi)).remainder(1.0) * columns - 0.5
    row = (0.5 - torch.atan2(z, torch.hypot(x, y)) / math.pi) * rows - 0.5
    return torch.stack([column, row], 1).view(camera.height, camera.width, 2)


@torch.no_grad()
def seen_colors(
    seen: Sequence[tuple[Camera, Float[Tensor, "H W 3"], Bool[Tensor, "H W"]]], rows: int, columns: int
) -> Float[Tensor, "3 rows columns"]:
    """Mean colours by direction of the pixels that show the sky; where none does, smooth ones from around.

    Args:
        seen: Camera, image and mask of the pixels that count, of some frames; all on the CPU.
        rows, columns: Size of the result; powers of two.
    """
    total = torch.zeros(rows * columns, 4, dtype=torch.float64)
    for camera, image, mask in seen:
        mask = mask & camera.directions().isfinite().all(1).view_as(mask)
        column, row = positions(camera, rows, columns)[mask].round().long().unbind(1)
        texel = row.clamp(0, rows - 1) * columns + column % columns
        total.index_add_(0, texel, torch.cat([image[mask], torch.ones(len(texel), 1)], 1).double())
    return _filled(total.view(rows, columns, 4)).permute(2, 0, 1).float().contiguous()


def _filled(total: Float[Tensor, "rows columns 4"]) -> Float[Tensor, "rows columns 3"]:
    """Means of sums of colours and of their number; without any, those of an image of half the size, and so on."""
    color, count = total[..., :3], total[..., 3:]
    rows, columns, _ = total.shape
    mean = color / count.clamp_min(1.0)
    if rows == 1:
        everywhere = color.sum((0, 1)) / count.sum() if bool((count > 0).any()) else torch.full_like(color[0, 0], 0.5)
        return torch.where(count > 0, mean, everywhere)
    known = torch.cat([mean, torch.ones_like(count)], 2) * (count > 0)
    coarse = _filled(known.view(rows // 2, 2, columns // 2, 2, 4).sum((1, 3)))
    wrapped = torch.cat([coarse[:, -1:], coarse, coarse[:, :1]], 1).permute(2, 0, 1)[None]
    smooth = torch.nn.functional.interpolate(wrapped, scale_factor=2, mode="bilinear", align_corners=False)[0]
    return torch.where(count > 0, mean, smooth.permute(1, 2, 0)[:, 2:-2])
