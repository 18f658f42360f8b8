"""A deformation that follows what moves before any image is compared.

Dynamic Gaussians of all frames form one set in canonical space. A network that starts as "no change" has to move those
of every frame to their positions in all others. While it learns that, images pull Gaussians of one object onto another
one, and no image brings them back: the object that they showed stays lost. So the network is fitted to the dynamic
points of all frames first.
"""

import copy
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from warpgs.config import TrainConfig
from warpgs.model.trunk import in_single_precision
from warpgs.ops.adam import Adam
from warpgs.runtime.graphs import GraphCache

from .dynamic_points import PIXELS_PER_CHUNK, DynamicPoints, to_canonical
from .point_cloud import subsample
from .track_fit import TrackFit
from .track_paths import Paths

MAX_POINTS, MAX_POINTS_PER_VIEW = 40_000, 2_000
"""Maximum number of dynamic points of all frames together, and of those in one frame that the fit compares."""

WINDOW = 0.015
"""Largest difference in time, of all in [0, 1], between frames that together give the canonical points."""

POSITION_UNIT, COLOR_UNIT = 0.019, 0.15
"""Differences of positions, as a fraction of the view size, and of colours in [0, 1] that count as 1."""

SQUARED_SCALE = 9.0
"""Squared distance from which on distances count less and less (Cauchy): frames see sides that others do not. However
far an object is, it still pulls the deformation, which otherwise loses one whose depth is unknown for many frames."""

HIDDEN_WEIGHT = 0.3
"""Weight of the distances of canonical points, which a frame need not see, to the nearest of the frame's points,
relative to those of the frame's points to the nearest canonical ones."""

GROWTH = 0.6
"""Fraction of the steps after which all frames are compared. They follow by their distance in time from the canonical
points, so that each is close to its solution when it is first compared."""

LEARNING_RATE = 1e-3
"""Rate of Adam."""

TRACK_STEPS, TRACK_WEIGHT = 3, 10.0
"""Steps that fit the deformation to tracks alone, before others, per step of the fit; weight of tracks in these."""

ANCHOR_RATE = 1e-2
"""Rate of Adam for the canonical points of tracks [units]."""

MAX_STRETCH = 1.5
"""Maximum distance of a point from the nearest canonical one, relative to that at the time when it was seen: they are
the same where an object turns as a whole."""

MAX_ERROR = 0.011
"""Maximum distance of a deformed point from where it was seen, as a fraction of the view size."""

MIN_KEPT = 0.3
"""Fraction of the points that a fitted deformation has to move to where they were seen, or it is not used."""


IsStopped = Callable[[float], bool]
"""Told after each step which fraction of the fit is done; whether to stop it."""


def never(done: float) -> bool:
    """An ``IsStopped`` that lets the fit go on."""
    return False


class Observed(NamedTuple):
    """What T training views, or all training views at each of T times, see of what moves.

    Attributes:
        points: At least one point, all at known depth.
        times: [T] in [0, 1].
        view_size: Of the capture [scene units].
        paths: Tracks of a network; None without any.
    """

    points: DynamicPoints
    times: Float[Tensor, " T"]
    view_size: float
    paths: Paths | None = None


class MotionFit(NamedTuple):
    """Dynamic points after a fit.

    Attributes:
        points: Those that are deformed to where they were seen, at their canonical positions; all as found if those
            are fewer than ``MIN_KEPT``.
        num_tracks: Number of tracks that the deformation follows; 0 if it was fitted without them.
    """

    points: DynamicPoints
    num_tracks: int


