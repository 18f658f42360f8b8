"""A tiny synthetic video: textured boards at several depths, a camera that moves past them, and a moving board."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from warpgs.data.lens import Lens
from warpgs.data.writer import held_out
from warpgs.prepare.cameras.posed_frames import PosedFrames
from warpgs.prepare.cameras.recovered import Cameras
from warpgs.prepare.scene import write_frames, write_scene

SIZE = (256, 192)
"""(width, height) of the images [px]."""

FOCAL = 230.0

PLANES = (  # centre, half sizes: static boards facing the camera, the first one is the wall behind them
    ((0.0, 0.0, 6.0), (7.0, 5.0)),
    ((-1.6, 0.6, 4.0), (0.9, 0.8)),
    ((1.5, 0.9, 3.4), (0.7, 0.6)),
    ((0.2, -0.9, 4.6), (0.8, 0.5)),
)

BOARD_HALF = (0.45, 0.4)

COLORS = ((150, 150, 130), (90, 130, 170), (120, 170, 90), (170, 150, 80))
"""Colours of the static boards; the moving board is red."""


def texture(seed: int, color: tuple[int, int, int], size: int, cells: tuple[int, ...]) -> np.ndarray:
    """[size, size, 3] light and dark blobs of one colour."""
    generator = np.random.default_rng(seed)
    light = np.zeros((size, size), np.float32)
    for count in cells:
        noise = generator.normal(0.0, 0.35, (count, count)).astype(np.float32)
        light += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.exp2(light)[..., None] * np.array(color), 0, 255).astype(np.uint8)


def pose(time: float, travel: float = 1.0) -> np.ndarray:
    """[3, 4] world to camera: sideways and up while turning towards the scene."""
    center = travel * np.array([2.4 * time - 1.2, 0.5 * np.sin(3.0 * time), 0.3 * time])
    rotation = cv2.Rodrigues(np.array([0.03 * np.sin(4.0 * time), 0.5 * travel * (time - 0.5), 0.02]))[0]
    return np.hstack([rotation, -rotation @ center[:, None]])


def turning_pose(time: float) -> np.ndarray:
    """[3, 4] the same at one place, turning to and fro and up."""
    turn = np.array([0.1 * np.sin(5.0 * time), 0.25 * np.sin(6.3 * time), 0.04 * np.sin(3.0 * time)])
    return np.hstack([cv2.Rodrigues(turn)[0], np.zeros((3, 1))])


def still_pose(time: float) -> np.ndarray:
    """[3, 4] the same on a tripod."""
    return np.eye(4)[:3]


def board_center(time: float) -> tuple[float, float, float]:
    """Centre of the moving board."""
    return (0.7 * np.sin(5.0 * time), 0.1 + 0.4 * np.cos(6.0 * time), 3.0)


def _render(image: np.ndarray, board: tuple, paint: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Renders a board over the image; returns the mask of its pixels."""
    (x, y, z), (half_x, half_y) = board
    corners = np.array([[x + i * half_x, y + j * half_y, z] for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))])
    in_camera = corners @ view[:, :3].T + view[:, 3]
    pixels = FOCAL * in_camera[:, :2] / in_camera[:, 2:] + np.array(SIZE) / 2.0 - 0.5
    side = len(paint) - 1
    square = np.array([[0, 0], [side, 0], [side, side], [0, side]], np.float32)
    homography = cv2.getPerspectiveTransform(square, pixels.astype(np.float32))
    rendered = cv2.warpPerspective(paint, homography, SIZE, flags=cv2.INTER_AREA)
    where = cv2.warpPerspective(np.ones(paint.shape[:2], np.uint8), homography, SIZE, flags=cv2.INTER_NEAREST) > 0
    image[where] = rendered[where]
    return where


