"""A tiny synthetic 360° video: textured walls and boards all around, a camera between them, and a moving board."""

import math
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tests.prepare.boards import COLORS, texture
from warpgs.data import writer
from warpgs.data.lens import Lens
from warpgs.data.units import SceneUnits

WALLS = ((2, 4.0), (2, -4.0), (0, 5.0), (0, -5.0), (1, 2.0), (1, -2.5))
"""Axis and position of the walls, floor and ceiling."""

BOARDS = (  # axis, position, centre and half size on the other two axes: these do not move
    (2, 2.2, (-1.4, 0.5), (0.6, 0.5)),
    (2, -2.0, (1.0, -0.3), (0.7, 0.6)),
    (0, 2.8, (0.3, 1.0), (0.6, 0.8)),
    (0, -3.0, (0.2, -1.2), (0.5, 0.7)),
)

RED = (190, 60, 50)
"""Colour of the moving board."""

SAMPLES = 3
"""Samples of a pixel along each side, one of them in its middle."""


Board = tuple[int, float, tuple[float, float], tuple[float, float], np.ndarray]
"""Axis and position of its plane, centre and half size on the other two axes, and texture."""


def pose(time: float) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotation and position."""
    turn = [0.05 * math.sin(3.0 * time), 0.6 * time, 0.04 * math.cos(4.0 * time)]
    position = [1.6 * (time - 0.5), 0.2 * math.sin(5.0 * time), 0.6 * math.sin(3.0 * time) - 0.3]
    return Rotation.from_euler("xyz", turn).as_matrix(), np.array(position)


@lru_cache
def _still_boards() -> list[Board]:
    walls = [
        (axis, position, (0.0, 0.0), (5.0, 5.0), texture(k, COLORS[k % 4], 1024, (40, 120)))
        for k, (axis, position) in enumerate(WALLS)
    ]
    return [*walls, *((*board, texture(10 + k, COLORS[k], 256, (8, 24))) for k, board in enumerate(BOARDS))]


def _moving_board(time: float) -> Board:
    center = 0.9 * math.sin(5.0 * time), 0.3 + 0.4 * math.cos(6.0 * time)
    return 2, 1.8, center, (0.45, 0.4), texture(9, RED, 128, (4, 12))


def _span(is_seen: np.ndarray) -> slice:
    """From the first to the last that is true."""
    seen = is_seen.nonzero()[0]
    return slice(seen[0], seen[-1] + 1)


def frame(time: float, width: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """[H, W, 3] RGB image, [H, W] mask of the moving board, and [H, W] distance from the camera."""
    rotation, position = pose(time)
    fine = Lens.panorama((SAMPLES * width, SAMPLES * width // 2))
    directions = (fine.rays(*fine.pixel_centers()) @ rotation).astype(np.float32)
    position = position.astype(np.float32)
    nearest, image = np.full(directions.shape[:2], np.inf, np.float32), np.zeros(directions.shape, np.uint8)
    for axis, plane, center, half, paint in (*_still_boards(), _moving_board(time)):
        others = [k for k in range(3) if k != axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (plane - position[axis]) / directions[..., axis]
            on_board = (position[others] + distance[..., None] * directions[..., others] - center) / half
        moves = (distance > 0) & (np.abs(on_board) <= 1).all(-1) & (distance < nearest)
        if (columns := moves.any(0)).any():
            rows, columns = _span(moves.any(1)), _span(columns)
            maps = ((on_board[rows, columns] + 1.0) / 2.0 * (len(paint) - 1)).astype(np.float32)
            painted = cv2.remap(paint, maps, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            image[rows, columns][moves[rows, columns]] = painted[moves[rows, columns]]
        nearest = np.where(moves, distance, nearest)
    middle = slice(SAMPLES // 2, None, SAMPLES)
    small = cv2.resize(image, (width, width // 2), interpolation=cv2.INTER_AREA)
    return small, moves[middle, middle], nearest[middle, middle]


def write_capture(root: Path, num_frames: int, width: int) -> Path:
    """A capture with these frames, masks and points, every fourth frame for evaluation."""
    lens, generator, points = Lens.panorama((width, width // 2)), np.random.default_rng(0), []
    names = [f"{k:03d}" for k in range(num_frames)]
    for k, name in enumerate(names):
        image, moves, distance = frame(k / (num_frames - 1), width)
        rotation, position = pose(k / (num_frames - 1))
        writer.write_image(root, name, image)
        writer.write_mask(root, name, ~moves)
        writer.write_camera(root, name, lens, rotation, position)
        found = (lens.rays(*lens.pixel_centers()) * distance[..., None])[~moves] @ rotation + position
        points.append(generator.permutation(found)[:100])
    writer.write_scene(root, SceneUnits(np.zeros(3), 0.25), np.concatenate(points), near=0.1, far=3.0)
    writer.write_index(root, {name: k for k, name in enumerate(names)}, names[2::4])
    return root
