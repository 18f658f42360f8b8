"""Camera paths that the viewer saves."""

import json

import pytest
import torch

from warpgs.cameras import Camera
from warpgs.video import keyframes

INTRINSICS = [torch.tensor([[50.0 + k, 0, 32], [0, 50, 24], [0, 0, 1]]) for k in range(3)]
CAMERAS = [Camera(torch.eye(4) + 0.01 * k, K, 64, 48, k / 2) for k, K in enumerate(INTRINSICS)]


@pytest.fixture
def path(tmp_path):
    path = keyframes.path_of(tmp_path, "fly")
    keyframes.write_path(path, CAMERAS)
    return path


def test_keyframes_are_saved_exactly_and_in_order(path):
    saved = json.loads(path.read_text())["keyframes"]
    for keyframe, camera in zip(saved, CAMERAS, strict=True):
        size = {"width": camera.width, "height": camera.height}
        matrices = {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist()}
        assert keyframe == {"time": camera.time, **matrices, **size}


def test_a_path_is_saved_in_the_run_folder(tmp_path):
    assert keyframes.path_of(tmp_path, "a b-c_1") == tmp_path / "paths" / "a b-c_1.json"


def test_a_path_never_overwrites_another(tmp_path, path):
    assert keyframes.path_of(tmp_path, "fly").name == "fly-2.json"


def test_a_path_overwrites_another_if_it_is_told_to(tmp_path, path):
    assert keyframes.path_of(tmp_path, "fly", replaces=True) == path


@pytest.mark.parametrize("name", ["", "../x", "a/b", "a\\b", ".hidden", "a.json", "\0", "x" * 65, "a\n"])
def test_a_name_that_could_lead_out_of_the_folder_is_refused(tmp_path, name):
    with pytest.raises(ValueError, match="the name of a path must have 1 to 64 letters"):
        keyframes.path_of(tmp_path, name)


def test_a_path_without_keyframes_is_not_written(tmp_path):
    with pytest.raises(ValueError, match="at least one keyframe"):
        keyframes.write_path(tmp_path / "p.json", [])
