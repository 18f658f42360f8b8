"""Masks that mark nothing are believed only where what other masks mark may have left the image."""

from dataclasses import replace

import pytest
import torch

from tests.scenes import make_camera
from warpgs.captures.check import quick_findings
from warpgs.data.capture import Capture, Frame
from warpgs.data.dynamic_regions import dynamic_counts, dynamic_regions
from warpgs.data.empty_masks import wrongly_empty

HEIGHT, WIDTH = make_camera().height, make_camera().width
WHOLE, CUT, SMALL, NOTHING = (5, 20, 5, 20), (5, 20, 0, 10), (5, 9, 5, 9), (0, 0, 0, 0)


def capture_of(*boxes, cameras=None):
    """A capture whose masks mark a box each: first and last row, first and last column."""
    names = [f"frame_{k}" for k in range(len(boxes))]
    taken = zip(names, cameras or [make_camera()] * len(boxes), strict=True)
    cameras = {name: replace(camera, time=k / len(boxes)) for k, (name, camera) in enumerate(taken)}
    frames = {}
    for name, (top, bottom, left, right) in zip(names, boxes, strict=True):
        static = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
        static[top:bottom, left:right] = False
        image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8)
        frames[name] = Frame(name, cameras[name], image, static)
    return Capture("boxes", cameras, names[::-1], [], torch.rand(50, 3) + 1.0, None, frames.__getitem__)


def untrusted(*boxes, **options):
    capture = capture_of(*boxes, **options)
    masks = {
        f.name: dynamic_counts(f.static_mask, dynamic_regions(f.static_mask, f.camera))
        for f in capture.frames(capture.train)
    }
    return [int(name.removeprefix("frame_")) for name in wrongly_empty(capture.cameras, masks)]


def test_empty_masks_between_whole_objects_are_not_trusted():
    assert untrusted(WHOLE, NOTHING, WHOLE, NOTHING, WHOLE) == [1, 3]


@pytest.mark.parametrize("boxes", [(WHOLE, WHOLE, NOTHING, NOTHING), (NOTHING, NOTHING, WHOLE, WHOLE)])
def test_all_empty_masks_in_a_row_are_doubted_together(boxes):
    assert untrusted(*boxes) == [k for k, box in enumerate(boxes) if box == NOTHING]


def test_what_leaves_across_the_border_leaves_masks_that_are_trusted():
    assert untrusted(NOTHING, CUT, WHOLE, CUT, NOTHING) == []


def test_what_becomes_small_before_it_vanishes_leaves_masks_that_are_trusted():
    assert untrusted(WHOLE, WHOLE, WHOLE, SMALL, NOTHING) == []


def test_cameras_that_look_elsewhere_may_not_see_what_moves():
    turned = make_camera()
    turned = replace(turned, viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ turned.viewmat)
    assert untrusted(WHOLE, NOTHING, cameras=[make_camera(), turned]) == []


@pytest.mark.parametrize("boxes", [(NOTHING, NOTHING, NOTHING), (WHOLE, WHOLE, WHOLE)])
def test_masks_that_are_all_alike_do_not_contradict_each_other(boxes):
    assert untrusted(*boxes) == []


def test_training_says_which_masks_it_does_not_trust():
    found = [f.text for f in quick_findings(capture_of(*[WHOLE, NOTHING] * 4)) if f.topic == "masks"]
    assert any("4 of 8 masks mark nothing, such as that of frame_1" in text for text in found)


def test_masks_of_another_camera_say_nothing_about_empty_ones():
    cameras = [replace(make_camera(), id=k % 2) for k in range(5)]
    assert untrusted(WHOLE, NOTHING, WHOLE, NOTHING, WHOLE, cameras=cameras) == []
    assert untrusted(WHOLE, NOTHING, NOTHING, NOTHING, WHOLE, cameras=cameras) == [2]
