"""Dense geometry of a moving camera: where every pixel would lie if the scene stood still, and how badly that fits.

Optical flow gives every pixel of a frame its places in other frames. With the pixel's ray X = (x, y, 1) and the pose
(R, T) of another frame relative to it, a static point of inverse depth ρ is seen there on the plane z = 1 at

    u = (Y₁ + ρ T₁) / (Y₃ + ρ T₃),  v = (Y₂ + ρ T₂) / (Y₃ + ρ T₃),   Y = R X,

two equations linear in ρ: ρ (u T₃ − T₁) = Y₁ − u Y₃, and alike for v. All frames' equations are solved together by
iteratively reweighted least squares, each divided by its depth so that errors are in pixels, and weighted by
1 / |error| so that what most frames agree on wins. What is left over is motion, occlusion or wrong flow.
"""

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from warpgs.data.lens import Lens

PARALLAX = (4.0, 8.0, 16.0)
"""Parallax that neighbours in each direction of time should have, in pixels of a picture 512 wide."""

WINDOW = 16
"""Frames to look for neighbours in, in each direction."""

ROUNDS = 5
"""Of reweighting; more do not change the masks."""

FLOW_NOISE = 0.4
"""Standard deviation of good flow [px]."""

MAX_ERROR = 100.0
"""Errors are cut off there [px]: points behind a camera have none that means anything."""

CACHED_FLOWS = 200
"""Flows kept, 0.8 MB each at working size."""

MIN_OBSERVATIONS = 2

MIN_RELATIVE_DEPTH = 1e-2
"""Depth under which a point counts as behind a camera, as a share of its depth in its own frame."""


@dataclass(frozen=True)
class Observation:
    """Where another frame sees the pixels of a frame.

    Attributes:
        place: [2, H, W] on the other frame's plane z = 1.
        turned: [3, H, W] Y, the pixels' rays in the other frame's axes.
        shift: [3] T, from the frame to the other.
        seen: [H, W] whether the place can be trusted.
    """

    place: Float[np.ndarray, "2 H W"]
    turned: Float[np.ndarray, "3 H W"]
    shift: Float[np.ndarray, "3"]
    seen: Bool[np.ndarray, "H W"]


@dataclass(frozen=True)
class LocalGeometry:
    """What other frames say of a frame's pixels.

    Attributes:
        inverse_depth: [H, W] ρ in the units of the poses; NaN where fewer than two frames see the pixel.
        sigma: [H, W] standard deviation of ρ.
        residual: [H, W] mean distance of the pixel's places from those of the static point [px]; NaN as above.
    """

    inverse_depth: Float[np.ndarray, "H W"]
    sigma: Float[np.ndarray, "H W"]
    residual: Float[np.ndarray, "H W"]


class Flows:
    """Optical flow (DIS) between frames of one size; the last ones asked for are kept. Threads may share it."""

    def __init__(self, images: Sequence[UInt8[np.ndarray, "H W 3"]]) -> None:
        # Local contrast makes dark regions count as much as bright ones.
        contrast = cv2.createCLAHE(2.0, (8, 8))
        self.planes = [contrast.apply(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)) for image in images]
        self._engines = threading.local()
        self._kept: OrderedDict[tuple[int, int], np.ndarray] = OrderedDict()
        self._lock = threading.Lock()
        height, width = self.planes[0].shape
        self.x, self.y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))

    def between(self, a: UInt8[np.ndarray, "H W"], b: UInt8[np.ndarray, "H W"]) -> Float[np.ndarray, "H W 2"]:
        """[H, W, 2] how far every pixel of a has moved in b [px]."""
        if not hasattr(self._engines, "dis"):
            self._engines.dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        return self._engines.dis.calc(a, b, None)

    def flow(self, a: int, b: int) -> Float[np.ndarray, "H W 2"]:
        """[H, W, 2] how far every pixel of frame a has moved in frame b [px]."""
        with self._lock:
            kept = self._kept.get((a, b))
            if kept is not None:
                self._kept.move_to_end((a, b))
        if kept is None:
            kept = self.between(self.planes[a], self.planes[b]).astype(np.float16)
            with self._lock:
                self._kept[a, b] = kept
                if len(self._kept) > CACHED_FLOWS:
                    self._kept.popitem(last=False)
        return kept.astype(np.float32)

    def places(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray, Bool[np.ndarray, "H W"]]:
        """Column and row in b of every pixel of a, and whether the flow back from there returns to it."""
        forth, back = self.flow(a, b), self.flow(b, a)
        x, y = self.x + forth[..., 0], self.y + forth[..., 1]
        outside = (1e4, 1e4, 0.0, 0.0)
        returned = forth + cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
        slack = 0.5 + 0.05 * np.hypot(forth[..., 0], forth[..., 1])
        return x, y, np.hypot(returned[..., 0], returned[..., 1]) < slack


