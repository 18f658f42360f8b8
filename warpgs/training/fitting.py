"""Values of a config that depend on the capture."""

import dataclasses
import math
from collections.abc import Callable

from warpgs.config import ModelConfig, TrainConfig
from warpgs.data.capture import Capture
from warpgs.runs.captures import known_background

from .tracked_start import for_tracks
from .tracks import find_tracks


def fitted(config: TrainConfig, capture: Capture, log: Callable[[str], None]) -> TrainConfig:
    """The config with those values replaced that depend on the capture.

    Raises:
        ValueError: If it names a deformation model that the capture does not suit.
    """
    background = capture.background if config.background == "capture" else config.background
    config = dataclasses.replace(config, background=background)
    seen = capture.assuming(config.assume).over(known_background(config, capture))
    tracks = find_tracks(seen) if config.model.tracks and config.model.deformation in ("mlp", "splines") else []
    if tracks:
        log(f"{len(tracks)} objects move far from frame to frame: dynamic Gaussians start on their tracks")
        config = for_tracks(config, tracks)
    elif config.model.deformation == "splines":
        raise ValueError('model.deformation "splines": no small objects are tracked in this capture; use "mlp"')
    bands, loss = fitted_bands(config.model, len(capture.train)), config.loss
    if bands < config.model.time_bands:
        log(f"{len(capture.train)} frames determine {bands} of the {config.model.time_bands} frequencies of time")
        config = dataclasses.replace(config, model=dataclasses.replace(config.model, time_bands=bands))
    if loss.branches_in_stage2 == "given-masks":
        if seen.uses_estimated_masks:
            log("the masks are estimates: stage II compares the joint image alone")
        loss = dataclasses.replace(loss, branches_in_stage2="no" if seen.uses_estimated_masks else "yes")
    return dataclasses.replace(config, loss=loss)


def fitted_bands(model: ModelConfig, num_frames: int) -> int:
    """Number of frequencies of time for a capture, at most ``model.time_bands`` and at least 1 of them.

    See ``ModelConfig.min_period``.

    Frequency k = 0 … L − 1 of paper Eq. 6 has a period of 2 / 2ᵏ of the time from the first to the last frame.
    """
    if model.min_period == 0 or model.time_bands == 0:
        return model.time_bands
    periods = 2.0 * (num_frames - 1) / model.min_period
    return min(model.time_bands, 1 + math.floor(math.log2(max(1.0, periods))))
