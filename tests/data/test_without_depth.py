"""Without depth, a capture is the same as one whose files have none, and their depth is not even read."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch

from tests import tiny
from tests.data import captures, layouts
from warpgs.captures.opening import load_capture, open_capture
from warpgs.config import TrainConfig
from warpgs.data.capture import Capture, Frame
from warpgs.data.loaders import LoadOptions, load_with
from warpgs.initialization.initialize import initial_scene
from warpgs.initialization.point_cloud import random_points
from warpgs.initialization.prepare_start import prepare_start
from warpgs.training.trainer import Trainer
from warpgs.views.views import Views

FOLDERS = ("depth", "depths", "disp")
"""Where the layouts have depth; MegaSaM has one file for all."""


def write_without_points(root: Path) -> Path:
    layouts.write_nerfstudio(root)
    captures.edit_json(root / "transforms.json", ply_file_path=None)
    return root


def write_dycheck(root: Path) -> Path:
    return captures.write_capture(root, "iphone")


WRITERS = {**layouts.WRITERS, "nerfstudio without points": write_without_points, "iphone": write_dycheck}
UNPROJECTED = pytest.mark.parametrize("layout", ["vipe", "megasam", "nerfstudio without points"])


@pytest.fixture
def capture(layout, tmp_path) -> Path:
    return WRITERS[layout](tmp_path / "capture")


def opened(root: Path) -> Capture:
    return open_capture(TrainConfig(data=root, depth=False))


def remove_depth(root: Path) -> None:
    """Removes the files with depth, and what names them."""
    for folder in FOLDERS:
        shutil.rmtree(root / folder, ignore_errors=True)
    path = root / "transforms.json"
    if path.exists():
        frames = json.loads(path.read_text())["frames"]
        for frame in frames:
            del frame["depth_file_path"]
        captures.edit_json(path, frames=frames)


@pytest.mark.parametrize("layout", WRITERS)
def test_no_frame_has_depth_and_none_is_read(layout, capture):
    for path in (path for folder in FOLDERS for path in (capture / folder).rglob("*.*")):
        path.write_bytes(b"damaged")
    found = opened(capture)
    assert all(found.frame(name).inverse_depth is None for name in (*found.train, *found.val))


@pytest.mark.parametrize("layout", [name for name in WRITERS if name != "megasam"])
def test_cameras_and_points_are_those_of_files_without_depth(layout, capture):
    found = opened(capture)
    remove_depth(capture)
    expected = load_capture(capture)
    assert torch.equal(found.points, expected.points)
    for name, camera in expected.cameras.items():
        assert torch.equal(found.cameras[name].viewmat, camera.viewmat)


@UNPROJECTED
def test_no_points_are_unprojected_from_depth(layout, capture):
    assert len(load_capture(capture).points) > 100
    assert len(opened(capture).points) == 0


@UNPROJECTED
def test_the_scene_is_three_times_as_wide_as_its_cameras_box(layout, capture):
    positions = torch.stack([camera.position for camera in opened(capture).cameras.values()])
    assert positions.abs().max() == pytest.approx(1 / 3)


@UNPROJECTED
def test_static_gaussians_start_at_random_positions(layout, capture):
    captured = opened(capture).assuming("static")
    views = Views(captured, torch.device("cpu"), tiny.CONFIG.resident_bytes)
    scene = initial_scene(tiny.CONFIG, captured, views, torch.Generator().manual_seed(0))
    expected = random_points(torch.zeros(0, 3), tiny.MODEL.max_static_points, torch.Generator().manual_seed(0))
    assert torch.equal(scene.static.means, expected)


@UNPROJECTED
@pytest.mark.usefixtures("quickly")
def test_training_runs_through_all_stages(layout, capture, tmp_path):
    assume = "static" if layout == "megasam" else "masks"
    config = dataclasses.replace(tiny.CONFIG, data=capture, depth=False, assume=assume)
    start = prepare_start(config, open_capture(config))
    assert start.num_aligned == start.num_with_objects == 0
    assert tiny.train(Trainer(start, tmp_path / "run"))


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
@pytest.mark.parametrize("part", ["all frames", "the last frame"])
def test_no_start_is_prepared_from_depth_that_the_config_excludes(part, resident_bytes, tmp_path):
    capture = load_capture(tiny.write(tmp_path / "capture"))
    if part == "the last frame":
        read, last = capture.read, capture.train[-1]

        def read_partly(name: str) -> Frame:
            frame = read(name)
            return frame if name == last else dataclasses.replace(frame, inverse_depth=None)

        capture = dataclasses.replace(capture, read=read_partly)
    config = dataclasses.replace(tiny.CONFIG, depth=False, resident_bytes=resident_bytes)
    remedy = r"was read with depth, but the config is without \(depth=False\); .* open_capture\(config\)"
    with pytest.raises(ValueError, match=remedy) as raised:
        prepare_start(config, capture)
    assert "\n" not in str(raised.value)


def test_a_start_without_depth_is_prepared_from_captures_that_have_none(tmp_path):
    data, config = tiny.write(tmp_path / "capture"), dataclasses.replace(tiny.CONFIG, depth=False)
    assert prepare_start(config, load_with(data, None, LoadOptions(depth=False))).num_aligned == 0
    shutil.rmtree(data / "depth")
    assert prepare_start(config, load_capture(data)).num_aligned == 0
