"""A run opens its capture as its config says."""

import dataclasses

from tests import tiny
from warpgs.captures.opening import open_capture


def test_the_masks_of_a_run_are_damaged_as_its_config_says(tmp_path):
    data = tiny.write(tmp_path)
    config = dataclasses.replace(tiny.CONFIG, data=data)
    damaged = open_capture(dataclasses.replace(config, damage_masks="dilate:2"))
    whole, first = open_capture(config), damaged.train[0]
    assert (~damaged.frame(first).static_mask).sum() > (~whole.frame(first).static_mask).sum() > 0
