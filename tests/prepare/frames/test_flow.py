"""Optical flow between the frames of a video, and the images that it is found on."""

import numpy as np

from warpgs.prepare.frames.flow import Flows
from warpgs.prepare.frames.images import brighten


def test_a_flow_is_computed_once_until_both_frames_are_released(video, monkeypatch):
    flows, computed = Flows(video[0][:3]), []
    monkeypatch.setattr(flows, "compute", lambda a, b, start: computed.append(1) or np.zeros((*a.shape, 2), np.float32))
    for pair in ((0, 1), (1, 2), (0, 1), (2, 0), (0, 1)):
        flows.flow(*pair)
    assert len(computed) == 3
    flows.release(0)
    flows.flow(0, 1)
    assert len(computed) == 3
    flows.release(1)
    flows.flow(1, 2)
    assert len(computed) == 3
    flows.flow(0, 1)
    assert len(computed) == 4


def test_dark_images_are_brightened_to_middle_grey_and_black_ones_stay_black(video):
    dark = [image // 6 for image in video[0][:2]]
    assert np.median(brighten(dark)[0]) > 3 * np.median(dark[0])
    assert not brighten([np.zeros((8, 8, 3), np.uint8)])[0].any()