def fit_motion(
    deformation: nn.Module,
    observed: Observed,
    config: TrainConfig,
    generator: torch.Generator,
    is_stopped: IsStopped = never,
) -> MotionFit | None:
    """Fits a deformation to dynamic points, and moves these to canonical space.

    The points around one time are canonical. Deformed to the time of each other frame, they come close to its points.
    Tracks are followed before that, unless the deformation cannot follow as many as ``MIN_KEPT`` of them.

    Args:
        deformation: As ``fields.FIELDS`` says; its parameters, of which there must be some, are changed.
        observed: What the views see.
        config: ``schedule.fit_motion`` is the number of steps of Adam, each on the points of one frame; ``graph``
            says whether they are replayed on CUDA.
        generator: CPU generator that chooses the frames.
        is_stopped: See ``IsStopped``.

    Returns:
        The points; None if stopped, and the deformation as it was, as it is where no points are moved.
    """
    # In half precision, the network of one of six seeds learned nothing on builtin:studio without depth.
    fitted = in_single_precision(copy.deepcopy(deformation).requires_grad_(True))
    device, found = next(fitted.parameters()).device, observed.points
    points = _PointsByView(found, observed.times, observed.view_size, device, generator)
    tracks = _tracks(observed, points, generator)
    if not _fit(fitted, points, tracks, config, generator, is_stopped):
        return None
    num_tracks = 0 if tracks is None else points.take_home(tracks, fitted)
    if tracks is not None and num_tracks == 0:
        return fit_motion(deformation, observed._replace(paths=None), config, generator, is_stopped)
    kept = points.canonical(fitted, found, config.graph and device.type == "cuda")
    if len(kept.views) < MIN_KEPT * len(found.views):
        return MotionFit(found, 0)
    deformation.load_state_dict(fitted.state_dict())
    return MotionFit(kept, num_tracks)


def _tracks(observed: Observed, points: "_PointsByView", generator: torch.Generator) -> TrackFit | None:
    """The tracks of known depth; None without any."""
    if observed.paths is None:
        return None
    tracks = TrackFit(observed.paths, points.views, points.unit, points.home.device, generator)
    return tracks if len(tracks.anchors) else None


def _fit(
    deformation: nn.Module,
    points: "_PointsByView",
    tracks: TrackFit | None,
    config: TrainConfig,
    generator: torch.Generator,
    is_stopped: IsStopped,
) -> bool:
    """Takes the steps, on CUDA as replays of a graph, until stopped; whether all were taken."""
    device, num_steps = points.home.device, config.schedule.fit_motion
    rate, index = (
        torch.tensor(LEARNING_RATE, dtype=torch.float32, device=device),
        torch.zeros(1, dtype=torch.int64, device=device),
    )
    groups = [{"params": list(deformation.parameters()), "lr": rate}]
    if tracks is not None:
        groups.append({"params": [tracks.anchors], "lr": torch.full_like(rate, ANCHOR_RATE)})
    optimizer = Adam(groups)
    is_replayed = config.graph and device.type == "cuda"
    graphs: GraphCache[int] | None = GraphCache(max_graphs=1, repeatable=False) if is_replayed else None
    losses = [(num_steps, partial(_loss, deformation, points, tracks, index))]
    if tracks is not None:
        losses.insert(0, (TRACK_STEPS * num_steps, partial(_loss_of_tracks, deformation, points, tracks, index)))
    taken, total = 0, sum(count for count, _ in losses)
    for stage, (count, loss) in enumerate(losses):
        for step in range(count):
            progress = step / (GROWTH * count) if stage == 0 else 1.0
            index.fill_(points.choose_view(progress, generator))
            take_step = partial(_take_step, loss, optimizer)
            if graphs is None:
                take_step()
            else:
                graphs.run(stage, take_step)
            taken += 1
            if is_stopped(taken / total):
                return False
    return True


@torch.enable_grad()
def _take_step(loss: Callable[[], Float[Tensor, ""]], optimizer: Adam) -> tuple[Tensor, ...]:
    """Fits the deformation a little better to the view whose index is on the device."""
    loss().backward()
    optimizer.step()
    optimizer.zero_grad()
    return ()


def _loss(
    deformation: nn.Module, points: "_PointsByView", tracks: TrackFit | None, index: Int64[Tensor, "1"]
) -> Float[Tensor, ""]:
    """Distance of the deformed canonical points from those of a view, and of tracks from where it sees them."""
    time, seen, count = points.pick(index)
    distance = _distance(points.deformed(deformation, time), seen, count)
    return distance if tracks is None else distance + TRACK_WEIGHT * tracks.loss(deformation, time, index)


