import dataclasses
import os

import pytest
import torch

from warpgs.data import synthetic
from warpgs.data.nerfies import load_capture
from warpgs.data.synthetic import BuiltinScene, builtin_capture, picture

SMALL = BuiltinScene(width=48, height=28, num_frames=4, num_samples=2, num_points=200)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return load_capture(builtin_capture(tmp_path_factory.mktemp("cache"), SMALL, quiet=True))


def test_it_loads_as_a_nerfds_capture(capture):
    assert len(capture.train) == 4
    assert len(capture.val) == 2
    frame = capture.frame(capture.train[1])
    assert frame.image.shape == (28, 48, 3)
    assert frame.inverse_depth.shape == (28, 48)
    assert 0.02 < (~frame.static_mask).float().mean() < 0.3


def test_the_evaluation_camera_is_beside_the_training_camera(capture):
    left, right = capture.cameras["left_000002"], capture.cameras["right_000002"]
    assert torch.equal(left.viewmat[:3, :3], right.viewmat[:3, :3])
    distance = (left.position - right.position).norm()
    assert float(distance) == pytest.approx(synthetic.BASELINE * synthetic.SCALE, rel=1e-4)


def test_points_lie_on_static_surfaces(capture):
    shot, _ = picture(0.0, 0.0, SMALL, CPU)
    row, column, depth, inside = capture.cameras["left_000000"].project(capture.points)
    seen = shot.depth[row, column] * synthetic.SCALE
    # Some points were seen from other views only; those that are seen here are at the surface.
    close = (depth - seen).abs() < 0.02
    assert (close & inside).sum() > 0.5 * inside.sum()


def test_monocular_depth_is_inverse_depth_up_to_scale_and_offset(capture):
    shot, _ = picture(1 / 3, 0.0, SMALL, CPU)
    inverse = capture.frame("left_000001").inverse_depth.flatten()
    truth = 1.0 / shot.depth.flatten()
    together = torch.stack([inverse, truth])
    assert torch.corrcoef(together)[0, 1] > 0.9999


def test_shadows_move_over_static_pixels():
    (early, _), (late, _) = (picture(time, 0.0, SMALL, CPU) for time in (0.25, 0.5))
    fixed = dataclasses.replace(SMALL)
    camera = synthetic._camera(0.0, fixed, 0.0)
    shots = []
    for time in (0.0, 0.4):
        bodies = synthetic._as_tensors([*synthetic._static_bodies(), *synthetic._moving_bodies(time)], CPU)
        lamp, samples = synthetic._lamp(CPU), synthetic._samples(4, CPU)
        shots.append(synthetic.raytrace(bodies, lamp, samples, camera.viewmat, camera.K, camera.size))
    static = (shots[0].bodies == shots[1].bodies) & (shots[0].bodies < len(synthetic._static_bodies()))
    change = (shots[0].image - shots[1].image).abs().mean(-1)
    assert (change[static] > 0.1).sum() > 10
    assert early.image.shape == late.image.shape


def test_the_same_bytes_are_written_twice(tmp_path):
    folders = [builtin_capture(tmp_path / name, SMALL, quiet=True) for name in ("a", "b")]
    files = [sorted(p.relative_to(f) for p in f.rglob("*") if p.is_file()) for f in folders]
    assert files[0] == files[1]
    assert all((folders[0] / p).read_bytes() == (folders[1] / p).read_bytes() for p in files[0])


def test_a_finished_capture_is_not_made_again(tmp_path, monkeypatch):
    folder = builtin_capture(tmp_path, SMALL, quiet=True)
    monkeypatch.setattr(synthetic, "write_builtin", lambda *_: pytest.fail("made again"))
    assert builtin_capture(tmp_path, SMALL, quiet=True) == folder


def test_an_interrupted_capture_is_never_used(tmp_path, monkeypatch):
    def interrupt(folder, *_):
        (folder / "dataset.json").write_text("{}")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(synthetic, "write_builtin", interrupt)
        with pytest.raises(KeyboardInterrupt):
            builtin_capture(tmp_path, SMALL, quiet=True)
    assert list(tmp_path.rglob("dataset.json")) == []
    assert (builtin_capture(tmp_path, SMALL, quiet=True) / "points.npy").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_can_not_be_written_is_an_oserror(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(OSError, match=str(tmp_path)):
        builtin_capture(tmp_path / "cache", SMALL, quiet=True)
