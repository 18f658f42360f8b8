"""Dynamic Gaussians and paths that start from tracks."""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.config import Plan, TrainConfig
from warpgs.model.gaussians import Gaussians
from warpgs.model.spline_deformation import SplineDeformation
from warpgs.runtime import ranks

from .dynamic_points import MAX_SCALE
from .point_cloud import front_of_ball, gaussians_at, subsample
from .tracks import Track

MAX_RATE, MAX_FINAL_RATE = 3e-4, 1e-5
"""Maximum initial and final learning rates of paths and networks; higher ones cost as docs/design/tracks.md says."""


def for_tracks(plan: Plan, tracks: list[Track]) -> Plan:
    """The plan of a training that starts from tracks: it follows them from its first iteration, at exact times."""
    model, optim = plan.model, plan.optim
    return dataclasses.replace(
        plan,
        model=dataclasses.replace(model, deformation="splines"),
        optim=dataclasses.replace(
            optim,
            networks=min(MAX_RATE, optim.networks),
            networks_end=min(MAX_FINAL_RATE, optim.networks_end),
        ),
        schedule=dataclasses.replace(plan.schedule, deform_from=0, noise_until=0),
    )


@torch.no_grad()
def start_from_tracks(
    tracks: list[Track],
    deformation: SplineDeformation,
    config: TrainConfig,
    view_size: float,
    generator: torch.Generator,
) -> Gaussians:
    """Dynamic Gaussians on objects that were tracked, and the paths along which these move.

    They start where the objects are farthest from each other, so that canonical positions tell them apart.

    Args:
        tracks: At least one.
        deformation: Its homes and paths are replaced.
        config: Number of Gaussians, degree of spherical harmonics and limits of size.
        view_size: Of the capture [scene units].
        generator: CPU generator that chooses the pixels.
    """
    start = _time_apart(tracks)
    parts = [_points(track) for track in tracks]
    label = torch.cat([torch.full((len(points),), k) for k, (points, _) in enumerate(parts)])
    starts = torch.from_numpy(np.stack([track.path(start) for track in tracks])).float()
    positions = torch.cat([points for points, _ in parts]) + starts[label]
    colors = torch.cat([colors for _, colors in parts])
    chosen = subsample(positions, config.model.dynamic_points, generator)
    gaussians = gaussians_at(positions[chosen], colors[chosen], config.model.sh_degree, MAX_SCALE * view_size)
    deformation.resize(len(tracks), len(tracks[0].path.c))
    deformation.homes.copy_(starts)
    ranks.copy_first_(deformation.homes)
    units = deformation.network.units[:3].cpu()
    deformation.paths.copy_(torch.from_numpy(np.stack([track.path.c for track in tracks])) / units)
    return gaussians


def _time_apart(tracks: list[Track]) -> float:
    """The time of a frame at which the smallest distance between two objects is largest."""
    times = np.unique([region.time for track in tracks for region in track.regions])
    paths = np.stack([track.path(times) for track in tracks])
    distances = np.linalg.norm(paths[:, None] - paths[None], axis=-1)
    distances[np.arange(len(tracks)), np.arange(len(tracks))] = np.inf
    return float(times[distances.min((0, 1)).argmax()])


def _points(track: Track) -> tuple[Float[Tensor, "P 3"], Float[Tensor, "P 3"]]:
    """Offsets from the path and colours of what all frames see of an object, as if it were round."""
    offsets: list[np.ndarray] = []
    colors: list[np.ndarray] = []
    for region in track.regions:
        center = track.path(region.time) - region.origin
        depth = center @ region.center
        points = region.rays * (depth / (region.rays @ region.center))[:, None] - depth * region.center
        offsets.append(points - front_of_ball(points)[:, None] * region.center)
        colors.append(region.colors)
    return torch.from_numpy(np.concatenate(offsets)).float(), torch.from_numpy(np.concatenate(colors)).float()