def _loss_of_tracks(
    deformation: nn.Module, points: "_PointsByView", tracks: TrackFit, index: Int64[Tensor, "1"]
) -> Float[Tensor, ""]:
    return tracks.loss(deformation, points.times.index_select(0, index)[0], index)


class _PointsByView:
    """Dynamic points as features: positions and colours in the units in which they are compared.

    Attributes:
        unit: Difference of positions that counts as 1 [scene units].
        max_error: Maximum distance of a deformed point from where it was seen [scene units].
        views: The V views with points, by their distance in time from the canonical points.
        gaps: [V] these distances.
        times: [V, 1] times.
        seen: [V, P, 6] features of at most ``MAX_POINTS_PER_VIEW`` points of each view, repeated until there are as
            many as in the view with the most.
        counts: [V] number of points without repetitions.
        home: [H, 6] features of the canonical points, at most ``MAX_POINTS_PER_VIEW``, or those of tracks.
    """

    def __init__(
        self,
        found: DynamicPoints,
        times: Float[Tensor, " T"],
        view_size: float,
        device: torch.device,
        generator: torch.Generator,
    ) -> None:
        self.unit, self.max_error = POSITION_UNIT * view_size, MAX_ERROR * view_size
        features = self._features(found)
        views, counts = found.views.unique(return_counts=True)
        start = _start_time(times[views], counts)
        self.gaps, order = (times[views] - start).abs().sort(stable=True)

        def sampled(chosen: Bool[Tensor, " S"]) -> Float[Tensor, "P 6"]:
            indices = chosen.nonzero()[:, 0]
            return features[indices[subsample(indices, MAX_POINTS_PER_VIEW, generator)]]

        seen = [sampled(found.views == view) for view in views.tolist()]
        self.home = sampled((times[found.views] - start).abs() <= WINDOW).to(device)
        self.views, self.times = views[order].tolist(), times[views[order], None].to(device)
        self.counts = counts[order].clamp_max(MAX_POINTS_PER_VIEW).to(device)
        rows = torch.arange(max(len(points) for points in seen))
        self.seen = torch.stack([points[rows % len(points)] for points in seen])[order].to(device)

    def _features(self, points: DynamicPoints) -> Float[Tensor, "S 6"]:
        return torch.cat([points.positions / self.unit, points.colors / COLOR_UNIT], 1)

    def choose_view(self, progress: float, generator: torch.Generator) -> int:
        """Index in ``views`` of a random one that is compared when a fraction of the way to the farthest is done."""
        count = int((self.gaps <= progress * self.gaps[-1]).sum())
        return int(torch.randint(count, (), generator=generator))

    def pick(self, index: Int64[Tensor, "1"]) -> tuple[Float[Tensor, "1"], Float[Tensor, "P 6"], Int64[Tensor, ""]]:
        """Time of the view of an index on the device, features of its points, and their number without repetitions."""
        time, seen, count = (values.index_select(0, index)[0] for values in (self.times, self.seen, self.counts))
        # A graph needs one shape for all views. On the CPU repetitions would only cost time.
        return time, seen if seen.is_cuda else seen[: int(count)], count

    def deformed(self, deformation: nn.Module, time: Float[Tensor, "1"]) -> Float[Tensor, "H 6"]:
        """Features of the canonical points at a time."""
        positions, colors = self.home.split(3, 1)
        offsets = deformation(positions * self.unit, time)[:, :3]
        return torch.cat([positions + offsets / self.unit, colors], 1)

    def take_home(self, tracks: TrackFit, deformation: nn.Module) -> int:
        """Replaces the canonical points by those of the tracks that a deformation follows, and returns their number.

        It is 0, and nothing is replaced, if it follows less than ``MIN_KEPT`` of them.
        """
        follows = tracks.followed(deformation, self.times, self.max_error)
        count = int(follows.sum())
        if count < MIN_KEPT * len(follows):
            return 0
        self.home = torch.cat([tracks.anchors.detach(), tracks.colors / COLOR_UNIT], 1)[follows]
        return count

    @torch.no_grad()
    def canonical(self, deformation: nn.Module, found: DynamicPoints, is_replayed: bool = False) -> DynamicPoints:
        """Moves points to canonical space, each next to the nearest canonical point.

        Its position is where the offset of this canonical point leads. Where the object turns, it is searched from the
        canonical point itself, and not farther from it than the point was seen, or else it might be found on another
        object. What no canonical point shows is searched from where the offset leads.

        Args:
            deformation: Maps [N, 3] positions [scene units] and a [1] time in [0, 1] to [N, 10] offsets.
            found: The S points, on the CPU.
            is_replayed: Whether to capture the search in a CUDA graph.

        Returns:
            Those of the points that are deformed to where they were seen, in their order and on the CPU, with canonical
            positions [scene units] in single precision.
        """
        positions, kept = found.positions.clone(), torch.zeros(len(found.views), dtype=torch.bool)
        graphs: GraphCache[str] | None = GraphCache(max_graphs=1, repeatable=True) if is_replayed else None
        size = min(PIXELS_PER_CHUNK, int(found.views.bincount().max()))
        seen, time = self.home.new_zeros(size, 6), torch.empty_like(self.times[0])
        for view, time_of_view in zip(self.views, self.times, strict=True):
            time.copy_(time_of_view)
            for part in (found.views == view).nonzero()[:, 0].split(size):
                seen[: len(part)] = self._features(found.chosen(part)).to(seen.device)
                # A graph needs one shape for all views. On the CPU rows without a point would only cost time.
                rows = seen if is_replayed else seen[: len(part)]
                search = partial(self._search, deformation, time, rows)
                moved, is_kept = graphs.run("search", search) if graphs else search()
                positions[part], kept[part] = moved[: len(part)].cpu(), is_kept[: len(part)].cpu()
        return found._replace(positions=positions).chosen(kept)

    def _search(
        self, deformation: nn.Module, time: Float[Tensor, "1"], seen: Float[Tensor, "P 6"]
    ) -> tuple[Float[Tensor, "P 3"], Bool[Tensor, " P"]]:
        """Canonical positions [scene units] of points seen at a time, and which of them to keep; see ``canonical``."""
        deformed, max_error = self.deformed(deformation, time), self.max_error
        distances, nearest = torch.cdist(seen, deformed).min(1)
        is_shown = distances.square() <= SQUARED_SCALE
        goal, home = seen[:, :3] * self.unit, self.home[nearest, :3] * self.unit
        away = goal - deformed[nearest, :3] * self.unit
        start = home + away
        is_there = (goal - start - deformation(start, time)[:, :3]).norm(dim=1) <= max_error
        start = torch.where((is_shown & ~is_there)[:, None], home, start)
        moved, reached = to_canonical(deformation, goal, time, start, max_error)
        is_near = (moved - home).norm(dim=1) <= MAX_STRETCH * away.norm(dim=1) + max_error
        return moved, reached & (is_near | ~is_shown)


