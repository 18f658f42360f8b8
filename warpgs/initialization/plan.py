"""What runs: the values of a config that depend on the capture and on the machine."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from warpgs.config import Background, Color, ModelConfig, Plan, TrainConfig, scaled
from warpgs.data.capture import COLORS, Capture, background_color
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.errors import counted
from warpgs.model.poses import shared_places
from warpgs.model.segments import OVERLAP, default_number
from warpgs.runtime.devices import choose_device

from .sky import Sky, find_sky

MANY_POSES = 80
"""Number of poses of training cameras from which on their corrections have the whole rate. Each of fewer is seen more
often: at the rate of 80 those of 14 frames are led away from where their held-out neighbours are."""

MAX_AVERAGED = 50
"""Maximum number of frames whose mean colour is the background."""


class Planned(NamedTuple):
    """What runs, and what was looked up for it.

    Attributes:
        plan: The plan.
        notes: A sentence on each value that was looked up.
        sky: The sky that is the background, if the capture shows it.
    """

    plan: Plan
    notes: list[str]
    sky: Sky | None


def make_plan(config: TrainConfig, capture: Capture) -> Planned:
    """The plan of a new run.

    Raises:
        ValueError: If a number of the config is out of its range, or there is no such device.
    """
    config, notes = scaled(config), []
    (background, sky), loss = _background(config, capture), config.loss
    notes += [] if sky is None else [sky.described]
    asked, num = config.model.time_bands, len(capture.moments)
    segments = _num_segments(config.model, num)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, segments=segments))
    notes += describe_segments(config, num)
    if segments > 1:
        num = _times_of_a_segment(segments, num)
    bands = determined_bands(config.model, num)
    if bands < asked:
        notes.append(f"the networks get {bands} of {asked} frequencies of time: {num} times determine no more")
        config = dataclasses.replace(config, model=dataclasses.replace(config.model, time_bands=bands))
    num_poses = int(shared_places([capture.cameras[name] for name in capture.train]).max()) + 1
    poses = config.optim.poses * min(1.0, num_poses / MANY_POSES)
    if poses < config.optim.poses:
        notes.append(f"corrections of {counted(num_poses, 'pose')} learn at {poses:.1e}: each is seen often")
        config = dataclasses.replace(config, optim=dataclasses.replace(config.optim, poses=poses))
    branches = loss.branches_in_stage2 != "no"
    if loss.branches_in_stage2 == "given-masks" and capture.assuming(config.assumption).uses_estimated_masks:
        notes.append("the masks are estimates: stage II compares the image of all Gaussians only, not each branch's")
        branches = False
    return Planned(Plan.of(config, choose_device(config.device), background, branches), notes, sky)


def describe_segments(config: TrainConfig, num_times: int) -> list[str]:
    """Sentences on the segments of a model, if it has several."""
    model, most = config.model, config.densify.max_gaussians
    if model.segments is None or model.segments == 1:
        return []
    num = _times_of_a_segment(model.segments, num_times)
    notes = [f"{model.segments} segments of about {num} times have dynamic Gaussians and a deformation of their own"]
    if (start := model.max_static_points + model.segments * model.dynamic_points) >= most:
        limit = f"--densify.max-gaussians {most}, the limit of all segments together"
        notes.append(f"warning: up to {start} initial Gaussians may reach {limit}: give a larger one to add more")
    return notes


def _times_of_a_segment(segments: int, num_times: int) -> int:
    return math.ceil(num_times * (1.0 + OVERLAP) / segments)


def _num_segments(model: ModelConfig, num_times: int) -> int:
    """Number of segments: what is asked for, or what suits the number of times."""
    if model.deformation == "mlp":
        if (model.segments or 1) > num_times:
            raise ValueError(
                f"model.segments {model.segments}: expected at most the {num_times} times of training frames"
            )
        return default_number(num_times) if model.segments is None else model.segments
    if model.segments not in (None, 1):
        raise ValueError(f'model.segments {model.segments} needs model.deformation "mlp", got "{model.deformation}"')
    return 1


def _background(config: TrainConfig, capture: Capture) -> tuple[Background, Sky | None]:
    """The background of a config, and the sky if it was found: what it asks for, or that of the capture.

    Instead of black, it is a sky where the capture shows one, or the mean colour. Black and white get their names:
    captures over white know where frames are empty.
    """
    asked = config.background
    if asked == "capture" or (asked in ("auto", "mean") and capture.background != "black"):
        return capture.background, None
    seen = capture.assuming(config.assumption)  # where nothing is static, dynamic Gaussians have to paint the sky
    if asked in ("auto", "sky") and ((sky := find_sky(seen)) is not None or asked == "sky"):
        return "sky", sky
    color = mean_color(capture) if asked == "auto" or asked == "mean" else background_color(asked)
    names: dict[Background, Background] = {value: name for name, value in COLORS.items()}
    return names.get(color, color), None


def mean_color(capture: Capture) -> Color:
    """Mean red, green and blue of a capture's training frames in [0, 1], to 3 decimals, of some frames if many."""
    # There are no views yet: which of their pixels are empty depends on the background.
    chosen = evenly_spaced_indices(len(capture.train), MAX_AVERAGED)
    frames = capture.frames([capture.train[k] for k in chosen])
    means = [frame.image.numpy().mean((0, 1)) for frame in frames]
    red, green, blue = (round(float(value), 3) for value in np.mean(means, 0) / 255.0)
    return red, green, blue


def determined_bands(model: ModelConfig, num_times: int) -> int:
    """Number of frequencies of time for a capture, at most ``model.time_bands`` and at least 1 of them.

    See ``ModelConfig.min_period``.

    Frequency k = 0 … L − 1 of paper Eq. 6 has a period of 2 / 2ᵏ of the time from the first to the last frame.
    """
    if model.min_period == 0 or model.time_bands == 0:
        return model.time_bands
    periods = 2.0 * (num_times - 1) / model.min_period
    return min(model.time_bands, 1 + math.floor(math.log2(max(1.0, periods))))