class PosedFrames:
    """Pictures of one lens with their poses.

    Attributes:
        flows: Optical flow between them.
        lens: It.
        poses: [F, 3, 4] world to camera.
        points: [P, 3] some points of the scene.
        rays: [H, W, 2] x, y on the plane z = 1 of every pixel's centre.
    """

    def __init__(
        self,
        images: Sequence[UInt8[np.ndarray, "H W 3"]],
        lens: Lens,
        poses: Float[np.ndarray, "F 3 4"],
        points: Float[np.ndarray, "P 3"],
    ) -> None:
        self.flows, self.lens, self.poses = Flows(images), lens, poses
        self.points = points[:: max(1, len(points) // 400)]
        self.rays = _rays(lens)
        self._ray_planes = np.ascontiguousarray(self.rays.transpose(2, 0, 1))

    def relative(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and translation from the camera of a to that of b."""
        rotation = self.poses[b, :, :3] @ self.poses[a, :, :3].T
        return rotation.astype(np.float32), (self.poses[b, :, 3] - rotation @ self.poses[a, :, 3]).astype(np.float32)

    def turned(self, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 H W"]:
        """[3, H, W] the pixels' rays (x, y, 1), turned."""
        x, y = self._ray_planes
        return np.stack([a * x + b * y + c for a, b, c in rotation.astype(np.float32)])

    def parallax(self, a: int, b: int) -> float:
        """Median distance of where b sees the points in front of a from where it would had it only turned [px]."""
        seen = self.points @ self.poses[a, :, :3].T + self.poses[a, :, 3]
        rotation, shift = self.relative(a, b)
        turned = seen @ rotation.T
        moved = turned + shift
        front = (seen[:, 2] > 0) & (turned[:, 2] > 0) & (moved[:, 2] > 0)
        if not front.any():
            return 0.0
        turned, moved = turned[front], moved[front]
        apart = moved[:, :2] / moved[:, 2:] - turned[:, :2] / turned[:, 2:]
        return float(self.lens.focal[0] * np.median(np.hypot(apart[:, 0], apart[:, 1])))

    def neighbours(self, frame: int) -> list[int]:
        """Up to three frames in each direction of time, the nearest that have enough parallax.

        Where the camera hardly moves within the window, its last frame has to do.
        """
        chosen = []
        for step in (-1, 1):
            offset = 0
            for wanted in PARALLAX:
                offset += 1
                while offset < WINDOW and 0 <= frame + step * (offset + 1) < len(self.poses):
                    if self.parallax(frame, frame + step * offset) >= wanted * self.lens.width / 512:
                        break
                    offset += 1
                if not 0 <= frame + step * offset < len(self.poses):
                    break
                chosen.append(frame + step * offset)
        return chosen

    def observations(self, frame: int) -> list[Observation]:
        """Where the frame's neighbours see its pixels, by optical flow."""
        found = []
        for other in self.neighbours(frame):
            x, y, seen = self.flows.places(frame, other)
            rotation, shift = self.relative(frame, other)
            place = cv2.remap(self.rays, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            found.append(
                Observation(np.ascontiguousarray(place.transpose(2, 0, 1)), self.turned(rotation), shift, seen)
            )
        return found


def _rays(lens: Lens) -> Float[np.ndarray, "H W 2"]:
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    K = np.array([[lens.focal[0], 0, lens.center[0]], [0, lens.focal[1], lens.center[1]], [0, 0, 1.0]])
    k1, k2, k3 = lens.radial
    bent = np.stack([u, v], -1).reshape(-1, 1, 2)
    straight = cv2.undistortPoints(bent, K, np.array([k1, k2, *lens.tangential, k3]))
    return straight.reshape(lens.height, lens.width, 2).astype(np.float32)


def errors(observation: Observation, rho: Float[np.ndarray, "H W"], focal: float) -> Float[np.ndarray, "H W"]:
    """Distance of the observation's places from those of static points of inverse depth ρ [px]."""
    depth = np.maximum(observation.turned[2] + rho * observation.shift[2], MIN_RELATIVE_DEPTH)
    dx = (observation.turned[0] + rho * observation.shift[0]) / depth - observation.place[0]
    dy = (observation.turned[1] + rho * observation.shift[1]) / depth - observation.place[1]
    return np.minimum(np.float32(focal) * np.sqrt(dx * dx + dy * dy), MAX_ERROR)


def triangulate(observations: Sequence[Observation], focal: float) -> LocalGeometry:
    """Inverse depth of every pixel of a frame from where other frames see it.

    Args:
        observations: At least one.
        focal: Focal length, so that residuals are in pixels.
    """
    shape = observations[0].seen.shape
    rho = np.full(shape, 1e-3, np.float32)
    weights = [s.seen.astype(np.float32) for s in observations]
    for _ in range(ROUNDS):
        top, bottom = np.zeros(shape, np.float32), np.full(shape, 1e-12, np.float32)
        for s, weight in zip(observations, weights, strict=True):
            depth = np.maximum(s.turned[2] + rho * s.shift[2], MIN_RELATIVE_DEPTH)
            weight = weight / depth**2
            for axis in range(2):
                slope = s.place[axis] * s.shift[2] - s.shift[axis]
                top += weight * slope * (s.turned[axis] - s.place[axis] * s.turned[2])
                bottom += weight * slope * slope
        rho = np.maximum(top / bottom, 1e-6)
        distances = [errors(s, rho, focal) for s in observations]
        weights = [s.seen / np.maximum(e, FLOW_NOISE) for s, e in zip(observations, distances, strict=True)]
    count = np.sum([s.seen for s in observations], axis=0)
    residual = np.sum([e * s.seen for s, e in zip(observations, distances, strict=True)], axis=0) / np.maximum(count, 1)
    noise = np.maximum(residual, FLOW_NOISE)
    # bottom holds slope² / noise, so bottom · noise is the information of unit weights.
    sigma = noise / (focal * np.sqrt(bottom * noise))
    unknown = count < MIN_OBSERVATIONS
    rho[unknown], residual[unknown] = np.nan, np.nan
    return LocalGeometry(rho, sigma.astype(np.float32), residual.astype(np.float32))


def filled(values: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """The plane with every NaN replaced by the nearest number; zeros if there is none."""
    bad = np.isnan(values)
    if bad.all():
        return np.zeros_like(values)
    if not bad.any():
        return values
    _, nearest = cv2.distanceTransformWithLabels(bad.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    of_label = np.zeros(nearest.max() + 1, values.dtype)
    of_label[nearest[~bad]] = values[~bad]
    return of_label[nearest]
