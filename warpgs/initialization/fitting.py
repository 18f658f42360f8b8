"""Values of a config that depend on the capture."""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from warpgs.config import ModelConfig, TrainConfig
from warpgs.data.capture import COLORS, Background, Capture, Color, background_color
from warpgs.data.sampling import evenly_spaced_indices

from .tracked_start import for_tracks
from .tracks import find_tracks

MAX_AVERAGED = 50
"""Maximum number of frames whose mean colour is the background."""


def fitted(config: TrainConfig, capture: Capture, log: Callable[[str], None]) -> TrainConfig:
    """The config with those values replaced that depend on the capture.

    Raises:
        ValueError: If it names a deformation model that the capture does not suit.
    """
    background = _background(config, capture)
    config = dataclasses.replace(config, background=background)
    seen = capture.assuming(config.assume).over(background)
    tracks = find_tracks(seen) if config.model.tracks and config.model.deformation in ("mlp", "splines") else []
    if tracks:
        log(f"{len(tracks)} objects move far from frame to frame: dynamic Gaussians start on their tracks")
        config = for_tracks(config, tracks)
    elif config.model.deformation == "splines":
        raise ValueError('model.deformation "splines": no small objects are tracked in this capture; use "mlp"')
    bands, loss = fitted_bands(config.model, len(capture.train)), config.loss
    if bands < config.model.time_bands:
        num = len(capture.train)
        log(
            f"the networks get {bands} of {config.model.time_bands} frequencies of time: {num} frames determine no more"
        )
        config = dataclasses.replace(config, model=dataclasses.replace(config.model, time_bands=bands))
    if loss.branches_in_stage2 == "given-masks":
        if seen.uses_estimated_masks:
            log("the masks are estimates: stage II compares the image of all Gaussians only, not those of each branch")
        loss = dataclasses.replace(loss, branches_in_stage2="no" if seen.uses_estimated_masks else "yes")
    return dataclasses.replace(config, loss=loss)


def _background(config: TrainConfig, capture: Capture) -> Background:
    """The background of a config: what it asks for, or that of the capture, with the mean colour instead of black.

    Black and white get their names: captures over white know where frames are empty.
    """
    if config.background == "capture" or (config.background == "mean" and capture.background != "black"):
        return capture.background
    color = mean_color(capture) if config.background == "mean" else background_color(config.background)
    names: dict[Background, Background] = {value: name for name, value in COLORS.items()}
    return names.get(color, color)


def mean_color(capture: Capture) -> Color:
    """Mean red, green and blue of a capture's training frames in [0, 1], to 3 decimals, of some frames if many."""
    chosen = evenly_spaced_indices(len(capture.train), MAX_AVERAGED)
    frames = capture.frames([capture.train[k] for k in chosen])
    means = [frame.image.numpy().mean((0, 1)) for frame in frames]
    red, green, blue = (round(float(value), 3) for value in np.mean(means, 0) / 255.0)
    return red, green, blue


def fitted_bands(model: ModelConfig, num_frames: int) -> int:
    """Number of frequencies of time for a capture, at most ``model.time_bands`` and at least 1 of them.

    See ``ModelConfig.min_period``.

    Frequency k = 0 … L − 1 of paper Eq. 6 has a period of 2 / 2ᵏ of the time from the first to the last frame.
    """
    if model.min_period == 0 or model.time_bands == 0:
        return model.time_bands
    periods = 2.0 * (num_frames - 1) / model.min_period
    return min(model.time_bands, 1 + math.floor(math.log2(max(1.0, periods))))
