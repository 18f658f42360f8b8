"""The circular images of fisheye lenses, which leave the corners of frames black."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from warpgs.cameras import Camera

from .capture import Capture, Frame
from .resized import size_within
from .sampling import evenly_spaced

MAX_FRAMES = 8
"""Number of training frames that are looked at."""

MAX_FRAME_SIDE = 320
"""Their longer side [px]."""

MAX_BLACK = 24
"""Maximum of the brightest channel in the corners, which compression does not leave all black."""

RING, MIN_LIT = 0.9, 0.5
"""A circle is one if at least this part of the pixels of a frame is lit from this part of its angle on: the night is
dark in front of the lens, too."""


def with_image_circle(capture: Capture) -> Capture:
    """The same capture, with the ``Distortion.circle`` of cameras whose fisheye images are black beyond some angle.

    Where its cameras show nothing, frames are black and static, and their depth is unknown.

    Raises:
        ValueError: If a frame that is looked at is missing or damaged; the message names it.
    """
    circle = _black_from(capture, [name for name in capture.train if _is_fisheye(capture.cameras[name])])
    cameras = {name: _with_circle(camera, circle) for name, camera in capture.cameras.items()}
    if all(camera.shown is None for camera in cameras.values()):
        return capture
    return replace(capture, cameras=cameras, read=partial(_read, capture.read, cameras))


def _black_from(capture: Capture, names: list[str]) -> float:
    """The angle from which on frames are black; infinite if there is none [radians]."""
    seen = [_angles_and_lit(capture.frame(name)) for name in evenly_spaced(names, MAX_FRAMES)]
    circle = max((float(angles[is_lit].max(initial=0.0)) for angles, is_lit in seen), default=0.0)
    rings = [is_lit[(angles > RING * circle) & (angles <= circle)] for angles, is_lit in seen]
    is_circle = any(ring.size and ring.mean() >= MIN_LIT for ring in rings)
    return circle if is_circle and any((angles > circle).any() for angles, _ in seen) else math.inf


def _read(read: Callable[[str], Frame], cameras: Mapping[str, Camera], name: str) -> Frame:
    frame, shown = replace(read(name), camera=cameras[name]), cameras[name].shown
    if shown is None:
        return frame
    return replace(
        frame,
        image=torch.where(shown[..., None], frame.image, 0),
        static_mask=None if frame.static_mask is None else frame.static_mask | ~shown,
        inverse_depth=None if frame.inverse_depth is None else torch.where(shown, frame.inverse_depth, torch.nan),
        covisible=None if frame.covisible is None else frame.covisible & shown,
    )


def _is_fisheye(camera: Camera) -> bool:
    return camera.distortion is not None and camera.distortion.lens == "fisheye"


def _angles_and_lit(frame: Frame) -> tuple[Float[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """The angle from the axis of what each pixel of a reduced frame shows, 0 where the lens sees nothing [radians].

    And which pixels are not black, without single ones and the border, which is mixed with black.
    """
    camera = frame.camera.resized(*size_within(frame.camera.size, MAX_FRAME_SIDE))
    x, y, z = camera.rays(camera.pixel_centers).nan_to_num(0.0).unbind(1)
    angles = torch.atan2(torch.hypot(x, y), z).reshape(camera.height, camera.width).numpy()
    image = cv2.resize(frame.image.numpy(), camera.size, interpolation=cv2.INTER_AREA)
    lit = (image.max(2) > MAX_BLACK).astype(np.uint8)
    return angles, cv2.erode(lit, np.ones((3, 3), np.uint8)) > 0


def _with_circle(camera: Camera, circle: float) -> Camera:
    if camera.distortion is None or not _is_fisheye(camera):
        return camera
    return replace(camera, distortion=replace(camera.distortion, circle=min(circle, camera.distortion.circle)))
