"""Whether a camera stands still."""

import tracemalloc

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.prepare.frames.stillness import BAND, find_background, median, require_still, stands_still

NAMES = [f"shot{k:03d}" for k in range(12)]


def write(folder, **options):
    return boards.write_folder(folder, boards.record(12, **options)[0])


def test_a_camera_on_a_tripod_stands_still_whatever_moves_before_it(tmp_path):
    assert stands_still(write(tmp_path, path=boards.still_pose), NAMES)


def texture(shape, contrast, blur, seed):
    """Noise of blobs, [H, W, 3]."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=shape), (0, 0), blur)
    grey = (128 + contrast * noise / np.abs(noise).max()).astype(np.uint8)
    return np.repeat(grey[..., None], 3, 2)


def test_a_still_camera_is_found_where_moving_objects_have_most_texture(tmp_path):
    """A checkered ball before a wall, near enough to fill most of the image."""
    wall, ball = texture((270, 480), 60, 3.0, 0), texture((200, 240), 120, 2.0, 1)
    frames = []
    for k in range(12):
        frames.append(wall.copy())
        left = 20 + 18 * k
        frames[-1][40:240, left : left + 240] = np.roll(ball, 11 * k, axis=1)
    assert stands_still(boards.write_folder(tmp_path, frames), NAMES)


def test_a_clock_that_is_burned_in_does_not_make_a_camera_stand_still(tmp_path):
    images = boards.record(12)[0]
    for k, image in enumerate(images):
        cv2.putText(image, f"2026-11-28 12:34:{k:02d}", (4, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (255, 255, 255))
    assert not stands_still(boards.write_folder(tmp_path, images), NAMES)


@pytest.mark.parametrize("options", [{}, {"travel": 0.1}, {"path": boards.turning_pose}])
def test_a_camera_that_moves_or_turns_does_not(tmp_path, options):
    assert not stands_still(write(tmp_path, **options), NAMES)


def test_the_background_is_what_is_there_most_of_the_time(tmp_path):
    folder = write(tmp_path, path=boards.still_pose)
    background = find_background(folder, NAMES)
    expected = boards.record(2, moves=False, path=boards.still_pose)[0][0]
    assert (np.abs(background.astype(int) - expected).max(-1) > 8).mean() < 0.02
    assert find_background(write(tmp_path / "moving"), NAMES) is None


def test_the_median_is_of_what_counts():
    """An object that rests in most frames is not in it, unless it is always there."""
    frames = [np.full((2, 3, 3), value, np.uint8) for value in (10, 12, 11, 90, 90, 90, 90)]
    static = [np.full((2, 3), value) for value in (True, True, True, False, False, False, False)]
    for mask in static:
        mask[0, 0] = False
    found = median(frames, static)
    assert (found[0, 0] == 90).all()
    assert (found[1] == 11).all()


@pytest.mark.parametrize("count", [1, 6, 7])
def test_the_median_is_exact_over_several_bands(count):
    images = np.random.default_rng(0).integers(0, 256, (count, 2 * BAND + 3, 5, 3), dtype=np.uint8)
    assert np.array_equal(median(list(images)), np.median(images, axis=0).round().astype(np.uint8))


def test_the_median_takes_little_more_memory_than_the_images():
    images = [np.full((540, 320, 3), k, np.uint8) for k in range(31)]
    static = [np.ones((540, 320), bool)] * 31
    tracemalloc.start()
    median(images, static)
    assert tracemalloc.get_traced_memory()[1] < 0.5 * sum(image.nbytes for image in images)
    tracemalloc.stop()


def test_images_without_texture_do_not_tell(tmp_path):
    folder = boards.write_folder(tmp_path, [np.full((96, 128, 3), 90, np.uint8)] * 12)
    assert not stands_still(folder, NAMES)
    require_still(folder, NAMES)
