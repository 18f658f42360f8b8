"""The capture that a run is trained on."""

from warpgs.data.capture import Capture

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
