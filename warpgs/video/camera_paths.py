"""Camera paths: along the training cameras, around the dynamic part of the scene, or along keyframes."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from warpgs.cameras import Camera, intrinsic_matrix
from warpgs.data.capture import Capture, Frame

SMOOTHING = 0.02
"""Standard deviation of the Gaussian filter over the training camera's path, as a fraction of the path's length."""

MAX_FRAMES = 100_000
"""Maximum number of frames of a path."""

UP = (0.0, -1.0, 0.0)
"""Default upward direction: the cameras of captures have y pointing down."""

DEFAULT_FOCAL = 1.2
"""Focal length of the default camera, in image heights."""

DEFAULT_SIZE = (960, 540)
"""Width and height of the default camera's image [px]."""

DEFAULT_DISTANCE = 2.0
"""Distance of the default camera from the center of the scene, in radii of the scene."""

MAX_DISTANCE = 4.0
"""Maximum distance of a camera from the center of the scene, in radii of the scene."""

RADIUS_QUANTILE = 0.98
"""Fraction of the Gaussians within the radius of the scene: a few outliers are always far away."""

MAX_MEANS = 100_000
"""Maximum number of points that a bounding sphere is computed from (up to a factor of two)."""

SPIRAL_TURNS = 2
"""Full circles of a spiral."""

BULLET_ARC = math.radians(15.0)
"""Maximum angle of bullet time to either side [rad]: a single camera has not seen the scene from further around."""

MAX_TURN = math.radians(45.0)
"""Turn between two frames from which a training camera jumps instead of moving [rad]."""


