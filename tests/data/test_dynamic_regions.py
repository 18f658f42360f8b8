"""Regions of what moves, and what is said where nothing tells their depth."""

import numpy as np
import pytest
import torch

from tests.scenes import along_z
from warpgs.data.capture import Frame
from warpgs.data.dynamic_regions import MAX_SIDE, dynamic_regions, is_cut, scaled_size, unknown_depth


def frame_of(width: int, height: int, *boxes: tuple[slice, slice]) -> Frame:
    """A frame in which these boxes move."""
    static = torch.ones(height, width, dtype=torch.bool)
    for box in boxes:
        static[box] = False
    image = torch.zeros(height, width, 3, dtype=torch.uint8)
    return Frame("000", along_z(100.0, (width, height)), image, static)


def test_regions_are_found_in_masks_of_a_maximum_side():
    frame = frame_of(2 * MAX_SIDE, 200, (slice(40, 80), slice(100, 200)), (slice(120, 122), slice(300, 302)))
    assert scaled_size(frame.camera.size) == (MAX_SIDE, 100)
    (region,) = dynamic_regions(frame.static_mask, frame.camera)  # the other one is too small
    expected = np.zeros((100, MAX_SIDE), bool)
    expected[20:40, 50:100] = True
    assert np.array_equal(region, expected)


@pytest.mark.parametrize(
    ("rows", "columns", "expected"),
    [
        (slice(1, 47), slice(1, 63), False),
        (slice(0, 20), slice(10, 20), True),
        (slice(30, 48), slice(10, 20), True),
        (slice(10, 20), slice(0, 20), True),
        (slice(10, 20), slice(50, 64), True),
    ],
    ids=["whole", "top", "bottom", "left", "right"],
)
def test_a_region_at_a_border_of_the_image_is_cut(rows, columns, expected):
    frame = frame_of(64, 48, (rows, columns))
    (region,) = dynamic_regions(frame.static_mask, frame.camera)
    assert is_cut(region) == expected


def test_the_message_about_unknown_depth_says_why_what_follows_and_what_to_do():
    text = unknown_depth(41, 48)
    assert "the image border cuts them off in 41 of 48 training frames" in text
    assert "may be blurred and partly in the static image" in text
    assert "record so that one stays whole in at least 12 frames, or run warpgs prepare with --depth anything" in text
    assert "border" not in unknown_depth(0, 10)
