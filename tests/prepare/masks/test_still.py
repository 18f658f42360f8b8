"""What moves before a camera that stands still."""

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.data.lens import Lens
from warpgs.prepare.cameras.posed_frames import PosedFrames
from warpgs.prepare.masks.methods import find_moving
from warpgs.prepare.masks.motion import find_dynamic
from warpgs.prepare.masks.still import Background

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
    return PosedFrames(images, Lens.centered(230.0, SIZE), np.tile(np.eye(4)[:3], (len(images), 1, 1)), boards.points())


def mean_overlap(masks) -> float:
    return float(np.mean([boards.overlap(mask, disc(k)) for k, mask in enumerate(masks)]))


@pytest.mark.parametrize("noise", [0.0, 6.0])
def test_an_object_of_one_flat_colour_is_found(noise):
    frames = posed(record(noise))
    assert mean_overlap(find_moving(frames, True)) > 0.9
    if noise:
        assert mean_overlap(find_dynamic(frames)) < 0.9  # by motion alone


def test_noise_is_not_masked():
    random = np.random.default_rng(0)
    frames = [np.clip(WALL + 8.0 * random.standard_normal(WALL.shape), 0, 255).astype(np.uint8) for _ in range(16)]
    assert max(mask.mean() for mask in find_moving(posed(frames), True)) < 0.01


def test_a_shadow_and_a_change_of_exposure_count_only_as_such():
    darker = (WALL * 0.6).astype(np.uint8)
    shadow = np.where(disc(5)[..., None], darker, WALL)
    wall = Background(WALL)
    differs, is_shadow = wall.difference(shadow)
    assert is_shadow[disc(5)].mean() > 0.9
    near = cv2.dilate(disc(5).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert differs[disc(5)].mean() > 0.8
    assert differs[~near].max() < 0.5
    brighter = np.clip(WALL.astype(int) + 20, 0, 255).astype(np.uint8)
    assert wall.difference(brighter)[0].mean() < 0.05
    assert not wall.has_other_texture(shadow).any()


def test_a_grey_object_before_a_grey_wall_is_no_shadow():
    """Its colour is the wall's times a factor, its texture is not."""
    grey = boards.texture(3, (140, 140, 140), 256, (8, 25))[: SIZE[1]]
    paint = np.kron(np.random.default_rng(0).integers(60, 121, (48, 64)), np.ones((4, 4)))
    image = np.where(disc(5), paint, grey[..., 0]).astype(np.uint8)[..., None].repeat(3, 2)
    background = Background(grey)
    inner = cv2.erode(disc(5).astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    assert background.difference(image)[1][inner].mean() > 0.8
    other = background.has_other_texture(image)
    assert other[inner].mean() > 0.9
    assert other[cv2.dilate(disc(5).astype(np.uint8), np.ones((9, 9), np.uint8)) == 0].mean() < 0.01


def test_motion_is_looked_for_in_as_many_frames_of_a_long_video_as_of_a_short_one(monkeypatch):
    counts = []

    def nothing(frames: PosedFrames, quiet: bool) -> list[np.ndarray]:
        counts.append(len(frames.images))
        return [np.zeros(SIZE[::-1], bool) for _ in frames.images]

    monkeypatch.setattr("warpgs.prepare.masks.still.find_dynamic", nothing)
    masks = find_moving(posed(record() * 3), True)
    assert counts == [31]
    assert len(masks) == 3 * NUM_FRAMES
    assert mean_overlap(masks[NUM_FRAMES : 2 * NUM_FRAMES]) > 0.9
