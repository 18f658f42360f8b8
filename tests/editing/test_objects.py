"""Objects are found by the paths of their Gaussians, and found once for a run."""

import dataclasses

import numpy as np
import pytest
import torch

from tests import tiny
from tests.editing import moving
from tests.export import scenes
from warpgs.config import presets
from warpgs.config.options import scaled
from warpgs.editing.identity import identity_of
from warpgs.editing.objects import NAME, find_objects, known_objects, stored_objects
from warpgs.runs.trained import TrainedScene
from warpgs.synthetic import studio

FIRST, SECOND = slice(0, 200), slice(200, 350)


def test_objects_that_pass_through_each_other_are_told_apart():
    ids = find_objects(moving.scene())
    assert (ids[FIRST] == 1).all()
    assert (ids[SECOND] == 2).all()


def test_objects_are_numbered_by_their_size():
    ids = find_objects(moving.scene(100, 250))
    assert (ids[:100] == 2).all()
    assert (ids[100:] == 1).all()


def test_objects_do_not_depend_on_the_order_of_gaussians():
    scene = moving.scene()
    order = torch.randperm(350)
    before = find_objects(scene)
    scene.scene.dynamic.means.copy_(scene.scene.dynamic.means[order].clone())
    assert np.array_equal(find_objects(scene), before[order.numpy()])


@pytest.mark.parametrize("alone", [(0.0, -4.0, 0.0), (float("nan"), 0.0, 0.0)])
def test_a_gaussian_far_from_all_objects_belongs_to_none(alone):
    ids = find_objects(moving.scene(others=[alone]))
    assert ids[-1] == 0
    assert np.array_equal(ids[:-1], find_objects(moving.scene()))


def test_faint_gaussians_do_not_join_two_objects():
    bridge = [(0.0, moving.FAR * k / 200, 0.0) for k in range(200)]
    scene = moving.scene(others=bridge)
    scene.scene.deformation = Still()
    scene.scene.dynamic.logit_opacities[350:] = 2.0
    assert find_objects(scene).max() == 1
    scene.scene.dynamic.logit_opacities[350:] = -9.0
    ids = find_objects(scene)
    assert (ids[FIRST] == 1).all()
    assert (ids[SECOND] == 2).all()


class Still(torch.nn.Module):
    """Nothing moves."""

    def forward(self, means, time):
        return means.new_zeros(len(means), 10)


@pytest.mark.parametrize("count", [0, 1, 16])
def test_few_gaussians_are_no_object(count):
    assert find_objects(moving.scene(count, 0)).tolist() == [0] * count


def test_objects_are_stored_for_all_later_commands(tmp_path, monkeypatch):
    scene = moving.scene()
    found, note = stored_objects(scene, tmp_path)
    assert note == ""
    monkeypatch.setattr("warpgs.editing.objects.find_objects", lambda scene: pytest.fail("found again"))
    assert np.array_equal(stored_objects(scene, tmp_path)[0], found)


def test_objects_of_a_newer_checkpoint_are_found_anew(tmp_path):
    scene = moving.scene()
    stored_objects(scene, tmp_path)
    scene.scene.dynamic.means.copy_(scene.scene.dynamic.means.flip(0).clone())
    newer = TrainedScene(scene.scene, scene.config, dataclasses.replace(scene.metadata, iteration=33))
    assert np.array_equal(stored_objects(newer, tmp_path)[0], find_objects(newer))


def test_objects_of_another_training_of_the_same_length_are_found_anew(tmp_path):
    scene = moving.scene()
    stored_objects(scene, tmp_path)
    scene.scene.dynamic.means.copy_(scene.scene.dynamic.means.flip(0).clone())
    assert np.array_equal(stored_objects(scene, tmp_path)[0], find_objects(scene))


def test_a_file_without_a_fingerprint_is_written_anew(tmp_path):
    scene = moving.scene()
    np.savez(tmp_path / NAME, iteration=32, ids=np.zeros(350, np.int32))
    assert stored_objects(scene, tmp_path)[0].max() == 2
    assert known_objects(scene, tmp_path).max() == 2


