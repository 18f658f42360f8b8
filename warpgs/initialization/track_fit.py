"""Tracks in the fit of the deformation: each is a canonical point that is deformed to where frames see it."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from scipy.spatial import cKDTree
from torch import Tensor, nn

from .point_cloud import subsample
from .track_paths import Paths

MAX_PER_VIEW = 600
"""Maximum number of tracks that a view is compared with."""

NUM_NEAREST = 8
"""Number of tracks around one that tell where it is in canonical space at first."""

DEPTH_WEIGHT = 0.1
"""Weight of squared distances along rays, which depth tells, relative to those across, which tracks tell."""

SQUARED_SCALE = 1.0
"""Squared distance from which on distances count less and less (Cauchy): tracks may jump to other points, and drift."""


class TrackFit:
    """Canonical points of tracks, and where the V views of a fit see them.

    Args:
        paths: The tracks; those without any known depth are omitted.
        views: Indices of the views, by their distance in time from the canonical points.
        unit: Length that counts as 1 [scene units].
        device: Of the tensors.
        generator: CPU generator that chooses the tracks of views with more than ``MAX_PER_VIEW``.

    Attributes:
        anchors: [N, 3] canonical points [units].
        colors: [N, 3] their colours in [0, 1].
    """

    def __init__(
        self, paths: Paths, views: list[int], unit: float, device: torch.device, generator: torch.Generator
    ) -> None:
        anchors = torch.from_numpy(_first_anchors((paths.points[:, views] / unit).numpy()))
        used = anchors[:, 0].isfinite()
        paths, self.unit = paths.chosen(used), unit
        rays, points = paths.rays[:, views], paths.points[:, views] / unit
        rows = [_some_rows(rays[:, k, 0].isfinite(), generator) for k in range(len(views))]
        size = max(map(len, rows), default=0)
        padded = torch.stack([torch.cat([part, part.new_full((size - len(part),), -1)]) for part in rows])
        seen, which = padded >= 0, padded.clamp_min(0)
        view = torch.arange(len(views))[:, None]
        rays, points = rays[which, view], points[which, view]
        known = seen & points[..., 0].isfinite()
        self.anchors = nn.Parameter(anchors[used].to(device))
        self.colors = paths.colors.to(device)
        self._tracks, self._seen, self._known = which.to(device), seen.to(device), known.to(device)
        self._rays = torch.where(seen[..., None], rays, 0.0).to(device)
        self._points = torch.where(known[..., None], points, 0.0).to(device)
        self._origins = (paths.origins[views] / unit).to(device)

    def loss(self, deformation: nn.Module, time: Float[Tensor, "1"], index: Int64[Tensor, "1"]) -> Float[Tensor, ""]:
        """Robust mean squared distance of deformed canonical points from where the view of an index sees them."""
        across, along, seen = self._away(deformation, time, index)
        squared = across.square().sum(1) + DEPTH_WEIGHT * along.square()
        robust = SQUARED_SCALE * torch.log1p(squared / SQUARED_SCALE)
        return (robust * seen).sum() / seen.sum().clamp_min(1)

    def _away(
        self, deformation: nn.Module, time: Float[Tensor, "1"], index: Int64[Tensor, "1"]
    ) -> tuple[Float[Tensor, "P 3"], Float[Tensor, " P"], Bool[Tensor, " P"]]:
        """How far deformed canonical points are from the rays of a view, and along them from their depth [units]."""
        inputs = (self._tracks, self._rays, self._points, self._known, self._seen, self._origins)
        tracks, rays, points, known, seen, origin = (values.index_select(0, index)[0] for values in inputs)
        anchors = self.anchors[tracks]
        moved = anchors + deformation(anchors * self.unit, time)[:, :3] / self.unit
        away = moved - origin
        across = away - (away * rays).sum(1, keepdim=True) * rays
        return across, ((moved - points) * rays).sum(1) * known, seen

    @torch.no_grad()
    def followed(self, deformation: nn.Module, times: Float[Tensor, "V 1"], max_error: float) -> Bool[Tensor, " N"]:
        """Which tracks are deformed to within a distance [scene units] of the rays of most views that see them."""
        misses = torch.full((len(self.anchors), len(times)), torch.nan, device=self.anchors.device)
        for k, time in enumerate(times):
            across, _, seen = self._away(deformation, time, torch.tensor([k], device=misses.device))
            misses[self._tracks[k][seen], k] = across.norm(dim=1)[seen] * self.unit
        return misses.nanmedian(1).values <= max_error


def _some_rows(seen: Bool[Tensor, " N"], generator: torch.Generator) -> Int64[Tensor, " P"]:
    """Indices of at most ``MAX_PER_VIEW`` of the tracks that are marked true."""
    rows = seen.nonzero()[:, 0]
    return rows[subsample(rows, MAX_PER_VIEW, generator)]


def _first_anchors(points: Float[np.ndarray, "N V 3"]) -> Float[np.ndarray, "N 3"]:
    """Canonical points, as if each moved from view to view like those around it that are known; NaN without depth.

    The first view has the canonical points, the others follow by their distance in time from it.
    """
    anchors = np.full((len(points), 3), np.nan, np.float32)
    for k in range(points.shape[1]):
        at = points[:, k]
        known, placed = np.isfinite(at[:, 0]), np.isfinite(anchors[:, 0])
        new, old = known & ~placed, known & placed
        if not old.any():
            anchors[new] = at[new]
        elif new.any():
            nearest = cKDTree(at[old]).query(at[new], k=range(1, 1 + min(NUM_NEAREST, int(old.sum()))))[1]
            anchors[new] = at[new] + np.median((anchors[old] - at[old])[nearest], axis=1)
    return anchors
