"""Cameras: pinholes with a global shutter, or with the distortion of a lens and a rolling shutter."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, Shaped
from torch import Tensor

from .distortion import Distortion
from .runtime.checks import as_number, as_whole_number, check_image_size, check_same_device, check_tensor, one_line_repr
from .shutter import MAX_READOUT, at_middle_row, at_row

Point = Shaped[Tensor, "3"] | Shaped[np.ndarray, "3"] | Sequence[float]
"""Three numbers."""

NUM_ROW_STEPS = 4
"""Steps of the fixed point that finds the row at which a rolling shutter sees a point; each leaves as much of the error
as the point moves over of the image's height during the readout."""

MIN_DEPTH = 1e-6
"""Depth above which a point is in front of the camera [scene units]."""

MAX_ANGLE = 30.0
"""Maximum angle between the orientations of two cameras whose images are compared; farther apart, optical flow is no
evidence [degrees]."""


def intrinsic_matrix(focal: tuple[float, float], center: tuple[float, float]) -> Float[np.ndarray, "3 3"]:
    """K of (x, y) focal lengths and a principal point [px from the image's corner], without skew."""
    return np.array([[focal[0], 0.0, center[0]], [0.0, focal[1], center[1]], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Camera:
    """A camera at one time.

    Attributes:
        viewmat: [4, 4] rigid world-to-camera transform, OpenCV axes (x right, y down, z forward).
        K: [3, 3] intrinsics [px], pixel centres at +0.5, principal point anywhere, no skew.
        width: Width of the image [px].
        height: Height of the image [px].
        time: Time in [0, 1].
        distortion: Of its lens; None for a pinhole.
        motion: [2, 3] how a camera with a rolling shutter turns and moves while its rows are read from the first to the
            last, in its own axes at the middle row, which ``viewmat`` is the pose of: a rotation vector of at most a
            right angle [radians] and a translation [scene units]. View-dependent colours are those at the middle row.
            None for a global shutter.
        duration: With a ``motion``, the time from the first row to the last, in units of ``time``, which is that of the
            middle row; negative if they are read from the last to the first. What moves is seen at its row's time.
        by_columns: Whether columns, from left to right, take the place of rows in a rolling shutter, as in the upright
            images of a phone held upright.
        id: Of the device that films. Frames with one id are one video: their neighbours in time show how objects move,
            and they have one exposure and white balance.

    Raises:
        ValueError: On a wrong shape, dtype, device or size, a time that is not a number, a duration beyond
            [-1, 1], or an id that is not a whole number from 0 on.
    """

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    width: int
    height: int
    time: float = 0.0
    distortion: Distortion | None = None
    motion: Float[Tensor, "2 3"] | None = None
    duration: float = 0.0
    by_columns: bool = False
    id: int = 0

    def __post_init__(self) -> None:
        check_tensor("viewmat", self.viewmat, (4, 4), {})
        check_tensor("K", self.K, (3, 3), {})
        if not isinstance(self.distortion, Distortion | None):
            raise ValueError(f"distortion must be a Distortion or None, got {type(self.distortion).__name__}")
        coefficients = None if self.distortion is None else self.distortion.coefficients
        if self.motion is not None:
            check_tensor("motion", self.motion, (2, 3), {})
        tensors = {"K": self.K, "distortion": coefficients, "motion": self.motion}
        check_same_device({"viewmat": self.viewmat, **tensors})
        object.__setattr__(self, "width", as_whole_number(self.width))
        object.__setattr__(self, "height", as_whole_number(self.height))
        check_image_size(self.width, self.height)
        object.__setattr__(self, "id", as_whole_number(self.id))
        if isinstance(self.id, bool) or not isinstance(self.id, int) or self.id < 0:
            raise ValueError(f"id must be a whole number from 0 on, got {one_line_repr(self.id)}")
        object.__setattr__(self, "time", as_number("time", self.time))
        object.__setattr__(self, "duration", as_number("duration", self.duration))
        if not -1.0 <= self.duration <= 1.0:
            raise ValueError(f"duration must be from -1 to 1, as times are in [0, 1], got {self.duration}")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height)."""
        return self.width, self.height

    @property
    def focal(self) -> Float[Tensor, ""]:
        """Mean focal length of both axes [px], which differ if pixels are not square."""
        return self.K.diagonal()[:2].mean()

    def to(self, device: torch.device | str) -> "Camera":
        """A copy on another device."""
        distortion = None if self.distortion is None else self.distortion.to(device)
        motion = None if self.motion is None else self.motion.to(device)
        viewmat, K = self.viewmat.to(device), self.K.to(device)
        return dataclasses.replace(self, viewmat=viewmat, K=K, distortion=distortion, motion=motion)

    def resized(self, width: int, height: int) -> "Camera":
        """The same view as an image of another size."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=torch.float32, device=self.K.device)
        return dataclasses.replace(self, K=self.K * scale[:, None], width=width, height=height)

    @property
    def position(self) -> Float[Tensor, "3"]:
        """[3] centre of the camera in the world."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def depths(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """Depth of points of the world along the optical axis [scene units], negative behind the camera.

        With a fisheye lens, which may see what is behind the camera, it is their distance from it; with a rolling
        shutter, it is depth at the row that sees them.
        """
        return self._depths(self._viewed(points)[0])

    def delays(self, points: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        """[P] time from that of the camera to that of the row that sees each point of the world.

        Rows continue above and below the image, up to ``MAX_READOUT``.
        """
        return self._viewed(points)[1] * self.duration

    def _viewed(self, points: Float[Tensor, "P 3"]) -> tuple[Float[Tensor, "P 3"], Float[Tensor, " P"]]:
        """[P, 3] points of the world in the axes of the camera, with a rolling shutter at the row that sees them.

        Also [P] the share of the readout from the middle row to that row.
        """
        viewed = in_row = _moved(points, self.viewmat)
        s = torch.zeros_like(points[:, 0])
        if self.motion is not None:
            for _ in range(NUM_ROW_STEPS):
                s = self._readout(self.place(in_row)[0]).clamp(-MAX_READOUT, MAX_READOUT)
                in_row = at_row(viewed, self.motion, s)
        return in_row, s

    def _readout(self, positions: Float[Tensor, "P 2"]) -> Float[Tensor, " P"]:
        """[P] share of the readout from the middle row to the row at positions [px]."""
        along = 0 if self.by_columns else 1
        return positions[:, along] / self.size[along] - 0.5

    def project(
        self, points: Float[Tensor, "P 3"]
    ) -> tuple[Int64[Tensor, " P"], Int64[Tensor, " P"], Float[Tensor, " P"], Bool[Tensor, " P"]]:
        """Projects points of the world to pixels.

        Returns:
            Row and column of the pixel of each point, clamped to the image; its ``depths`` [scene units]; and whether
            the lens sees it and it is inside the image.
        """
        positions, depth, is_seen = self.place(self._viewed(points)[0])
        x, y = positions.floor().unbind(1)
        is_visible = is_seen & (x >= 0) & (x < self.width) & (y >= 0) & (y < self.height)
        return y.clamp(0, self.height - 1).long(), x.clamp(0, self.width - 1).long(), depth, is_visible

    def place(
        self, viewed: Float[Tensor, "P 3"]
    ) -> tuple[Float[Tensor, "P 2"], Float[Tensor, " P"], Bool[Tensor, " P"]]:
        """Positions of points in camera space [px], -1 where there is none; depth as of ``depths``; whether it is seen.

        Positions may be outside of the image. Computed in the precision of the points; camera space is that at the row
        of a point, with a rolling shutter.
        """
        K = self.K.to(viewed)
        depth = self._depths(viewed)
        if self.distortion is None:
            bent, is_seen = viewed[:, :2] / depth[:, None].clamp_min(MIN_DEPTH), depth > MIN_DEPTH
        else:
            bent, is_seen = self.distortion.bend(viewed), (depth > MIN_DEPTH) & self.distortion.sees(viewed)
        return (bent * K.diagonal()[:2] + K[:2, 2]).nan_to_num(-1.0), depth, is_seen

    def _depths(self, viewed: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
        if self.distortion is not None and self.distortion.measures_distance:
            return viewed.norm(dim=1)
        return viewed[:, 2]

    def unproject(
        self, row: Int64[Tensor, " P"], column: Int64[Tensor, " P"], depth: Float[Tensor, " P"]
    ) -> Float[Tensor, "P 3"]:
        """[P, 3] points of the world at the centres of pixels, at a depth as of ``depths`` [scene units].

        They are NaN at pixels that show nothing: the corners of a fisheye lens' circular image.
        """
        positions = torch.stack([column, row], 1).to(depth) + 0.5
        viewed = self.rays(positions) * depth[:, None]
        if self.motion is not None:
            viewed = at_middle_row(viewed, self.motion, self._readout(positions))
        return (viewed - self.viewmat[:3, 3]) @ self.viewmat[:3, :3]

    def rays(self, positions: Float[Tensor, "P 2"]) -> Float[Tensor, "P 3"]:
        """[P, 3] points in camera space, as of ``place``, at depth 1 that are seen at positions [px], NaN at none."""
        K = self.K.to(positions)
        slopes = (positions - K[:2, 2]) / K.diagonal()[:2]
        if self.distortion is None:
            return torch.cat([slopes, torch.ones_like(slopes[:, :1])], 1)
        return self.distortion.rays(slopes)

    def directions(self, rays: Float[Tensor, "P 3"] | None = None) -> Float[Tensor, "P 3"]:
        """[H W, 3] directions in the world that pixels show, row by row, of any length; NaN where nothing is seen.

        Args:
            rays: [H W, 3] ``rays`` of the pixels; None to compute them.
        """
        positions = self.pixel_centers
        viewed = self.rays(positions) if rays is None else rays
        if self.motion is not None:
            turn = torch.stack([self.motion[0], torch.zeros_like(self.motion[1])])
            viewed = at_middle_row(viewed, turn, self._readout(positions))
        return (viewed[:, :, None] * self.viewmat[:3, :3]).sum(1)  # cuBLAS takes longer, as in ``_moved``

    def pixel_areas(self, positions: Float[Tensor, "P 2"]) -> Float[Tensor, " P"]:
        """[P] area at depth 1 of the pixels around positions [px from the corner], NaN where nothing is seen."""
        x, y = positions.new_tensor([0.5, 0.0]), positions.new_tensor([0.0, 0.5])
        across, down = (self.rays(positions + half) - self.rays(positions - half) for half in (x, y))
        return torch.linalg.cross(across, down).norm(dim=1)

    @property
    def pixel_centers(self) -> Float[Tensor, "P 2"]:
        """[H W, 2] centre of every pixel, row by row [px from the corner]."""
        x, y = (torch.arange(side, dtype=torch.float32, device=self.K.device) + 0.5 for side in self.size)
        return torch.cartesian_prod(y, x).flip(1)

    @property
    def shown(self) -> Bool[Tensor, "H W"] | None:
        """[H, W] which pixels show anything: those in the circular image of a fisheye; None if all do."""
        if self.distortion is None or math.isinf(self.distortion.circle):
            return None
        slopes = (self.pixel_centers - self.K[:2, 2]) / self.K.diagonal()[:2]
        return self.distortion.shows(slopes).reshape(self.height, self.width)

    @property
    def is_panorama(self) -> bool:
        """Whether the image is equirectangular."""
        return self.distortion is not None and self.distortion.lens == "equirectangular"

    @property
    def pinhole(self) -> "Camera":
        """The camera without the distortion of its lens and with a global shutter; of a panorama 90 degrees across."""
        if self.is_panorama:
            K = intrinsic_matrix((self.width / 2, self.width / 2), (self.width / 2, self.height / 2))
            return dataclasses.replace(self, K=torch.tensor(K).to(self.K), distortion=None, motion=None, duration=0.0)
        return dataclasses.replace(self, distortion=None, motion=None, duration=0.0)

    @staticmethod
    def posed(
        rotation: Float[np.ndarray, "3 3"],
        position: Float[np.ndarray, "3"],
        K: Float[np.ndarray, "3 3"],
        size: tuple[int, int],
        time: float = 0.0,
    ) -> "Camera":
        """A camera with a world-to-camera rotation and a position, which are combined before they are rounded."""
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
        return Camera(torch.tensor(viewmat, dtype=torch.float32), torch.tensor(K, dtype=torch.float32), *size, time)

    @staticmethod
    def looking_at(
        position: Point, target: Point, up: Point, focal: float, size: tuple[int, int], time: float = 0.0
    ) -> "Camera":
        """A camera that sees ``target`` in the middle of its image.

        Args:
            position: [3] centre of the camera in the world: a tensor, whose device the camera has, an array or a
                sequence, of any type of numbers.
            target: [3] point of the world.
            up: [3] direction that is up in the image.
            focal: Focal length of both axes [px], positive.
            size: (width, height) of the image [px].
            time: Time in [0, 1].

        Raises:
            ValueError: If ``position``, ``target`` or ``up`` is not three finite numbers, ``position`` and ``target``
                coincide, the view direction is parallel to ``up``, the focal length is not one positive and finite
                number, or the size is not two whole numbers.
        """
        device = position.device if isinstance(position, Tensor) else torch.device("cpu")
        position, target, up = (
            _vector(name, value, device) for name, value in (("position", position), ("target", target), ("up", up))
        )
        focal, (width, height) = _focal(focal), _sides(size)
        forward = torch.nn.functional.normalize(target - position, dim=0)
        sideways = torch.linalg.cross(forward, up)
        if not sideways.norm() > 1e-6 * up.norm():
            raise ValueError(
                f"a camera at {position.tolist()} cannot look at {target.tolist()} with {up.tolist()} up: "
                "position and target coincide, or the view direction is parallel to up"
            )
        right = torch.nn.functional.normalize(sideways, dim=0)
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        viewmat = torch.eye(4, dtype=torch.float32, device=device)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ position
        K = intrinsic_matrix((focal, focal), (width / 2, height / 2))
        return Camera(viewmat, torch.tensor(K, dtype=torch.float32, device=device), width, height, time)


def are_comparable(first: Camera, second: Camera) -> bool:
    """Whether two cameras look in directions that are at most ``MAX_ANGLE`` apart."""
    axes = (camera.viewmat[2, :3].double() for camera in (first, second))
    return float(torch.dot(*axes)) >= math.cos(math.radians(MAX_ANGLE))


def _vector(name: str, value: Point, device: torch.device) -> Float[Tensor, "3"]:
    """Three numbers in single precision; a tensor keeps its gradient."""
    try:
        vector = torch.as_tensor(value, dtype=torch.float32, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name} must be three numbers, got {one_line_repr(value)}") from error
    if vector.shape != (3,) or not bool(vector.isfinite().all()):
        raise ValueError(f"{name} must be three finite numbers, got {one_line_repr(vector.tolist())}")
    return vector


def _focal(value: float) -> float:
    """A focal length [px] as a number of Python."""
    focal = as_number("focal", value)
    if not 0.0 < focal < math.inf:
        raise ValueError(f"focal must be positive and finite, got {focal}")
    return focal


def _sides(size: tuple[int, int]) -> tuple[int, int]:
    """The width and height of an image, before they are used as numbers."""
    width: Any
    height: Any
    try:
        width, height = map(as_whole_number, size)
    except (TypeError, ValueError) as error:
        raise ValueError(f"size must be (width, height) [px], got {one_line_repr(size)}") from error
    if isinstance(size, str):
        raise ValueError(f"size must be (width, height) [px], got {size!r}")
    check_image_size(width, height)
    return width, height


def _moved(points: Float[Tensor, "P 3"], motion: Float[Tensor, "4 4"]) -> Float[Tensor, "P 3"]:
    """Points after a rigid motion."""
    if not points.is_cuda:
        return points @ motion[:3, :3].T + motion[:3, 3]
    # cuBLAS takes 100 µs for the product of some ten thousand rows.
    return (points[:, None] * motion[:3, :3]).sum(2) + motion[:3, 3]
