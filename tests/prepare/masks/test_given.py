"""Which of the user's files is the mask of a frame."""

import cv2
import numpy as np
import pytest

from warpgs.prepare.frames.take import SourceFrame
from warpgs.prepare.masks.given import find_given_masks


def write(folder, *names):
    for name in names:
        cv2.imwrite(str(folder / name), np.zeros((4, 4), np.uint8))
    return folder


def test_masks_of_several_videos_are_told_apart_by_the_names_of_frames(tmp_path):
    """Frames of videos have no files: "frame 4" of one video is not that of another."""
    folder = write(tmp_path, "frame 4.png", "0_000000.png", "1_000000.png.png")
    found = [find_given_masks(folder, [SourceFrame(f"{k}_000000", "frame 4", 4, 500)]) for k in range(2)]
    assert found == [[folder / "0_000000.png"], [folder / "1_000000.png.png"]]


def test_the_mask_that_a_video_lacks_is_named_like_its_frame(tmp_path):
    with pytest.raises(ValueError, match=r"has no mask for 1_000000 \(frame 4\): expected 1_000000\.png"):
        find_given_masks(write(tmp_path, "frame 4.png"), [SourceFrame("1_000000", "frame 4", 4, 500)])


@pytest.mark.parametrize("name", ["shot4.jpg.png", "shot4.png", "shot4.png.png", "frame_000000.png.png"])
def test_masks_of_a_folder_may_be_named_like_its_files_or_the_frames(tmp_path, name):
    folder = write(tmp_path, name)
    assert find_given_masks(folder, [SourceFrame("frame_000000", "shot4.jpg", 4, 4)]) == [folder / name]
