"""The scene of a run in training, as a viewer reads it."""

import pytest
import torch

import warpgs
from warpgs.runs import checkpoint, preview


def test_a_preview_is_the_scene_of_its_iteration(finished_run, tmp_path):
    scene = warpgs.open_run(finished_run)
    preview.write(tmp_path, scene, preview.State(7, 9, 21.5, None))
    loaded = checkpoint.load(tmp_path / preview.SCENE)
    read = checkpoint.load_scene(loaded, scene.config.model)
    assert torch.equal(read.static.means, scene.scene.static.means)
    assert preview.read_state(tmp_path) == preview.State(7, 9, 21.5, None)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"iteration": "x", "num_iterations": 1, "psnr": 1, "rate": 1}'])
def test_a_damaged_state_is_none(tmp_path, text):
    (tmp_path / preview.STATE).write_text(text)
    assert preview.read_state(tmp_path) is None