def test_a_damaged_file_of_objects_is_refused_by_its_name(tmp_path):
    (tmp_path / NAME).write_bytes(b"PK\3\4 damaged")
    with pytest.raises(ValueError, match=r"objects\.npz"):
        stored_objects(moving.scene(), tmp_path)


@pytest.mark.parametrize(
    ("iteration", "ids"),
    [
        (32, np.full(350, -1, np.int32)),
        (32, np.full(350, 2**31 - 1, np.int32)),
        (32, np.ones(350)),
        (32, np.ones((350, 1), np.int32)),
        ([32, 32], np.ones(350, np.int32)),
    ],
)
def test_a_file_with_other_numbers_is_refused_by_its_name(tmp_path, iteration, ids):
    scene = moving.scene()
    fingerprint = np.frombuffer(bytes.fromhex(identity_of(scene).fingerprint), np.uint8)
    np.savez(tmp_path / NAME, iteration=iteration, fingerprint=fingerprint, ids=ids)
    with pytest.raises(ValueError, match=r"objects\.npz .*: delete it"):
        stored_objects(scene, tmp_path)


def test_a_folder_that_cannot_be_written_is_said(tmp_path):
    (tmp_path / "run").write_text("a file")
    ids, note = stored_objects(moving.scene(), tmp_path / "run")
    assert ids.max() == 2
    assert note.startswith("objects are found anew each time: ")


def test_a_scene_without_dynamic_gaussians_has_no_objects(tmp_path):
    assert len(stored_objects(scenes.trained_scene(40, 0), tmp_path)[0]) == 0
    assert list(tmp_path.iterdir()) == []


SIZE = studio.StudioSize(width=96, height=54, num_frames=24, num_samples=1, num_points=2_000)


def bodies_at(means, time, shift):
    """The moving body that a camera of the studio sees where it sees each of some positions; -1 for none."""
    static, camera = studio.static_bodies(), studio.camera_at(time, shift, SIZE)
    traced = studio.trace_bodies([*static, *studio.moving_bodies(time)], camera, 1)
    row, column, _, inside = camera.project(means / studio.SCALE + torch.tensor(studio.CENTER))
    seen = traced.bodies[row.clamp(0, SIZE.height - 1), column.clamp(0, SIZE.width - 1)] - len(static)
    return torch.where(inside, seen, -1).clamp_min(-1)


def true_objects(scene):
    """The moving body that most views of each dynamic Gaussian show; -1 for none."""
    votes = torch.zeros(len(scene.scene.dynamic), 3)
    for k in range(9):
        means = scene.splats(k / 8).means[len(scene.scene.static) :]
        for shift in (0.0, studio.BASELINE):
            votes += torch.nn.functional.one_hot(bodies_at(means, k / 8, shift).long() + 1, 3)
    return votes.argmax(1).numpy() - 1


def test_each_object_of_the_studio_has_one_number(tmp_path):
    (tmp_path / "capture").mkdir()
    studio.write_studio(tmp_path / "capture", SIZE, quiet=True)
    quick = presets.QUICK
    model = dataclasses.replace(quick.model, max_static_points=1_000, dynamic_points=400, depth=4, width=64)
    config = scaled(dataclasses.replace(quick, device="cpu", iterations=160, model=model))
    with tiny.in_haste():
        trainer = tiny.trainer(tmp_path / "capture", tmp_path / "run", config)
        assert tiny.train(trainer)
    scene = TrainedScene(trainer.scene, trainer.config, trainer._metadata())
    ids, truth = find_objects(scene), true_objects(scene)
    numbers = []
    for body in (0, 1):
        counts = np.bincount(ids[truth == body])
        assert counts.max() >= 0.9 * counts.sum() > 50
        numbers.append(int(counts.argmax()))
    assert sorted(numbers) == [1, 2]
