"""Whether a camera stands still."""

import numpy as np
import pytest

from tests.prepare import boards
from warpgs.prepare.frames.stillness import find_background, require_still, stands_still

NAMES = [f"shot{k:03d}" for k in range(12)]


def write(folder, **options):
    return boards.write_folder(folder, boards.record(12, **options)[0])


def test_a_camera_on_a_tripod_stands_still_whatever_moves_before_it(tmp_path):
    assert stands_still(write(tmp_path, path=boards.still_pose), NAMES)


@pytest.mark.parametrize("options", [{}, {"travel": 0.1}, {"path": boards.turning_pose}])
def test_a_camera_that_moves_or_turns_does_not(tmp_path, options):
    assert not stands_still(write(tmp_path, **options), NAMES)


def test_the_background_is_what_is_there_most_of_the_time(tmp_path):
    folder = write(tmp_path, path=boards.still_pose)
    background = find_background(folder, NAMES)
    expected = boards.record(2, moves=False, path=boards.still_pose)[0][0]
    assert (np.abs(background.astype(int) - expected).max(-1) > 8).mean() < 0.02
    assert find_background(write(tmp_path / "moving"), NAMES) is None


def test_images_without_texture_do_not_tell(tmp_path):
    folder = boards.write_folder(tmp_path, [np.full((96, 128, 3), 90, np.uint8)] * 12)
    assert not stands_still(folder, NAMES)
    require_still(folder, NAMES)
