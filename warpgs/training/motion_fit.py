"""A deformation that follows what moves before any image is compared.

Dynamic Gaussians of all frames form one set in canonical space. A network that starts as "no change" has to carry those
of every frame to where things are in all others. While it learns that, images pull Gaussians of one object onto another
one, and no image brings them back: the object that they showed stays lost. So the network is fitted to the dynamic
points of all frames first.
"""

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from .dynamic_points import DynamicPoints

MAX_POINTS, MAX_POINTS_PER_VIEW = 40_000, 2_000
"""Maximum number of dynamic points of all frames together, and of one frame in the mean."""

WINDOW = 0.015
"""Largest difference in time, of all in [0, 1], between frames that together give the canonical points."""

POSITION_UNIT, COLOR_UNIT = 0.05, 0.15
"""Differences of positions, as a fraction of the extent, and of colours in [0, 1] that count as 1."""

MAX_SQUARED_DISTANCE = 9.0
"""Limit that squared distances approach (Geman and McClure): frames see sides that others do not."""

HIDDEN_WEIGHT = 0.3
"""Weight of the distances of canonical points, which a frame need not see, to the nearest of the frame's points,
relative to those of the frame's points to the nearest canonical ones."""

GROWTH = 0.6
"""Fraction of the iterations after which all frames take part. They enter by their distance in time from the canonical
points, so that each is close to its solution when it enters."""

LEARNING_RATE = 1e-3
"""Rate of Adam."""

MAX_ERROR = 0.03
"""Maximum distance of a deformed point from where it was seen, as a fraction of the extent."""


def fit_motion(
    deformation: nn.Module,
    found: DynamicPoints,
    times: Float[Tensor, " T"],
    extent: float,
    num_iterations: int,
    generator: torch.Generator,
) -> DynamicPoints:
    """Fits a deformation to dynamic points, and moves these to canonical space.

    The points of the frames around one time are the canonical ones. The deformation carries them to the time of each
    other frame, and the distances between them and the points of that frame are minimized.

    Args:
        deformation: As ``fields.FIELDS`` says; its parameters are changed.
        found: At least one point, all at known depth.
        times: [T] times of the views in [0, 1].
        extent: Extent of the capture [scene units].
        num_iterations: Number of steps of Adam, each on the points of one frame.
        generator: CPU generator that chooses the frames.

    Returns:
        Those of the points that the deformation carries to where they were seen, at their canonical positions.
    """
    clouds = _Clouds(found, times, extent, next(deformation.parameters()).device)
    trained = [parameter.requires_grad for parameter in deformation.parameters()]
    optimizer = torch.optim.Adam(deformation.requires_grad_(True).parameters(), LEARNING_RATE)
    for iteration in range(num_iterations):
        view = clouds.draw(iteration / (GROWTH * num_iterations), generator)
        with torch.enable_grad():
            _distance(clouds.moved(deformation, view), clouds.seen[view]).backward()
        optimizer.step()
        optimizer.zero_grad()
    for parameter, is_trained in zip(deformation.parameters(), trained, strict=True):
        parameter.requires_grad_(is_trained)
    return clouds.canonical(deformation, found)


class _Clouds:
    """Dynamic points by view, as features: positions and colours in the units in which they are compared.

    Attributes:
        extent: Extent of the capture [scene units].
        unit: Difference of positions that counts as 1 [scene units].
        times: [T, 1] times of all views.
        seen: [P, 6] features by view.
        home: [H, 6] features of the canonical points.
        order: Views by their distance in time from the canonical points.
        gaps: [V] these distances.
    """

    def __init__(self, found: DynamicPoints, times: Float[Tensor, " T"], extent: float, device: torch.device) -> None:
        self.extent, self.unit = extent, POSITION_UNIT * extent
        features = torch.cat([found.positions / self.unit, found.colors / COLOR_UNIT], 1).to(device)
        views, counts = found.views.unique(return_counts=True)
        start = _start_time(times[views], counts)
        self.times = times[:, None].to(device)
        self.seen = {view: features[(found.views == view).to(device)] for view in views.tolist()}
        gaps = (times[views] - start).abs()
        self.home = torch.cat([self.seen[view] for view in views[gaps <= WINDOW].tolist()])
        self.gaps, order = gaps.sort(stable=True)
        self.order = views[order].tolist()

    def draw(self, progress: float, generator: torch.Generator) -> int:
        """A random view among those that take part when a fraction of all has entered."""
        count = int((self.gaps <= progress * self.gaps[-1]).sum())
        return self.order[int(torch.randint(count, (), generator=generator))]

    def moved(self, deformation: nn.Module, view: int) -> Float[Tensor, "H 6"]:
        """Features of the canonical points at the time of a view."""
        positions, colors = self.home.split(3, 1)
        offsets = deformation(positions * self.unit, self.times[view])[:, :3]
        return torch.cat([positions + offsets / self.unit, colors], 1)

    @torch.no_grad()
    def canonical(self, deformation: nn.Module, found: DynamicPoints) -> DynamicPoints:
        """The points that the deformation reaches, each moved as the canonical point next to it."""
        positions, kept = found.positions.clone(), torch.zeros(len(found.views), dtype=torch.bool)
        for view, seen in self.seen.items():
            moved = self.moved(deformation, view)
            nearest = torch.cdist(seen, moved).argmin(1)
            home = (self.home[nearest] - moved[nearest] + seen)[:, :3] * self.unit
            errors = home + deformation(home, self.times[view])[:, :3] - seen[:, :3] * self.unit
            chosen = found.views == view
            positions[chosen] = home.cpu()
            kept[chosen] = (errors.norm(dim=1) <= MAX_ERROR * self.extent).cpu()
        return found._replace(positions=positions).chosen(kept)


def _start_time(times: Float[Tensor, " V"], counts: Int64[Tensor, " V"]) -> float:
    """The time of the view with the most points among the middle half of all views."""
    order = times.argsort()
    middle = order[len(order) // 4 : len(order) - len(order) // 4]
    return float(times[middle[counts[middle].argmax()]])


def _distance(moved: Float[Tensor, "H 6"], seen: Float[Tensor, "P 6"]) -> Float[Tensor, ""]:
    """Robust mean of the squared distances between points, in both directions."""
    with torch.no_grad():
        distances = torch.cdist(moved, seen)
        to_moved, to_seen = distances.argmin(0), distances.argmin(1)
    found = (moved[to_moved] - seen).square().sum(1)
    hidden = (moved - seen[to_seen]).square().sum(1)
    return _robust(found).mean() + HIDDEN_WEIGHT * _robust(hidden).mean()


def _robust(squared: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
    return MAX_SQUARED_DISTANCE * squared / (MAX_SQUARED_DISTANCE + squared)
