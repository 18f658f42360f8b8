"""The built-in capture of several still cameras."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import tiny
from tests.synthetic.test_studio import content
from warpgs.captures.check import check_capture
from warpgs.captures.opening import load_capture
from warpgs.config.builtin import Builtin, parse_builtin
from warpgs.synthetic import rig
from warpgs.synthetic.rig import RigSize, rig_capture

SMALL = RigSize(width=64, height=36, num_frames=4, num_samples=2, num_points=200)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def folder(cache):
    return rig_capture(cache, SMALL, quiet=True)


def test_the_content_is_the_same_everywhere(folder):
    assert content(folder) == "753c14b7070dca5392f7426d167e7c88"


def test_six_cameras_stand_still_and_one_of_them_evaluates(folder):
    capture = load_capture(folder)
    videos = capture.by_camera(capture.cameras)
    assert {i: len(names) for i, names in videos.items()} == dict.fromkeys(range(6), 4)
    assert [*capture.val] == videos[0]
    for names in videos.values():
        assert len({tuple(capture.cameras[name].viewmat.flatten().tolist()) for name in names}) == 1
        assert [capture.cameras[name].time for name in names] == pytest.approx([0, 1 / 3, 2 / 3, 1])


def test_the_nearest_training_cameras_are_on_both_sides_of_the_held_out_one(folder):
    capture = load_capture(folder)
    held_out, *others = (capture.cameras[f"cam{i}_000000"] for i in range(6))
    sides = [held_out.viewmat[0, :3] @ (other.position - held_out.position) for other in others[:2]]
    assert sides[0] > 0 > sides[1]


def test_training_cameras_see_what_the_held_out_one_sees():
    cameras = [rig.lens_of(SMALL).camera(*rig.pose_of(camera), 0.5) for camera in range(6)]
    depths = [rig.trace_from(camera, SMALL)[1] for camera in cameras]
    held_out = cameras[0]
    rays = (held_out.pixel_centers - held_out.K[:2, 2]) / held_out.K.diagonal()[:2]
    points = torch.cat([rays, torch.ones(len(rays), 1)], 1) * depths[0].reshape(-1, 1)
    points = (points - held_out.viewmat[:3, 3]) @ held_out.viewmat[:3, :3]
    seen = torch.zeros(len(points), dtype=torch.bool)
    for camera, depth in zip(cameras[1:], depths[1:], strict=True):
        row, column, distance, inside = camera.project(points)
        seen |= inside & ((depth[row, column] - distance).abs() < 0.03 * distance)
    assert seen.float().mean() > 0.97


def test_the_images_of_a_camera_are_as_its_pose_and_time_say(folder):
    """The tracer puts what moves where a frame's mask says, through the camera that the loader read."""
    capture = load_capture(folder)
    frame = capture.frame("cam3_000002")
    traced = rig.trace_from(rig.lens_of(SMALL).camera(*rig.pose_of(3), 2 / 3), SMALL)
    assert torch.equal(frame.static_mask, traced[2])
    points = capture.points[(capture.points - capture.points.median(0).values).norm(dim=1) < 0.5]
    row, column, depth, inside = frame.camera.project(points)
    ratio = depth[inside] / rig.SCALE / traced[1][row[inside], column[inside]]
    assert float((ratio - 1.0).abs().median()) < 0.03


def test_with_an_offset_frames_show_the_moment_of_their_time(cache):
    offset = replace(SMALL, offset=0.1)
    root = rig_capture(cache, offset, quiet=True)
    metadata = json.loads((root / "metadata.json").read_text())
    assert [metadata[f"cam{i}_000001"]["time_id"] for i in range(6)] == [137, 100, 200, 162, 121, 183]
    capture = load_capture(root)
    # Camera 2 begins when camera 1, with no delay, takes its second frame.
    assert capture.cameras["cam2_000000"].time == capture.cameras["cam1_000001"].time
    together = load_capture(rig_capture(cache, SMALL, quiet=True))
    late, same = capture.frame("cam2_000001"), together.frame("cam2_000002")
    assert np.array_equal(late.image.numpy(), same.image.numpy())
    assert not np.array_equal(late.image.numpy(), together.frame("cam2_000001").image.numpy())
    assert capture.interval == pytest.approx(together.interval * 300 / 400)


def test_one_camera_alone_is_the_first_of_them(cache, folder):
    alone = load_capture(rig_capture(cache, replace(SMALL, num_cameras=1), quiet=True))
    assert {*alone.by_camera(alone.train)} == {1}
    first = load_capture(folder).frame("cam1_000003")
    assert torch.equal(alone.frame("cam1_000003").image, first.image)
    assert len(alone.val) == 4


def test_a_name_tells_frames_cameras_and_offset():
    assert parse_builtin("builtin:rig") == Builtin("rig", "exact", 60, 5, 0.0)
    assert parse_builtin("builtin:rig?frames=12&cameras=2&offset=0.5") == Builtin("rig", "exact", 12, 2, 0.5)


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("offset=1.5", "expected an offset from 0 to 1 seconds, got 1.5"),
        ("offset=nan", "expected an offset from 0 to 1 seconds, got nan"),
        ("offset=late", "expected an offset from 0 to 1 seconds, got late"),
        ("cameras=6", "expected 1 to 5 cameras, got 6"),
        ("frames=61", "expected 2 to 60 frames, got 61"),
        ("depth=none", "there is no built-in capture builtin:rig.depth=none"),
    ],
)
def test_a_query_that_the_rig_lacks_is_refused(query, message):
    with pytest.raises(ValueError, match=message):
        parse_builtin(f"builtin:rig?{query}")


def test_a_name_opens_the_capture(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(rig, "RigSize", lambda **given: replace(SMALL, **given))
    assert len(load_capture("builtin:rig?frames=2&cameras=2").train) == 4


def test_it_is_fit_to_train_on(cache):
    report = check_capture(rig_capture(cache, replace(SMALL, width=160, height=90, offset=0.05), quiet=True))
    assert report.is_fit


def test_a_training_evaluates_on_the_held_out_camera(cache, tmp_path):
    config = replace(tiny.CONFIG, data=rig_capture(cache, replace(SMALL, offset=0.05), quiet=True))
    trainer = tiny.trainer(config.data, tmp_path, config)
    assert tiny.train(trainer)
    capture = trainer.capture
    assert {capture.cameras[name].id for name in capture.train} == {1, 2, 3, 4, 5}
    assert {capture.cameras[name].id for name in capture.val} == {0}
