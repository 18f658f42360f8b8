"""Which views a capture has filmed: near a training camera, and towards what it saw.

A view is ``outside`` by a number that is 0 at a training camera and 1 at the border of what was filmed. For one camera
with centre p, forward axis f, depth d of what it sees and half the field of view φ, a view at q that looks along g is
outside by the larger of

    |offset| / (d tan REACH)    with offset = q - p, whose part along f counts half: it shows the same sides
    angle(q + d g - p, f) / φ   of the point that the view looks at

and for several cameras by the smallest of these numbers. The page has the same formulas in JavaScript.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.data.sampling import evenly_spaced_indices

from .camera_paths import BULLET_ARC, focus

REACH = math.tan(BULLET_ARC)
"""Distance from a camera to the border of what was filmed, relative to the depth of what it sees."""

DRAG_LIMIT = 1.5
"""How far outside the mouse can move a view."""

SPACING = 0.25
"""Cameras that are less outside than this of another one are skipped."""

MAX_CAMERAS, MAX_POINTS = 400, 5_000
"""Maximum number of cameras that are looked at, and of points that their depths are measured from."""


@dataclass(frozen=True)
class Filmed:
    """What was filmed.

    Attributes:
        positions: Centres of cameras [scene units].
        forwards: Unit vectors along their optical axes.
        depths: Median depth of what each sees [scene units].
        angles: Half the smaller field of view of each [rad].
    """

    positions: Float[np.ndarray, "C 3"]
    forwards: Float[np.ndarray, "C 3"]
    depths: Float[np.ndarray, "C"]
    angles: Float[np.ndarray, "C"]

    @staticmethod
    def by(capture: Capture, *clouds: Float[Tensor, "_ 3"]) -> "Filmed":
        """What the training cameras of a capture have filmed.

        Args:
            capture: The capture.
            clouds: Points of the scene, for cameras that see no points of the capture.
        """
        points = [cloud[:: max(1, len(cloud) // MAX_POINTS)] for cloud in (capture.points, *clouds)]
        cameras = [capture.cameras[name] for name in capture.in_time(capture.train)]
        seen = Filmed(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
        for k in evenly_spaced_indices(len(cameras), MAX_CAMERAS):
            if seen.outside(*position_and_axis(cameras[k])) > SPACING:
                seen = seen._with(cameras[k], focus(cameras[k], *points))
        return seen

    def outside(self, position: Float[np.ndarray, "3"], forward: Float[np.ndarray, "3"]) -> float:
        """How far a view is outside of what was filmed: at most 1 within it; infinite without cameras.

        Args:
            position: Centre of the view [scene units].
            forward: Unit vector along its optical axis.
        """
        offsets = position - self.positions
        along = (offsets * self.forwards).sum(1, keepdims=True)
        distances = np.linalg.norm(offsets - 0.5 * along * self.forwards, axis=1)
        rays = offsets + self.depths[:, None] * forward
        cosines = (rays * self.forwards).sum(1) / np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
        turns = np.arccos(np.clip(cosines, -1.0, 1.0))
        return float(np.maximum(distances / (REACH * self.depths), turns / self.angles).min(initial=math.inf))

    def depth(self, position: Float[np.ndarray, "3"]) -> float:
        """Depth of what the camera sees that is nearest to a position [scene units]."""
        return float(self.depths[np.linalg.norm(self.positions - position, axis=1).argmin()])

    def _with(self, camera: Camera, depth: float) -> "Filmed":
        position, forward = position_and_axis(camera)
        half = 0.5 * min(camera.width / float(camera.K[0, 0]), camera.height / float(camera.K[1, 1]))
        return Filmed(
            np.concatenate([self.positions, position[None]]),
            np.concatenate([self.forwards, forward[None]]),
            np.append(self.depths, depth),
            np.append(self.angles, math.pi if camera.is_panorama else math.atan(half)),
        )


def position_and_axis(camera: Camera) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Centre and optical axis of a camera."""
    return camera.position.double().cpu().numpy(), camera.viewmat[2, :3].double().cpu().numpy()