def _start_time(times: Float[Tensor, " V"], counts: Int64[Tensor, " V"]) -> float:
    """The time of the view with the most points among the middle half of all views."""
    order = times.argsort()
    middle = order[len(order) // 4 : len(order) - len(order) // 4]
    return float(times[middle[counts[middle].argmax()]])


def _distance(
    deformed: Float[Tensor, "H 6"], seen: Float[Tensor, "P 6"], count: Int64[Tensor, ""]
) -> Float[Tensor, ""]:
    """Robust mean of the squared distances between points, in both directions.

    Only the first ``count`` of the seen points are compared. The others repeat them, so that none of them is nearer.
    """
    with torch.no_grad():
        distances = torch.cdist(deformed, seen)
        to_deformed, to_seen = distances.argmin(0), distances.argmin(1)
        is_compared = torch.arange(len(seen), device=seen.device) < count
    found = (deformed[to_deformed] - seen).square().sum(1)
    hidden = (deformed - seen[to_seen]).square().sum(1)
    return (_robust(found) * is_compared).sum() / count + HIDDEN_WEIGHT * _robust(hidden).mean()


def _robust(squared: Float[Tensor, " P"]) -> Float[Tensor, " P"]:
    return SQUARED_SCALE * torch.log1p(squared / SQUARED_SCALE)
