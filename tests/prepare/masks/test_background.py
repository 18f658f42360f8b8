"""What does not move with the background, without cameras."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.prepare.cameras.recovered import Cameras, NoCamerasError
from warpgs.prepare.frames.images import resize_to_side
from warpgs.prepare.frames.take import Frames, SourceFrame
from warpgs.prepare.masks.background import SIDE, off_background
from warpgs.prepare.masks.files import Masks
from warpgs.prepare.options import Options
from warpgs.prepare.steps import Steps

SIZE = (256, 144)
"""(width, height) [px]."""

BOX = (slice(50, 100), slice(100, 150))
"""Rows and columns of what the camera follows."""


def noise(seed: int, height: int, width: int) -> np.ndarray:
    """[height, width, 3] blobs."""
    values = np.random.default_rng(seed).normal(0.0, 1.0, (height, width)).astype(np.float32)
    values = cv2.GaussianBlur(values, (0, 0), 2.0)
    grey = np.clip(128 + 45 * values / values.std(), 0, 255).astype(np.uint8)
    return np.repeat(grey[..., None], 3, 2)


def followed(count: int, step: int) -> list[np.ndarray]:
    """Frames of a background that passes by ``step`` pixels per frame behind a box that stays in the image."""
    background, box = noise(0, SIZE[1], SIZE[0] + step * count), noise(1, 50, 50)
    frames = []
    for k in range(count):
        frame = background[:, k * step : k * step + SIZE[0]].copy()
        frame[BOX] = box
        frames.append(frame)
    return frames


def off(frames: list[np.ndarray]) -> list[np.ndarray]:
    """What is off the background, in the size of the frames, compared at the size that a preparation does it at."""
    found = off_background([resize_to_side(frame, SIDE) for frame in frames])
    return [cv2.resize(mask.astype(np.uint8), SIZE, interpolation=cv2.INTER_NEAREST) > 0 for mask in found]


@pytest.mark.parametrize("step", [5, 1])
def test_what_the_camera_follows_is_off_the_background_however_slowly_it_passes(step):
    found = off(followed(12, step))
    true = np.zeros(SIZE[::-1], bool)
    true[BOX] = True
    for mask in found:
        assert (mask & true).sum() > 0.9 * true.sum()
        assert (mask & ~true).sum() < 0.06 * mask.size


def test_nothing_is_off_a_background_alone():
    background = noise(0, SIZE[1], SIZE[0] + 30)
    frames = [background[:, 5 * k : 5 * k + SIZE[0]].copy() for k in range(6)]
    assert not any(mask.any() for mask in off(frames))


def test_nothing_is_off_where_no_plane_dominates():
    """What is off would be nearly half of the image: it may as well be the background."""
    frames, other = followed(6, 5), noise(2, *SIZE[::-1])
    for frame in frames:
        frame[:33] = other[:33]
        frame[72:105] = other[72:105]
    assert not any(mask.any() for mask in off(frames)[1:-1])  # the others have fewer votes


def test_a_single_frame_has_no_background():
    assert not off(followed(1, 5))[0].any()


CAMERAS = [Cameras(["a"], boards.lens(), boards.poses(2)[:1], boards.points(), 0.1, 10.0)]


class Recorded(Steps):
    """Steps that record which masks cameras were recovered with, and fail with masks."""

    def recover(self, name, names, masks=None, **settings):
        self.journal.calls.append(masks)
        if masks is not None:
            raise NoCamerasError("too little is left")
        return CAMERAS

    def find_background(self, name):
        return Masks()


@pytest.mark.parametrize(("camera", "tried"), [("moving", [Masks(), None]), ("turning", [None]), ("still", [None])])
def test_cameras_are_found_without_the_guess_where_it_leaves_too_little(camera, tried):
    steps = object.__new__(Recorded)
    parts = {
        "videos": [Frames(Path(), [SourceFrame("a", "a.png", 0, 0)], 8, 6, 1.0)],
        "options": Options(camera=camera),
    }
    for name, part in {**parts, "journal": SimpleNamespace(calls=[])}.items():
        object.__setattr__(steps, name, part)
    assert steps.recover_background("cameras") is CAMERAS
    assert steps.journal.calls == tried
