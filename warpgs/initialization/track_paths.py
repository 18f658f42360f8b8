"""Tracks of a network as rays and points, as far as masks mark what they show as dynamic."""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from warpgs.data import depth_alignment
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.data.tracks import Tracks
from warpgs.views.part import SomeViews

MIN_SEEN, MIN_DYNAMIC = 4, 0.5
"""Minimum number of training frames in which a track is on what moves, and minimum part of those that see it."""

MAX_PATHS = 3_000
"""Maximum number of tracks that are used."""


class Paths(NamedTuple):
    """Points on what moves, each as some of the T training views see it; on the CPU.

    Attributes:
        origins: [T, 3] centres of the cameras [scene units].
        rays: [N, T, 3] directions of unit length in which the points are seen; NaN where they are not.
        points: [N, T, 3] where the aligned depth of the views puts them [scene units]; NaN where that is unknown.
        colors: [N, 3] mean of their colours in [0, 1].
    """

    origins: Float[Tensor, "T 3"]
    rays: Float[Tensor, "N T 3"]
    points: Float[Tensor, "N T 3"]
    colors: Float[Tensor, "N 3"]

    def chosen(self, paths: Tensor) -> "Paths":
        """The paths with these indices, or those marked true."""
        return Paths(self.origins, self.rays[paths], self.points[paths], self.colors[paths])


@torch.no_grad()
def dynamic_paths(tracks: Tracks, names: list[str], views: SomeViews, alignments: Float[Tensor, "T 2"]) -> Paths:
    """Tracks that stay on what masks mark as dynamic, at most ``MAX_PATHS``.

    Args:
        tracks: The tracks.
        names: Ids of the T training frames.
        views: Their views.
        alignments: [T, 2] scale and offset of each view's inverse depth.
    """
    positions = tracks.positions[:, [tracks.frames.index(name) for name in names]]
    origins, num = torch.zeros(len(names), 3, dtype=torch.float32), len(positions)
    rays, points, colors = torch.full((3, num, len(names), 3), torch.nan, dtype=torch.float32)
    for k, view in enumerate(views.each(range(len(views)))):
        camera, (height, width) = view.camera, view.static_mask.shape
        placed = torch.from_numpy(positions[:, k] * np.array([width, height], np.float32)).to(views.device)
        column, row = placed.nan_to_num(0.0).long().unbind(1)
        row, column = row.clamp(0, height - 1), column.clamp(0, width - 1)
        seen = placed[:, 0].isfinite() & ~view.static_mask[row, column]
        along = camera.rays(placed[seen]) @ camera.viewmat[:3, :3]
        depth = depth_alignment.metric_depth(view.inverse_depth, alignments[k])[row, column][seen]
        shown = seen.cpu()
        origins[k] = camera.position.cpu()
        rays[shown, k], points[shown, k] = (
            normalize(along, dim=1).cpu(),
            (camera.position + along * depth[:, None]).cpu(),
        )
        colors[shown, k] = view.image[row, column][seen].cpu()
    num_dynamic, num_seen = rays[..., 0].isfinite().sum(1), torch.from_numpy(np.isfinite(positions[..., 0]).sum(1))
    used = (num_dynamic >= MIN_SEEN) & (num_dynamic >= MIN_DYNAMIC * num_seen)
    indices = used.nonzero()[:, 0]
    indices = indices[evenly_spaced_indices(len(indices), MAX_PATHS)]
    return Paths(origins, rays, points, colors.nanmean(1)).chosen(indices)
