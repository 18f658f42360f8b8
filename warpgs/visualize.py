"""Pictures and videos for people to look at."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from .rendering import Rendering

ERROR_RANGE = 0.25
"""Mean absolute error that has the brightest colour."""

CAPTION_HEIGHT = 18


def to_bytes(image: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """8-bit RGB of an image in [0, 1]."""
    return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()


def error_image(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Mean absolute error in colours, dark where there is none."""
    error = (image - truth).abs().mean(-1).div(ERROR_RANGE)
    level = (error.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()
    return cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def comparison(truth: Float[Tensor, "H W 3"], rendering: Rendering) -> UInt8[np.ndarray, "H2 W5 3"]:
    """truth | joint | static | dynamic | error, side by side under their names."""
    assert rendering.static is not None
    assert rendering.dynamic is not None
    pictures = {
        "truth": to_bytes(truth),
        "joint": to_bytes(rendering.joint.image),
        "static": to_bytes(rendering.static.image),
        "dynamic": to_bytes(rendering.dynamic.image),
        f"error (0 to {ERROR_RANGE})": error_image(rendering.joint.image.clamp(0, 1), truth),
    }
    return np.concatenate([_captioned(name, picture) for name, picture in pictures.items()], axis=1)


def _captioned(name: str, picture: np.ndarray) -> np.ndarray:
    bar = np.zeros((CAPTION_HEIGHT, picture.shape[1], 3), np.uint8)
    cv2.putText(bar, name, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (235, 235, 235), 1, cv2.LINE_AA)
    return np.concatenate([bar, picture])