def depth(view: np.ndarray) -> np.ndarray:
    """[H, W] depth of the static boards along the axis of a camera."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays = np.stack([(x - SIZE[0] / 2) / FOCAL, (y - SIZE[1] / 2) / FOCAL, np.ones_like(x)], -1) @ view[:, :3]
    center, nearest = -view[:, :3].T @ view[:, 3], np.full(x.shape, np.inf)
    for middle, half in PLANES:
        distance = (middle[2] - center[2]) / rays[..., 2]
        position = center + distance[..., None] * rays
        hit = (np.abs(position[..., :2] - middle[:2]) <= half).all(-1)
        nearest = np.where(hit, np.minimum(nearest, distance), nearest)
    return nearest


def record(
    num_frames: int = 24, travel: float = 1.0, moves: bool = True, path: Callable[[float], np.ndarray] | None = None
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """[H, W, 3] RGB images, and [H, W] masks of the moving board, from poses on a path, by default ``pose``."""
    paints = [texture(0, COLORS[0], 512, (20, 60)), *(texture(k, COLORS[k], 128, (5, 14)) for k in (1, 2, 3))]
    red = texture(9, (190, 60, 50), 128, (4, 12))
    images, masks = [], []
    for k in range(num_frames):
        time = k / (num_frames - 1)
        image, view = np.zeros((SIZE[1], SIZE[0], 3), np.uint8), pose(time, travel) if path is None else path(time)
        for board, paint in sorted(zip(PLANES, paints, strict=True), key=lambda b: -b[0][0][2]):
            _render(image, board, paint, view)
        mask = np.zeros(SIZE[::-1], bool)
        if moves:
            mask = _render(image, (board_center(time), BOARD_HALF), red, view)
        images.append(image)
        masks.append(mask)
    return images, masks


def through_fisheye(num_frames: int, fisheye: Lens) -> list[np.ndarray]:
    """[H, W, 3] images of the static boards that a fisheye lens takes, of a wide pinhole's."""
    wide, focal = (900, 700), 160.0
    x, y = fisheye.unproject(*np.meshgrid(np.arange(fisheye.width) + 0.5, np.arange(fisheye.height) + 0.5))
    columns, rows = focal * x + wide[0] / 2 - 0.5, focal * y + wide[1] / 2 - 0.5
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.prepare.boards.SIZE", wide)
        patch.setattr("tests.prepare.boards.FOCAL", focal)
        images = [cv2.GaussianBlur(image, (0, 0), 0.7) for image in record(num_frames, moves=False)[0]]
    maps = columns.astype(np.float32), rows.astype(np.float32)
    return [cv2.remap(image, *maps, cv2.INTER_LINEAR) for image in images]


def pan(num_frames: int) -> list[np.ndarray]:
    """[H, W, 3] images of a camera that only turns, over an image."""
    wide = texture(3, (150, 140, 120), 900, (40, 120))
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1.0]])
    crop = np.array([[1, 0, -(900 - SIZE[0]) / 2], [0, 1, -(900 - SIZE[1]) / 2], [0, 0, 1.0]])
    images = []
    for k in range(num_frames):
        turn = cv2.Rodrigues(np.array([0.01 * np.sin(k), 0.6 * (k / num_frames - 0.5), 0.0]))[0]
        images.append(cv2.warpPerspective(wide, K @ turn @ np.linalg.inv(K) @ crop, SIZE))
    return images


def poses(num_frames: int = 24) -> np.ndarray:
    """[F, 3, 4] poses of the video's frames."""
    return np.array([pose(k / (num_frames - 1)) for k in range(num_frames)])


def points(count: int = 400) -> np.ndarray:
    """[count, 3] points on the static boards."""
    generator = np.random.default_rng(1)
    chosen = [PLANES[k % len(PLANES)] for k in range(count)]
    offsets = generator.uniform(-0.6, 0.6, (count, 2))
    return np.array([[c[0] + h[0] * o[0], c[1] + h[1] * o[1], c[2]] for (c, h), o in zip(chosen, offsets, strict=True)])


def lens() -> Lens:
    return Lens(*SIZE, (FOCAL, FOCAL), (SIZE[0] / 2, SIZE[1] / 2))


def true_cameras(folder: object, names: list[str], *rest: object) -> Cameras:
    """Takes the place of ``recover_cameras``."""
    return Cameras(names, lens(), poses(len(names)), points(), 0.1, 10.0)


def distances(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances of camera centres [F, 3] from the true ones after alignment by a similarity."""
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    reflection = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(reflection)).sum() / (a**2).sum()
    return np.linalg.norm(scale * a @ (u @ reflection @ vt).T - b, axis=1)


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two masks."""
    return (a & b).sum() / (a | b).sum()


def write_capture(root: Path, num_frames: int = 16, holdout: int = 0) -> Path:
    """A capture of the video with its true cameras and masks."""
    images, masks = record(num_frames)
    write_folder(root / "frames", images)
    names = [path.stem for path in sorted((root / "frames").iterdir())]
    cameras = true_cameras(root, names)
    write_frames(root, root / "frames", cameras, masks)
    write_scene(root, [cameras], cameras.points, {name: k for k, name in enumerate(names)}, held_out(names, holdout))
    return root


def write_folder(folder: Path, images: list[np.ndarray]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"shot{k:03d}.png"), image[..., ::-1])
    return folder


def write_video(path: Path, images: list[np.ndarray], rate: float = 10.0) -> Path:
    height, width = images[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (width, height))
    for image in images:
        writer.write(image[..., ::-1])
    writer.release()
    return path


def posed(images):
    """Frames with their true cameras."""
    return PosedFrames(images, lens(), poses(len(images)), points())
