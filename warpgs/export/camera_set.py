"""The cameras of a capture as files get them: in the coordinates of the scene's file, so that both fit together."""

import dataclasses
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float64

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.lens import Lens


class CameraSet(NamedTuple):
    """The cameras of a capture in the coordinates of a file.

    Attributes:
        cameras: By id, in the order of their times; with ``viewmat`` from the coordinates of the file.
        train: Ids of the training cameras.
        points, colors: [P, 3] sparse points in the same coordinates, and their 8-bit RGB; None if unknown.
        rotation: [3, 3] from scene coordinates to those of the file.
        seconds: Duration of the scene [s].
    """

    cameras: dict[str, Camera]
    train: list[str]
    points: np.ndarray
    colors: np.ndarray | None
    rotation: Float64[np.ndarray, "3 3"]
    seconds: float

    @staticmethod
    def of(capture: Capture, rotation: Float64[np.ndarray, "3 3"], seconds: float) -> "CameraSet":
        """The cameras of a capture, turned by a rotation."""
        names = capture.in_time(capture.cameras)
        cameras = {name: _turned(capture.cameras[name].to("cpu"), rotation) for name in names}
        points = capture.points.double().numpy() @ rotation.T
        colors = None if capture.point_colors is None else capture.point_colors.numpy()
        return CameraSet(cameras, capture.in_time(capture.train), points, colors, rotation, seconds)

    @property
    def is_distorted(self) -> bool:
        """Whether any lens is no pinhole."""
        return any(camera.distortion is not None for camera in self.cameras.values())

    @property
    def has_panoramas(self) -> bool:
        """Whether any lens is equirectangular."""
        return any(camera.is_panorama for camera in self.cameras.values())


def held_lens(name: str, camera: Camera, count: int) -> Lens:
    """The lens of a camera; raises ValueError if it has more than ``count`` coefficients of a radial lens."""
    lens = Lens.of(camera)
    if lens.model == "radial" and len(lens.coefficients) > count:
        raise ValueError(
            f"camera {name}: its lens has coefficients beyond the {count} that the format holds, of OpenCV's "
            f"rational or prism terms; use {'--cameras colmap' if len(lens.coefficients) <= 8 else '--cameras usd'}"
        )
    return lens


def _turned(camera: Camera, rotation: Float64[np.ndarray, "3 3"]) -> Camera:
    """The same camera in rotated coordinates."""
    viewmat = camera.viewmat.double()
    turned = torch.cat([viewmat[:, :3] @ torch.from_numpy(rotation.T), viewmat[:, 3:]], 1)
    return dataclasses.replace(camera, viewmat=turned.float())
