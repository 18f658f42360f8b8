"""What moves before a camera that stands still."""

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.data.lens import Lens
from warpgs.prepare.cameras.posed_frames import PosedFrames
from warpgs.prepare.masks.methods import find_moving
from warpgs.prepare.masks.motion import find_dynamic
from warpgs.prepare.masks.still import difference, median_where

SIZE = (256, 192)
"""(width, height) [px]."""

NUM_FRAMES = 16

WALL = boards.texture(3, (150, 140, 120), 256, (16, 50))[: SIZE[1]]


def disc(k: int) -> np.ndarray:
    """[H, W] where the object is in a frame: it crosses the image."""
    mask = np.zeros(SIZE[::-1], np.uint8)
    return cv2.circle(mask, (40 + 11 * k, 100), 24, 1, -1) > 0


def record(noise: float = 0.0) -> list[np.ndarray]:
    """[H, W, 3] frames of an object of one flat colour before a wall."""
    random = np.random.default_rng(0)
    frames = [np.where(disc(k)[..., None], np.array([40, 60, 190]), WALL) for k in range(NUM_FRAMES)]
    return [np.clip(f + noise * random.standard_normal(f.shape), 0, 255).astype(np.uint8) for f in frames]


def posed(images: list[np.ndarray]) -> PosedFrames:
    return PosedFrames(images, Lens.centered(230.0, SIZE), np.tile(np.eye(4)[:3], (NUM_FRAMES, 1, 1)), boards.points())


def mean_overlap(masks) -> float:
    return float(np.mean([boards.overlap(mask, disc(k)) for k, mask in enumerate(masks)]))


@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_an_object_of_one_flat_colour_is_found(noise):
    frames = posed(record(noise))
    assert mean_overlap(find_moving(frames, True)) > 0.9
    assert mean_overlap(find_dynamic(frames)) < 0.9  # by motion alone


def test_noise_is_not_masked():
    random = np.random.default_rng(0)
    frames = [np.clip(WALL + 8.0 * random.standard_normal(WALL.shape), 0, 255).astype(np.uint8) for _ in range(16)]
    assert max(mask.mean() for mask in find_moving(posed(frames), True)) < 0.01


def test_a_shadow_and_a_change_of_exposure_count_only_as_such():
    darker = (WALL * 0.6).astype(np.uint8)
    shadow = np.where(disc(5)[..., None], darker, WALL)
    differs, is_shadow = difference(shadow, WALL)
    assert is_shadow[disc(5)].mean() > 0.9
    near = cv2.dilate(disc(5).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert differs[disc(5)].mean() > 0.8
    assert differs[~near].max() < 0.5
    brighter = np.clip(WALL.astype(int) + 20, 0, 255).astype(np.uint8)
    assert difference(brighter, WALL)[0].mean() < 0.05


def test_the_background_is_the_median_of_what_does_not_move():
    """An object that rests in most frames is not in it, unless it is always there."""
    frames = [np.full((2, 3, 3), value, np.uint8) for value in (10, 12, 11, 90, 90, 90, 90)]
    static = [np.full((2, 3), value) for value in (True, True, True, False, False, False, False)]
    for mask in static:
        mask[0, 0] = False
    background = median_where(frames, static)
    assert (background[0, 0] == 90).all()
    assert (background[1] == 11).all()
