"""Camera paths: through a capture's own cameras, around what moves, or along keyframes."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.data.capture import Capture

SMOOTHING = 0.02
"""Standard deviation by which a filming camera's path is smoothed, as a share of the film."""

MAX_FRAMES = 100_000
"""Of a path."""

UP = (0.0, -1.0, 0.0)
"""Upward direction where nothing tells another: cameras of captures have y down."""

GUESSED_FOCAL = 1.2
"""Focal length of a guessed camera, in heights of its picture."""

GUESSED_SIZE = (960, 540)
GUESSED_DISTANCE = 2.0
"""Distance of a guessed camera from the middle of the scene, in radii of the scene."""

FARTHEST = 4.0
"""A camera further from the middle of the scene than this many of its radii has left it."""

RADIUS_QUANTILE = 0.98
"""Share of a scene's Gaussians within its radius: a few always lie far away."""

MAX_MEANS = 100_000
SPIRAL_TURNS = 2
BULLET_ARC = math.radians(15.0)
"""How far bullet time goes to either side: one camera has not seen what lies further around."""


@dataclass(frozen=True)
class Ball:
    """Where most of a scene is.

    Attributes:
        center: [3] median of what it holds.
        radius: Within which almost all of it lies [scene units].
    """

    center: Float[Tensor, "3"]
    radius: float

    @staticmethod
    def around(points: Float[Tensor, "P 3"], also: Float[Tensor, "Q 3"] | None = None) -> "Ball":
        """The ball of points, large enough for all of ``also``, too.

        Raises:
            ValueError: If there is no point that is finite.
        """
        points = points[torch.isfinite(points).all(1)]
        if not len(points):
            raise ValueError("the scene has no Gaussians")
        some = points[:: max(1, len(points) // MAX_MEANS)]
        center = some.median(0).values
        radius = float((some - center).norm(dim=1).quantile(RADIUS_QUANTILE))
        if also is not None and len(also):
            radius = max(radius, float((also - center).norm(dim=1).max()))
        return Ball(center, max(radius, 1e-6))

    def check(self, cameras: Sequence[Camera], name: str) -> None:
        """Refuses a path that leaves the scene.

        Raises:
            ValueError: If a camera is far outside; the message tells which.
        """
        for k, camera in enumerate(cameras):
            distance = float((camera.position.cpu() - self.center).norm())
            if not distance <= FARTHEST * self.radius:
                place = ", ".join(f"{v:.3g}" for v in camera.position.tolist())
                raise ValueError(
                    f"{name} leaves the scene: camera {k} at ({place}) is {distance:.3g} from its middle, "
                    f"and may be {FARTHEST * self.radius:.3g}"
                )


def upward(capture: Capture) -> Float[Tensor, "3"]:
    """The direction that is up in the pictures of a capture, on average."""
    up = -torch.stack([capture.cameras[name].viewmat[1, :3] for name in capture.train]).mean(0)
    return up if float(up.norm()) > 1e-3 else torch.tensor(UP)


def default_camera(ball: Ball, side: tuple[float, float] = (0.0, -1.0), time: float = 0.0) -> Camera:
    """A camera that sees most of a scene from one side, a direction of x and z, with y pointing down."""
    position = ball.center + GUESSED_DISTANCE * ball.radius * torch.tensor([side[0], 0.0, side[1]])
    focal = GUESSED_FOCAL * GUESSED_SIZE[1]
    return Camera.looking_at(position, ball.center, torch.tensor(UP), focal, GUESSED_SIZE, time)


def at_times(camera: Camera, times: Sequence[float]) -> list[Camera]:
    """One camera while time goes by."""
    return [dataclasses.replace(camera, time=time) for time in times]


def evenly_spaced(frames: int) -> list[float]:
    """So many times over [0, 1]."""
    return [k / max(1, frames - 1) for k in range(frames)]


def evenly_spaced_indices(count: int, max_count: int) -> list[int]:
    """At most ``max_count`` of the indices 0 to ``count`` - 1, evenly spaced, with the first and the last."""
    return [round(fraction * (count - 1)) for fraction in evenly_spaced(min(count, max_count))]


def training_path(capture: Capture, frames: int, smoothing: float = SMOOTHING) -> list[Camera]:
    """The training cameras in the order of their times, smoothed, with time running over [0, 1].

    Where several were filmed at one time, the first of them counts.
    """
    by_time: dict[float, Camera] = {}
    for name in capture.train:
        by_time.setdefault(capture.cameras[name].time, capture.cameras[name])
    times = sorted(by_time)
    moments = evenly_spaced(frames)
    inside = np.clip(moments, times[0], times[-1]).tolist()
    path = interpolated([by_time[time] for time in times], times, inside)
    path = _smoothed(path, smoothing * max(1, frames - 1)) if smoothing > 0 and frames > 2 else path
    return [dataclasses.replace(camera, time=moment) for camera, moment in zip(path, moments, strict=True)]


def interpolated(
    cameras: Sequence[Camera], places: Sequence[float], at: Sequence[float], smooth: bool = False
) -> list[Camera]:
    """Cameras between others: rotations on great arcs, focal lengths in proportion.

    Args:
        cameras: At least one, all of the first one's size.
        places: Where each is on an axis of time, strictly increasing.
        at: Where cameras are wanted, between the first and the last.
        smooth: Whether positions are on curves that never overshoot (monotone cubics), else on straight lines.
    """
    first = cameras[0]
    if len(cameras) == 1:
        return [first for _ in at]
    where = np.asarray(places, np.float64)
    wanted = np.clip(np.asarray(at, np.float64), where[0], where[-1])
    rotations = Slerp(where, Rotation.from_matrix(np.stack([_rotation(c) for c in cameras])))(wanted).as_matrix()
    along = [
        np.stack([c.position.double().cpu().numpy() for c in cameras]),
        np.log([[float(c.K[0, 0]), float(c.K[1, 1])] for c in cameras]),
        np.array([[float(c.K[0, 2]), float(c.K[1, 2]), c.time] for c in cameras]),
    ]
    positions, focals, others = (_along(where, values, wanted) for values in along)
    if smooth:
        positions = PchipInterpolator(where, along[0])(wanted)
    return [
        _camera(first, r, p, (*np.exp(f), *o[:2]), o[2])
        for r, p, f, o in zip(rotations, positions, focals, others, strict=True)
    ]


def _along(places: np.ndarray, values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Each column of values, linearly between places."""
    return np.stack([np.interp(at, places, column) for column in values.T], 1)


def _smoothed(path: list[Camera], sigma: float) -> list[Camera]:
    """A path whose positions and viewing directions are averaged over neighbours."""
    positions = gaussian_filter1d(np.stack([c.position.double().numpy() for c in path]), sigma, axis=0, mode="nearest")
    mixed = gaussian_filter1d(np.stack([_rotation(c) for c in path]), sigma, axis=0, mode="nearest")
    U, _, Vt = np.linalg.svd(mixed)  # the nearest rotation of each mean
    rotations = U @ Vt
    return [
        _camera(c, r, p, (float(c.K[0, 0]), float(c.K[1, 1]), float(c.K[0, 2]), float(c.K[1, 2])), c.time)
        for c, r, p in zip(path, rotations, positions, strict=True)
    ]


def _rotation(camera: Camera) -> np.ndarray:
    return camera.viewmat[:3, :3].double().cpu().numpy()


def _camera(
    like: Camera, rotation: np.ndarray, position: np.ndarray, intrinsics: tuple[float, ...], time: float
) -> Camera:
    """A camera of another's size, from its world-to-camera rotation and its centre."""
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    K = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return Camera(torch.from_numpy(viewmat).float(), K, like.width, like.height, float(time))


def focus(camera: Camera, points: Float[Tensor, "P 3"]) -> float:
    """Distance along a camera's axis of the middle of those points that it sees; 1 if it sees none."""
    points = points[torch.isfinite(points).all(1)]
    if not len(points):
        return 1.0
    _, _, depth, inside = camera.project(points)
    return float(depth[inside].median()) if bool(inside.any()) else 1.0


def spiral(camera: Camera, distance: float, reach: float, times: Sequence[float]) -> list[Camera]:
    """A camera that circles before a point which it keeps in view, ``SPIRAL_TURNS`` times, coming closer and going.

    Args:
        camera: In the middle of the circle.
        distance: Of the point, along the camera's axis [scene units].
        reach: Radius of the circle [scene units].
        times: One a frame.
    """
    path = []
    for k, time in enumerate(times):
        angle = 2.0 * math.pi * SPIRAL_TURNS * k / len(times)
        offset = [reach * math.sin(angle), 0.5 * reach * math.cos(angle), 0.5 * reach * math.sin(angle / SPIRAL_TURNS)]
        path.append(_aimed(camera, torch.tensor(offset), distance, time))
    return path


def bullet(camera: Camera, distance: float, moment: float, frames: int) -> list[Camera]:
    """Time runs up to a moment, stands still while the camera swings around what it sees, and runs on.

    Args:
        camera: Where the camera is while time runs.
        distance: Of the point to swing around, along the camera's axis [scene units].
        moment: At which time stands still.
        frames: In all; half of them are the swing.
    """
    swing = (frames + 1) // 2
    before = round((frames - swing) * moment)
    path = at_times(camera, [moment * k / max(1, before) for k in range(before)])
    for k in range(swing):
        angle = BULLET_ARC * math.sin(2.0 * math.pi * (k + 1) / (swing + 1))
        offset = [distance * math.sin(angle), 0.0, distance * (1.0 - math.cos(angle))]
        path.append(_aimed(camera, torch.tensor(offset), distance, moment))
    after = frames - swing - before
    return path + at_times(camera, [moment + (1.0 - moment) * (k + 1) / after for k in range(after)])


def _aimed(camera: Camera, offset: Float[Tensor, "3"], distance: float, time: float) -> Camera:
    """The camera moved by an offset in its own axes, turned back to the point ahead of it."""
    axes, position = camera.viewmat[:3, :3], camera.position
    target = position + distance * axes[2]
    moved = Camera.looking_at(position + offset @ axes, target, -axes[1], 1.0, camera.size)
    return Camera(moved.viewmat, camera.K, camera.width, camera.height, time)


def resized(camera: Camera, factor: float) -> Camera:
    """The same view in ``factor`` times as many pixels a side.

    Raises:
        ValueError: If less than one pixel is left.
    """
    width, height = round(camera.width * factor), round(camera.height * factor)
    if min(width, height) < 1:
        raise ValueError(f"a picture of {camera.width} × {camera.height} times {factor:g} has no pixels")
    scale = torch.tensor([width / camera.width, height / camera.height, 1.0], device=camera.K.device)
    return Camera(camera.viewmat, camera.K * scale[:, None], width, height, camera.time)
