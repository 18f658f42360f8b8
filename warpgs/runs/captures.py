"""The capture that a run is trained on."""

from warpgs.config import TrainConfig
from warpgs.data.capture import Background, Capture

from .checkpoint import Metadata

MAX_TIME_CHANGE = 1e-6
"""Difference of times that is rounding, not another capture."""


def require_same_times(capture: Capture, metadata: Metadata) -> None:
    """Raises ValueError if a frame that a checkpoint was trained on has another time now: then all times may differ."""
    for name, time in zip(metadata.views, metadata.times, strict=False):  # checkpoints of version 0.2 have no times
        now = capture.cameras[name].time if name in capture.cameras else time
        if abs(now - time) > MAX_TIME_CHANGE:
            raise ValueError(
                f"frame {name} of {capture.name} had time {time:.4g} in training and has {now:.4g} now: the first "
                "frame has time 0 and the last one time 1, so both must stay the same (but their images may be "
                "replaced by others of the same size)"
            )


def known_background(config: TrainConfig, capture: Capture) -> Background:
    """The background of a config.

    Raises:
        ValueError: If it depends on the capture and was not looked up. Runs of earlier versions, whose config does not
            know it, are over black.
    """
    if config.background == "mean" or (config.background == "capture" and capture.background == "white"):
        raise ValueError(f'background is "{config.background}": call fitted(config, capture, log) first')
    return "black" if config.background == "capture" else config.background
