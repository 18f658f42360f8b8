"""Points at which dynamic Gaussians start: pixels of what moves, unprojected."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from warpgs.config import TrainConfig
from warpgs.data import depth_alignment
from warpgs.data.capture import Capture
from warpgs.data.dynamic_regions import MIN_KNOWN_FRACTION
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.model.gaussians import Gaussians
from warpgs.views.part import SomeViews
from warpgs.views.views import View, Views

from .point_cloud import gaussians_at, random_points, subsample, unproject

MAX_PIXELS_PER_GAUSSIAN = 8
"""Maximum number of dynamic pixels that are unprojected per initial dynamic Gaussian."""

NUM_CHECKED = 8
"""Number of views in which the known depth of what moves is looked for."""

NUM_NEAREST_POINTS = 8
"""Number of points around a dynamic pixel that its depth is estimated from where it is unknown."""

DEPTH_FACTOR = 0.9
"""Estimated depth of a dynamic pixel, relative to the nearest of these points."""

MAX_POINTS_PER_IMAGE = 2_000
"""Maximum number of points per image among which they are searched."""

PIXELS_PER_CHUNK = 8_192
"""Number of pixels whose distances to the points are computed at once; keeps the table below 100 MB."""

MAX_SCALE = 0.019
"""Maximum standard deviation of initial dynamic Gaussians of unknown depth, as a fraction of the view size."""


NEWTON_STEPS, MAX_STEP = 12, 1.5
"""Maximum number of Newton steps with which a deformation is inverted, and the maximum length of a step relative to the
distance that is left."""


class DynamicPoints(NamedTuple):
    """Points on what moves, each as one view sees it; on the CPU.

    Attributes:
        positions: [S, 3] positions at the time of the view.
        colors: [S, 3] in [0, 1].
        views: [S] index of the view.
        depth_known: Whether they are at the views' aligned depth; otherwise before the sparse points around them.
    """

    positions: Float[Tensor, "S 3"]
    colors: Float[Tensor, "S 3"]
    views: Int64[Tensor, " S"]
    depth_known: bool

    def chosen(self, points: Int64[Tensor, " N"] | Bool[Tensor, " S"]) -> "DynamicPoints":
        """The points with these indices, or those marked true."""
        return DynamicPoints(self.positions[points], self.colors[points], self.views[points], self.depth_known)


@torch.no_grad()
def is_depth_known(views: Views, alignments: Float[Tensor, "T 2"]) -> bool:
    """Whether the depth of enough dynamic pixels is known, of a few views."""
    known = total = 0
    for index in evenly_spaced_indices(len(views), NUM_CHECKED):
        view = views[index]
        depth = depth_alignment.metric_depth(view.inverse_depth, alignments[index])
        known += int((depth.isfinite() & ~view.static_mask).sum())
        total += int((~view.static_mask).sum())
    return total > 0 and known >= MIN_KNOWN_FRACTION * total


@torch.no_grad()
def to_canonical(
    deformation: Callable[[Tensor, Tensor], Tensor],
    seen: Float[Tensor, "P 3"],
    time: Float[Tensor, "1"],
    start: Float[Tensor, "P 3"],
    max_error: float,
) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, " P"]]:
    """Canonical positions x that a deformation d moves to points p at a time: x + d(x, time) = p.

    Newton's method, which also follows rotations; no gradient flows to positions, so derivatives are differences. All
    points take all steps, those that are there of length 0, so that a CUDA graph can be captured; on the CPU the search
    ends when all are there.

    Args:
        deformation: As ``fields.FIELDS`` says.
        seen: [P, 3] the points p [scene units].
        time: [1] in [0, 1].
        start: [P, 3] positions from which each is searched [scene units].
        max_error: Distance from p at which a search ends [scene units].

    Returns:
        The [P, 3] positions [scene units], and [P] which of them the deformation moves to within this distance.
    """
    found, step = start, torch.zeros_like(start)
    axes, width = torch.eye(3, dtype=torch.float32, device=start.device)[:, None], max_error / 3.0
    for _ in range(NEWTON_STEPS + 1):
        found = found + step
        probes = torch.cat([found[None], found + width * axes])
        at_probes = probes + deformation(probes.flatten(0, 1), time)[:, :3].view_as(probes)
        missing = seen - at_probes[0]
        distances = missing.norm(dim=1, keepdim=True)
        reached = distances <= max_error
        derivatives = (at_probes[1:] - at_probes[0]) / width  # by axis
        cofactors = torch.linalg.cross(derivatives.roll(-1, 0), derivatives.roll(-2, 0))
        step = (cofactors * missing).sum(2).T / (cofactors * derivatives).sum(2)[0][:, None]  # Cramer's rule
        step = step * (MAX_STEP * distances / step.norm(dim=1, keepdim=True)).clamp_max(1.0)
        step = torch.where(reached, 0.0, step)
        if not start.is_cuda and bool(reached.all()):
            break
    return found, reached[:, 0]


def gaussians_in_box(capture: Capture, count: int, config: TrainConfig, generator: torch.Generator) -> Gaussians:
    """Grey dynamic Gaussians at random in the box of the points, for a branch that nothing else can fill."""
    positions = random_points(capture.points, count, generator)
    return gaussians_at(
        positions, torch.full_like(positions, 0.5), config.model.sh_degree, MAX_SCALE * capture.view_size
    )


@torch.no_grad()
def unproject_pixels(
    capture: Capture,
    views: SomeViews,
    alignments: Float[Tensor, "T 2"],
    mask_of: Callable[[View], Bool[Tensor, "H W"]],
    max_count: int,
    generator: torch.Generator,
) -> DynamicPoints | None:
    """At most ``max_count`` random pixels of masks of the views of the ``sample``, unprojected by aligned depth.

    Where it is known at too few of them, they are put before the sparse points around them, if any are seen.

    Args:
        capture: The capture, with the sparse points.
        views: Its training views.
        alignments: [T, 2] scale and offset of each view's inverse depth.
        mask_of: The pixels of a view.
        max_count: Maximum number of points.
        generator: CPU generator that chooses the pixels.

    Returns:
        The points; None if the masks are empty.
    """
    chosen = views.sample
    num = sum(int(mask_of(view).sum()) for view in views.each(chosen))
    if num == 0:
        return None
    fraction = min(1.0, MAX_PIXELS_PER_GAUSSIAN * max_count / num)
    points = capture.points.to(views.device)

    def known(index: int, view: View, mask: Tensor) -> Tensor:
        return depth_alignment.metric_depth(view.inverse_depth, alignments[index])

    found = _unproject(views, chosen, mask_of, known, fraction, generator)
    depth_known = len(found[0]) >= MIN_KNOWN_FRACTION * fraction * num
    if not depth_known:
        estimated = partial(_depth_before_points, points, generator)
        found = _unproject(views, chosen, mask_of, estimated, fraction, generator)
    positions, colors, indices = found
    return DynamicPoints(positions, colors, indices, depth_known).chosen(subsample(positions, max_count, generator))


def _unproject(
    views: SomeViews,
    chosen: Sequence[int],
    mask_of: Callable[[View], Tensor],
    depth_of: Callable[[int, View, Tensor], Tensor],
    fraction: float,
    generator: torch.Generator,
) -> tuple[Tensor, ...]:
    """Positions, colours and views of a random fraction of the masks' pixels, on the CPU."""
    parts = []
    for index, view in zip(chosen, views.each(chosen), strict=True):
        mask = mask_of(view)
        depth = depth_of(index, view, mask)
        if fraction < 1.0:
            mask = mask & (torch.rand(mask.shape, dtype=torch.float32, generator=generator) < fraction).to(mask.device)
        positions, colors = unproject(depth, mask, view.image, view.camera)
        parts.append((positions.cpu(), colors.cpu(), torch.full((len(positions),), index)))
    return tuple(torch.cat(values) for values in zip(*parts, strict=True))


def _depth_before_points(
    points: Float[Tensor, "P 3"],
    generator: torch.Generator,
    index: int,
    view: View,
    mask: Bool[Tensor, "H W"],
) -> Float[Tensor, "H W"]:
    """Depth of each pixel of a mask just before the nearest of the points around it; NaN elsewhere.

    Dynamic objects occlude the static points around them. One camera does not determine their depth; with this one they
    look right from the training view and occlude little else.
    """
    depth = torch.full(view.static_mask.shape, torch.nan, dtype=torch.float32, device=points.device)
    row, column, z, inside = view.camera.project(points)
    visible = inside.nonzero()[:, 0]
    visible = visible[subsample(visible, MAX_POINTS_PER_IMAGE, generator).to(visible.device)]
    pixels = mask.nonzero()
    if len(visible) == 0:
        return depth
    positions = torch.stack([row[visible], column[visible]], 1).float()
    for part in pixels.split(PIXELS_PER_CHUNK):
        distances = torch.cdist(part.float(), positions)
        around = distances.topk(min(NUM_NEAREST_POINTS, len(visible)), largest=False).indices
        depth[part[:, 0], part[:, 1]] = DEPTH_FACTOR * z[visible][around].amin(1)
    return depth
