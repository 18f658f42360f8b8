"""The built-in capture."""

import errno
import json
import os
import re
import tempfile

import cv2
import numpy as np
import pytest
import torch

from warpgs.cache import cache_folder
from warpgs.captures.opening import load_capture
from warpgs.synthetic import room
from warpgs.synthetic.bodies import as_tensors, even_samples
from warpgs.synthetic.cache import content_folder
from warpgs.synthetic.room import BuiltinScene, builtin_capture, trace

SMALL = BuiltinScene(width=48, height=28, num_frames=4, num_samples=2, num_points=200)
CPU = torch.device("cpu")


NUM_STATIC = len(room._static_bodies())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return builtin_capture(tmp_path_factory.mktemp("cache"), SMALL, quiet=True)


@pytest.fixture(scope="module")
def capture(folder):
    return load_capture(folder)


def test_without_a_home_the_cache_is_a_temporary_folder(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = content_folder(None, "content").parent
    assert folder.parent == tmp_path
    assert list(folder.iterdir()) == []
    error = capsys.readouterr().err
    assert error.startswith("warpgs: no cache for built-in captures (")
    remedy = "until the program ends; set XDG_CACHE_HOME to a folder that can be written"
    assert error.endswith(f"they are kept in {folder} {remedy}\n")
    assert error.count("\n") == 1
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cache_folder("built-in captures") == tmp_path / "cache" / "warpgs"
    assert capsys.readouterr().err == ""


def test_every_frame_has_all_its_files(folder):
    left, right = [f"left_{k:06d}" for k in range(4)], ["right_000000", "right_000002"]
    frames = left + right
    expected = {"dataset.json", "metadata.json", "scene.json", "points.npy"}
    expected |= {f"camera/{n}.json" for n in frames} | {f"rgb/1x/{n}.png" for n in frames}
    expected |= {f"resized_mask/1x/{n}.png.png" for n in frames} | {f"depth/1x/{n}.png" for n in left}
    assert {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} == expected
    dataset = json.loads((folder / "dataset.json").read_text())
    assert dataset["train_ids"] == left
    assert dataset["val_ids"] == right
    assert set(dataset["ids"]) == set(json.loads((folder / "metadata.json").read_text())) == set(frames)


def test_masks_are_0_exactly_where_a_moving_body_covers_the_centre_of_a_pixel(folder):
    *_, bodies = trace(1 / 3, 0.0, SMALL, CPU)
    mask = cv2.imread(str(folder / "resized_mask/1x/left_000001.png.png"), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(mask, np.where(bodies.numpy() >= NUM_STATIC, 0, 255))


@pytest.mark.parametrize("name", ["left_000000", "left_000001", "left_000003", "right_000002"])
def test_the_mask_contains_the_centre_of_the_ball(capture, name):
    time = int(name[-1]) / 3
    ball = room._moving_bodies(time)[1]
    center = (torch.tensor([ball.center]) - torch.tensor(room.CENTER)) * room.SCALE
    row, column, _, inside = capture.cameras[name].project(center)
    assert bool(inside)
    assert not capture.frame(name).static_mask[row, column]


def test_it_loads_as_a_nerfds_capture(capture):
    assert len(capture.train) == 4
    assert len(capture.val) == 2
    frame = capture.frame(capture.train[1])
    assert frame.image.shape == (28, 48, 3)
    assert frame.inverse_depth.shape == (28, 48)
    assert 0.02 < (~frame.static_mask).float().mean() < 0.3


def test_the_evaluation_camera_is_next_to_the_training_camera(capture):
    left, right = capture.cameras["left_000002"], capture.cameras["right_000002"]
    assert torch.equal(left.viewmat[:3, :3], right.viewmat[:3, :3])
    distance = (left.position - right.position).norm()
    assert float(distance) == pytest.approx(room.BASELINE * room.SCALE, rel=1e-4)


def distances(points, body):
    """Distance of points from the surface of a static body; ellipsoids must be spheres."""
    local = ((points - torch.tensor(body.center)) @ body.rotation.float()).abs()
    half = torch.tensor(body.half_sizes)
    if body.shape == room.SPHERE:
        return (local.norm(dim=1) - half[0]).abs()
    beyond = local - half
    return (beyond.clamp_min(0).norm(dim=1) + beyond.amax(1).clamp_max(0)).abs()


def test_points_lie_on_static_surfaces_up_to_their_noise(folder):
    points = torch.from_numpy(np.load(folder / "points.npy"))
    distance = torch.stack([distances(points, body) for body in room._static_bodies()]).amin(0)
    assert points.shape == (200, 3)
    assert float(distance.max()) < 5 * room.POINT_NOISE


def test_training_cameras_see_the_points(capture):
    seen = [capture.cameras[name].project(capture.points) for name in capture.train]
    assert all(bool((depth > 0).all()) for _, _, depth, _ in seen)
    # Noise may move a point of the outermost pixels out of the image.
    assert torch.stack([inside for *_, inside in seen]).any(0).float().mean() > 0.97


def test_monocular_depth_is_inverse_depth_up_to_scale_and_offset(capture):
    _, _, depth, _ = trace(1 / 3, 0.0, SMALL, CPU)
    inverse = capture.frame("left_000001").inverse_depth.flatten()
    assert torch.corrcoef(torch.stack([inverse, 1.0 / depth.flatten()]))[0, 1] > 0.9999


def test_the_scale_of_depth_drifts_from_frame_to_frame(capture):
    fits = []
    for k, name in enumerate(capture.train):
        truth = 1.0 / trace(k / 3, 0.0, SMALL, CPU)[2].flatten()
        inverse = capture.frame(name).inverse_depth.flatten()
        fits.append(torch.linalg.lstsq(torch.stack([truth, torch.ones_like(truth)], 1), inverse[:, None]).solution)
    assert bool((torch.cat(fits, 1).amax(1) - torch.cat(fits, 1).amin(1) > 0.02).all())


def test_shadows_move_over_static_pixels():
    camera = room._camera(0.0, SMALL, 0.0)
    view = (room._lamp(CPU), even_samples(4, CPU), camera.viewmat, camera.K, camera.size)
    bodies = ([*room._static_bodies(), *room._moving_bodies(time)] for time in (0.0, 0.4))
    early, late = (room.raytrace(as_tensors(at_time, CPU), *view) for at_time in bodies)
    static = (early.bodies == late.bodies) & (early.bodies < NUM_STATIC)
    change = (early.image - late.image).abs().mean(-1)
    assert (change[static] > 0.1).sum() > 10


def test_the_capture_is_deterministic(folder, tmp_path):
    folders = [folder, builtin_capture(tmp_path, SMALL, quiet=True)]
    files = [sorted(p.relative_to(f) for p in f.rglob("*") if p.is_file()) for f in folders]
    assert files[0] == files[1]
    assert all((folders[0] / p).read_bytes() == (folders[1] / p).read_bytes() for p in files[0])


def test_a_cached_capture_is_not_written_again(tmp_path, monkeypatch):
    folder = builtin_capture(tmp_path, SMALL, quiet=True)
    monkeypatch.setattr(room, "write_builtin_capture", lambda *_: pytest.fail("written again"))
    assert builtin_capture(tmp_path, SMALL, quiet=True) == folder


def test_an_interrupted_capture_is_never_used(tmp_path, monkeypatch):
    def interrupt(folder, *_):
        (folder / "dataset.json").write_text("{}")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(room, "write_builtin_capture", interrupt)
        with pytest.raises(KeyboardInterrupt):
            builtin_capture(tmp_path, SMALL, quiet=True)
    assert list(tmp_path.rglob("dataset.json")) == []
    assert (builtin_capture(tmp_path, SMALL, quiet=True) / "points.npy").exists()


def test_another_size_is_another_capture(tmp_path):
    other = BuiltinScene(**{**vars(SMALL), "num_points": 100})
    assert builtin_capture(tmp_path, SMALL, quiet=True) != builtin_capture(tmp_path, other, quiet=True)


def test_the_error_names_a_cache_that_cannot_be_created(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=f"cannot be kept in {re.escape(str(tmp_path / 'file'))}"):
        builtin_capture(tmp_path / "file", SMALL, quiet=True)


def test_a_full_disk_names_the_file_and_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match=r"left_000000\.png could not be written: No space left"):
        builtin_capture(tmp_path, SMALL, quiet=True)
    assert [p for p in tmp_path.rglob("*") if p.is_file() or p.name.startswith("partial")] == []


def test_a_single_frame_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least 2 frames, got 1"):
        builtin_capture(tmp_path, BuiltinScene(num_frames=1), quiet=True)
