"""What motion in the images says of the poses of cameras that move and of those that stand still."""

from dataclasses import replace

import torch

from tests.export.test_cameras import camera
from warpgs.captures.check import check_capture
from warpgs.captures.motion_check import Motion, check_motion, pairs_to_compare
from warpgs.data.capture import Capture

from .test_agreement import write_rig

MOVING, STILL = Motion(1.25, None), Motion(0.0, None, stands_still=True)


def texts(motions):
    """Level and text of what is said of poses."""
    return [(f.level, f.text) for f in check_motion(motions, "") if f.topic == "cameras"]


def test_the_motion_of_cameras_that_stand_still_does_not_count():
    said = ("note", "static pixels are 1.25 px off their epipolar lines (median)")
    assert texts([STILL] * 5 + [MOVING] * 2) == [said]


def test_if_all_cameras_stand_still_the_check_says_so(tmp_path):
    found = check_capture(write_rig(tmp_path / "rig", [-0.8, 0.0])).findings
    said = [f.text for f in found if f.topic == "cameras" and "motion" in f.text]
    assert said == ["no camera moves: motion in the images says nothing about their poses"]


def test_images_that_move_before_a_camera_with_one_pose_are_warned_of():
    (said,) = texts([Motion(7.0, None, stands_still=True)] * 3)
    text = "static pixels move by 7.00 px (median) where frames have one pose: the cameras may not match the images"
    assert said == ("warning", text)


def test_half_of_the_pairs_are_of_cameras_that_move():
    """One of ten cameras does."""
    cameras = {}
    for i in range(10):
        for k in range(20):
            cameras[f"{i}_{k:02d}"] = replace(camera(0.01 * k if i == 7 else 0), id=i, time=k / 19)
    capture = Capture("rig", cameras, [*cameras], [], torch.zeros(0, 3), None, lambda name: None)
    pairs = pairs_to_compare(capture, 12)
    assert len(pairs) == 12
    assert sum(first[0] == "7" for first, _ in pairs) == 6
    assert len({first[0] for first, _ in pairs}) >= 5