@dataclass(frozen=True)
class BoundingSphere:
    """A sphere around most of a scene, robust to outliers.

    Attributes:
        center: [3] median of the points.
        radius: Distance from the center within which almost all points lie [scene units].
    """

    center: Float[Tensor, "3"]
    radius: float

    @staticmethod
    def around(points: Float[Tensor, "P 3"], including: Float[Tensor, "Q 3"] | None = None) -> "BoundingSphere":
        """The bounding sphere of points, large enough to contain all of ``including`` as well.

        Raises:
            ValueError: If no point is finite.
        """
        points = points[torch.isfinite(points).all(1)]
        if not len(points):
            raise ValueError("the scene has no Gaussians")
        subset = points[:: max(1, len(points) // MAX_MEANS)]
        center = subset.median(0).values
        radius = float((subset - center).norm(dim=1).quantile(RADIUS_QUANTILE))
        if including is not None and len(including):
            radius = max(radius, float((including - center).norm(dim=1).max()))
        return BoundingSphere(center, max(radius, 1e-6))

    def check(self, cameras: Sequence[Camera], name: str) -> None:
        """Checks that a path stays near the scene.

        Args:
            cameras: The path.
            name: Name of the path for the message.

        Raises:
            ValueError: If a camera is further from the center than ``MAX_DISTANCE`` radii; the message names it.
        """
        for k, camera in enumerate(cameras):
            distance = float((camera.position.cpu() - self.center).norm())
            if not distance <= MAX_DISTANCE * self.radius:
                position = ", ".join(f"{v:.3g}" for v in camera.position.tolist())
                raise ValueError(
                    f"{name} leaves the scene: camera {k} at ({position}) is {distance:.3g} from its center, "
                    f"the maximum is {MAX_DISTANCE * self.radius:.3g}"
                )


def upward(capture: Capture) -> Float[Tensor, "3"]:
    """The mean upward direction of the training images of a capture, in world coordinates."""
    up = -torch.stack([capture.cameras[name].viewmat[1, :3] for name in capture.train]).mean(0)
    return up if float(up.norm()) > 1e-3 else torch.tensor(UP, dtype=torch.float32)


def default_camera(sphere: BoundingSphere, side: tuple[float, float] = (0.0, -1.0), time: float = 0.0) -> Camera:
    """A camera that sees most of a scene, with y pointing down.

    The direction from the center of the scene to the camera has ``side`` as its x and z.
    """
    position = sphere.center + DEFAULT_DISTANCE * sphere.radius * torch.tensor(
        [side[0], 0.0, side[1]], dtype=torch.float32
    )
    focal = DEFAULT_FOCAL * DEFAULT_SIZE[1]
    return Camera.looking_at(position, sphere.center, torch.tensor(UP, dtype=torch.float32), focal, DEFAULT_SIZE, time)


def default_capture(means: Float[Tensor, "N 3"], name: str) -> Capture:
    """A capture without images whose cameras see a scene from the left, the front and the right, with y pointing down.

    Args:
        means: Centres of the Gaussians [scene units].
        name: Name of the capture.
    """
    sphere, sides = BoundingSphere.around(means), {"left": (-1.0, 0.0), "front": (0.0, -1.0), "right": (1.0, 0.0)}
    times = evenly_spaced(len(sides))
    cameras = {view: default_camera(sphere, sides[view], time) for view, time in zip(sides, times, strict=True)}

    def read(view: str) -> Frame:
        raise ValueError(f"{name} has no image of {view}")

    return Capture(name, cameras, [*sides], [], means[:: max(1, len(means) // MAX_MEANS)], None, read)


def at_times(camera: Camera, times: Sequence[float]) -> list[Camera]:
    """A fixed camera at several times."""
    return _with_times([camera] * len(times), times)


def _with_times(path: Sequence[Camera], times: Sequence[float]) -> list[Camera]:
    return [dataclasses.replace(camera, time=time) for camera, time in zip(path, times, strict=True)]


def evenly_spaced(frames: int) -> list[float]:
    """Evenly spaced times from 0 to 1, one per frame."""
    return [k / max(1, frames - 1) for k in range(frames)]


def training_path(capture: Capture, frames: int, smoothing: float = SMOOTHING) -> list[Camera]:
    """The training cameras in the order of their times, smoothed, with time running over [0, 1].

    Of several cameras, it is that of the one with the most frames; if two frames have one time, the first one counts.
    """
    recorded, times = _in_time(capture), evenly_spaced(frames)
    size = recorded[0].size
    views = [camera if camera.size == size else filling(camera, size) for camera in recorded]
    path = interpolated(views, [camera.time for camera in recorded], times)
    path = _smoothed(path, smoothing * max(1, frames - 1)) if smoothing > 0 and frames > 2 else path
    return _with_times(path, times)


def replay(capture: Capture, frames: int) -> list[Camera]:
    """Cameras while time runs from 0 to 1: the training path, or the middle view if the training camera jumps.

    Seen from elsewhere, what moves would show sides at times at which no training frame shows them.
    """
    if jumps(capture):
        return at_times(capture.cameras[middle_view(capture)].pinhole, evenly_spaced(frames))
    return training_path(capture, frames)


def middle_view(capture: Capture) -> str:
    """Name of the middle evaluation view, or training view if there is none."""
    names = capture.val or capture.train
    return names[len(names) // 2]


def jumps(capture: Capture) -> bool:
    """Whether the training camera turns by more than ``MAX_TURN`` between most frames, as in D-NeRF."""
    rotations = [Rotation.from_matrix(_rotation(camera)) for camera in _in_time(capture)]
    turns = [(b * a.inv()).magnitude() for a, b in pairwise(rotations)]
    return bool(turns) and float(np.median(turns)) > MAX_TURN


def _in_time(capture: Capture) -> list[Camera]:
    """The training frames of one camera in the order of their times, one for each time, as pinholes."""
    by_time: dict[float, Camera] = {}
    of_camera = max(capture.by_camera(capture.train).values(), key=len)
    for name in (name for name in capture.train if name in {*of_camera}):
        by_time.setdefault(capture.cameras[name].time, capture.cameras[name].pinhole)
    return [by_time[time] for time in sorted(by_time)]


def interpolated(
    cameras: Sequence[Camera], knots: Sequence[float], at: Sequence[float], smooth: bool = False
) -> list[Camera]:
    """Interpolates between cameras: rotations by slerp, focal lengths geometrically, the rest linearly.

    Args:
        cameras: At least one, all of the same size.
        knots: Parameter of each camera on the path, strictly increasing.
        at: Parameters of the wanted cameras, clamped to the first and the last knot.
        smooth: Whether to interpolate positions by monotone cubics, which never overshoot, instead of linearly.
    """
    first = cameras[0]
    if len(cameras) == 1:
        return [first for _ in at]
    x = np.asarray(knots, np.float64)
    wanted = np.clip(np.asarray(at, np.float64), x[0], x[-1])
    rotations = Slerp(x, Rotation.from_matrix(np.stack([_rotation(c) for c in cameras])))(wanted).as_matrix()
    values = [
        np.stack([c.position.double().cpu().numpy() for c in cameras]),
        np.log([[float(c.K[0, 0]), float(c.K[1, 1])] for c in cameras]),
        np.array([[float(c.K[0, 2]), float(c.K[1, 2]), c.time] for c in cameras]),
    ]
    positions, focals, others = (np.stack([np.interp(wanted, x, column) for column in part.T], 1) for part in values)
    if smooth:
        positions = PchipInterpolator(x, values[0])(wanted)
    path = []
    for r, p, (fx, fy), (cx, cy, time) in zip(rotations, positions, np.exp(focals), others, strict=True):
        path.append(Camera.posed(r, p, intrinsic_matrix((fx, fy), (cx, cy)), first.size, float(time)))
    return path


def _smoothed(path: list[Camera], sigma: float) -> list[Camera]:
    """Applies a Gaussian filter of ``sigma`` frames to the positions and rotations of a path."""
    positions = gaussian_filter1d(np.stack([c.position.double().numpy() for c in path]), sigma, axis=0, mode="nearest")
    mixed = gaussian_filter1d(np.stack([_rotation(c) for c in path]), sigma, axis=0, mode="nearest")
    U, _, Vt = np.linalg.svd(mixed)  # the rotation nearest to each mean
    rotations = U @ Vt
    return [Camera.posed(r, p, c.K.numpy(), c.size, c.time) for c, r, p in zip(path, rotations, positions, strict=True)]


def _rotation(camera: Camera) -> np.ndarray:
    return camera.viewmat[:3, :3].double().cpu().numpy()


def focus(camera: Camera, *clouds: Float[Tensor, "_ 3"]) -> float:
    """Median depth [scene units] of the points that a camera sees, of the first cloud of which it sees any; else 1."""
    for points in clouds:
        _, _, depth, inside = camera.project(points[torch.isfinite(points).all(1)])
        if bool(inside.any()):
            return float(depth[inside].median())
    return 1.0


def spiral(camera: Camera, distance: float, reach: float, times: Sequence[float]) -> list[Camera]:
    """A camera that looks at a point while it circles ``SPIRAL_TURNS`` times, moving closer and back.

    Args:
        camera: Camera at the center of the circles.
        distance: Depth of the point [scene units].
        reach: Radius of the circles [scene units].
        times: Time of each frame.
    """
    path = []
    for k, time in enumerate(times):
        angle = 2.0 * math.pi * SPIRAL_TURNS * k / len(times)
        offset = [reach * math.sin(angle), 0.5 * reach * math.cos(angle), 0.5 * reach * math.sin(angle / SPIRAL_TURNS)]
        path.append(_aimed(camera, torch.tensor(offset, dtype=torch.float32), distance, time))
    return path


def bullet(path: Sequence[Camera], clouds: Sequence[Float[Tensor, "_ 3"]], stop: float, frames: int) -> list[Camera]:
    """Bullet time: time runs up to ``stop``, stops while the camera swings around what it sees, and continues.

    Args:
        path: Cameras while time runs, at evenly spaced times; a single one stays where it is.
        clouds: Points at the stop; the camera swings around their ``focus``.
        stop: Time in [0, 1] at which time stops.
        frames: Total number of frames; half of them belong to the swing.
    """
    swing = (frames + 1) // 2
    before = round((frames - swing) * stop)
    after = frames - swing - before
    times = [stop * k / max(1, before) for k in range(before)] + [stop]
    times += [stop + (1.0 - stop) * (k + 1) / after for k in range(after)]
    running = _with_times(interpolated(path, evenly_spaced(len(path)), times), times)
    stopped = running[before]
    distance = focus(stopped, *clouds)
    swung = []
    for k in range(swing):
        part = (k + 1) / (swing + 1)
        angle = BULLET_ARC * math.sin(2.0 * math.pi * part**2 * (3.0 - 2.0 * part))  # slow at both ends
        offset = [distance * math.sin(angle), 0.0, distance * (1.0 - math.cos(angle))]
        swung.append(_aimed(stopped, torch.tensor(offset, dtype=torch.float32), distance, stop))
    return running[:before] + swung + running[before + 1 :]


def _aimed(camera: Camera, offset: Float[Tensor, "3"], distance: float, time: float) -> Camera:
    """A camera moved by an offset in its own axes and turned back to the point at ``distance`` on its old axis."""
    axes, position = camera.viewmat[:3, :3], camera.position
    target = position + distance * axes[2]
    moved = Camera.looking_at(position + offset @ axes, target, -axes[1], 1.0, camera.size)
    return Camera(moved.viewmat, camera.K, camera.width, camera.height, time)


def resized(camera: Camera, factor: float) -> Camera:
    """The same view with width and height multiplied by ``factor``.

    Raises:
        ValueError: If the image would have less than one pixel.
    """
    width, height = round(camera.width * factor), round(camera.height * factor)
    if min(width, height) < 1:
        raise ValueError(f"an image of {camera.width} × {camera.height} times {factor:g} has no pixels")
    return camera.resized(width, height)


def filling(camera: Camera, size: tuple[int, int]) -> Camera:
    """The same view at another (width, height), scaled until it fills it, then cropped around its middle.

    The image is never stretched, and shows nothing that the camera does not see.
    """
    width, height = size
    scaled = resized(camera, max(width / camera.width, height / camera.height))
    K = scaled.K.clone()
    K[0, 2] -= (scaled.width - width) // 2
    K[1, 2] -= (scaled.height - height) // 2
    left = width / scaled.width if camera.by_columns else height / scaled.height  # of what is read one after another
    motion, duration = None if camera.motion is None else camera.motion * left, camera.duration * left
    return dataclasses.replace(camera, K=K, width=width, height=height, motion=motion, duration=duration)
