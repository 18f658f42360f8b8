"""Frames at working size with their poses: parallax, neighbours, and where neighbours observe a frame's pixels."""

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from warpgs.data.lens import Lens

from ..frames.circle import circle_in, spread
from ..frames.flow import Flows
from ..frames.images import read_images, resize_to_side
from .recovered import Cameras, are_apart, camera_centers
from .triangulation import MIN_RELATIVE_DEPTH, LocalGeometry, Observation

PARALLAX = (4.0, 8.0, 16.0)
"""Parallax that the neighbours in each temporal direction should have [px of an image 512 wide]."""

WINDOW = 16
"""Number of frames in each temporal direction that neighbours are chosen from."""


OFFSETS = (2, 4, 8)
"""Neighbours in each temporal direction of a camera that stays at one place [frames]."""


class PosedFrames:
    """Images of one lens with their poses.

    Attributes:
        images: [H, W, 3] of every frame; around the circle of a fisheye lens with the colours of its rim.
        shown: [H, W] true inside that circle; None if images have none.
        lens: The lens.
        poses: [F, 3, 4] world to camera.
        points: [P, 3] some points of the scene.
        focal: Focal length in the pixels that errors are counted in.
        rays: [H, W, 2] x, y on the plane z = 1 of every pixel's centre.
        neighbours: Up to six frames near each frame, see ``_neighbours``.
        triangulated: What the search for motion has triangulated from neighbours, by frame. Depth takes it from here,
            so that the optical flow of frames that are given to both is computed once. None: it is not kept.
    """

    def __init__(
        self,
        images: Sequence[UInt8[np.ndarray, "H W 3"]],
        lens: Lens,
        poses: Float[np.ndarray, "F 3 4"],
        points: Float[np.ndarray, "P 3"],
        focal: float | None = None,
    ) -> None:
        """Chooses the neighbours.

        Args:
            images: [H, W, 3] of every frame.
            lens: The lens.
            poses: [F, 3, 4] world to camera.
            points: [P, 3] some points of the scene; a few hundred are used.
            focal: Focal length in the pixels that errors are counted in; that of the lens if None.
        """
        self.shown = circle_in(images) if lens.model == "fisheye" else None
        self.images = images if self.shown is None else spread(images, self.shown)
        self.lens, self.poses = lens, poses
        self.points = points[:: max(1, len(points) // 400)]
        self.focal = lens.focal[0] if focal is None else focal
        self.rays = pixel_rays(lens)
        self._ray_planes = np.ascontiguousarray(self.rays.transpose(2, 0, 1))
        self._columns = np.arange(0.5, lens.width, dtype=np.float32)
        self._rows = np.arange(0.5, lens.height, dtype=np.float32)[:, None]
        self.neighbours = [self._neighbours(frame) for frame in range(len(poses))]
        self.triangulated: dict[int, LocalGeometry] | None = None

    @cached_property
    def halved(self) -> "PosedFrames":
        """The frames at half the size, whose errors are still counted in pixels of this one."""
        height, width = self.images[0].shape[:2]
        size = max(1, round(width / 2)), max(1, round(height / 2))
        images = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in self.images]
        return PosedFrames(images, self.lens.resized(*size), self.poses, self.points, self.focal)

    def chosen(self, frames: Sequence[int]) -> "PosedFrames":
        """Some of the frames, as if there were no others."""
        images = [self.images[k] for k in frames]
        return PosedFrames(images, self.lens, self.poses[frames], self.points, self.focal)

    @property
    def stand_still(self) -> bool:
        """Whether all frames have one pose."""
        return bool((self.poses == self.poses[0]).all())

    def relative(self, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and translation from the camera of a to that of b."""
        rotation = self.poses[b, :, :3] @ self.poses[a, :, :3].T
        translation = self.poses[b, :, 3] - rotation @ self.poses[a, :, 3]
        return rotation.astype(np.float32), translation.astype(np.float32)

    def rotated_rays(self, rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 H W"]:
        """[3, H, W] the pixels' rays (x, y, 1), rotated."""
        x, y = self._ray_planes
        return np.stack([a * x + b * y + c for a, b, c in rotation.astype(np.float32)])

    def parallax(self, a: int, b: int) -> float:
        """Median displacement that the translation from a to b, without its rotation, causes in b [px]."""
        in_a = self.points @ self.poses[a, :, :3].T + self.poses[a, :, 3]
        rotation, translation = self.relative(a, b)
        rotated = in_a @ rotation.T
        in_b = rotated + translation
        front = (in_a[:, 2] > 0) & (rotated[:, 2] > 0) & (in_b[:, 2] > 0)
        if not front.any():
            return 0.0
        rotated, in_b = rotated[front], in_b[front]
        displacement = in_b[:, :2] / in_b[:, 2:] - rotated[:, :2] / rotated[:, 2:]
        return float(self.lens.focal[0] * np.median(np.hypot(displacement[:, 0], displacement[:, 1])))

    def _neighbours(self, frame: int) -> list[int]:
        """Up to three frames in each temporal direction, the nearest with enough parallax.

        Where the camera hardly moves within the window, the last frame of the window is used. A camera that stays at
        one place has ``OFFSETS``: what is static is where its rotation takes it.
        """
        if not are_apart(camera_centers(self.poses)):
            return [k for o in OFFSETS for k in (frame - o, frame + o) if 0 <= k < len(self.poses)]
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

    def expected_flow(self, a: int, b: int) -> Float[np.ndarray, "H W 2"]:
        """[H, W, 2] displacement of the pixels of a in b, if all were at the points' median depth [px].

        It is no longer than the image is wide; zero where that would be behind the camera.
        """
        depths = self.points @ self.poses[a, 2, :3] + self.poses[a, 2, 3]
        depths = depths[depths > 0]
        rho = 1.0 / float(np.median(depths)) if len(depths) else 0.0
        rotation, translation = self.relative(a, b)
        rotated = self.rotated_rays(rotation)
        depth = rotated[2] + rho * translation[2]
        front = depth > MIN_RELATIVE_DEPTH
        depth[~front] = 1.0
        x, y = (rotated[0] + rho * translation[0]) / depth, (rotated[1] + rho * translation[1]) / depth
        column, row = self.lens.image(x, y)
        flow = np.stack([column - self._columns, row - self._rows], -1)
        flow[~front] = 0.0
        return np.clip(flow, -self.lens.width, self.lens.width, out=flow)

    def observations(self, frame: int, flows: Flows) -> list[Observation]:
        """Where the frame's neighbours observe its pixels, by optical flow between the images."""
        found = []
        for other in self.neighbours[frame]:
            x, y, visible = flows.track(frame, other)
            if self.shown is not None:
                visible &= self.shown & (cv2.remap(self.shown.astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0)
            rotation, translation = self.relative(frame, other)
            position = cv2.remap(self.rays, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            position = np.ascontiguousarray(position.transpose(2, 0, 1))
            found.append(Observation(position, self.rotated_rays(rotation), translation, visible))
        return found


def load_posed_frames(folder: Path, cameras: Cameras, side: int, max_factor: float = math.inf) -> PosedFrames:
    """The frames <folder>/<name>.png of cameras in full size, resized to a longer side of ``side`` pixels."""
    images = [resize_to_side(image, side, max_factor) for image in read_images(folder, cameras.names)]
    height, width = images[0].shape[:2]
    return PosedFrames(images, cameras.lens.resized(width, height), cameras.poses, cameras.points)


def pixel_rays(lens: Lens) -> Float[np.ndarray, "H W 2"]:
    """[H, W, 2] x, y on the plane z = 1 of the centre of every pixel of a distorted image."""
    return np.stack(lens.unproject(*lens.pixel_centers()), -1).astype(np.float32)


def common_lens(lenses: Sequence[Lens]) -> Lens:
    """The lens of all frames, or a pinhole with the medians of their focal lengths and principal points."""
    if len(set(lenses)) == 1:
        return lenses[0]
    fx, fy, cx, cy = np.median([(*lens.focal, *lens.center) for lens in lenses], axis=0).tolist()
    return Lens(lenses[0].width, lenses[0].height, (fx, fy), (cx, cy))


def resampled(
    image: Float[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"], source: Lens, target: Lens, interpolation: int
) -> Float[np.ndarray, "H W"] | UInt8[np.ndarray, "H W 3"]:
    """What a camera with the lens ``target`` sees of the image of another one at the same place."""
    if source == target:
        return image
    rays = pixel_rays(target)
    x, y = (source.image(rays[..., 0], rays[..., 1]) - 0.5).astype(np.float32)
    return cv2.remap(image, x, y, interpolation, borderMode=cv2.BORDER_REPLICATE)
