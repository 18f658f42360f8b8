"""Edits remove the Gaussians they are about, and nothing else; the scene they are made of stays as it is."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.export import scenes
from warpgs.data.capture import Capture
from warpgs.editing.contribution import blend_weights_in, contribution, sample_cameras
from warpgs.editing.edited_scene import NUM_NEIGHBORS, NUM_TIMES, edited, floaters, isolation
from warpgs.editing.options import Edits
from warpgs.video.camera_paths import evenly_spaced

EVERYWHERE = (-1e3, -1e3, -1e3, 1e3, 1e3, 1e3)


@pytest.fixture
def scene():
    return scenes.trained_scene()


@pytest.fixture
def capture():
    """Eight cameras around the scene."""
    cameras = {f"{k}": dataclasses.replace(scenes.camera(), time=k / 7) for k in range(8)}
    return Capture("test", cameras, list(cameras), [], torch.zeros(0, 3), None, lambda name: None)


def state(scene):
    return {name: tensor.clone() for name, tensor in scene.scene.state_dict().items()}


def rows(scene, part):
    """The indices in a scene of the Gaussians of a part of it, by their canonical positions."""
    before, after = (torch.cat([s.scene.static.means, s.scene.dynamic.means]) for s in (scene, part))
    return [int((before == mean).all(1).nonzero()) for mean in after]


def ever(scene, condition):
    """Which Gaussians meet a condition at any of the times that are looked at."""
    return torch.stack([condition(scene.splats(time)) for time in evenly_spaced(NUM_TIMES)]).any(0)


@pytest.mark.parametrize("edits", [Edits(), Edits(crop=EVERYWHERE, min_opacity=0.0, max_gaussians=60)])
def test_edits_that_remove_nothing_give_the_same_scene(scene, capture, edits):
    assert edited(scene, edits, capture) is scene


def test_the_scene_that_is_edited_stays_as_it_is(scene, capture):
    before = state(scene)
    assert len(edited(scene, Edits(crop=(0.0, 0.0, 0.0, 2.0, 2.0, 2.0), max_gaussians=5), capture).scene.static) < 40
    assert all(torch.equal(tensor, before[name]) for name, tensor in state(scene).items())


def test_a_crop_keeps_what_is_inside_of_its_box_at_any_time(scene):
    inside = ever(scene, lambda splats: ((splats.means >= torch.tensor([-0.5, -2, -2])) & (splats.means <= 0.5)).all(1))
    assert inside[40:].any()
    assert not inside[40:].all()
    assert rows(scene, edited(scene, Edits(crop=(-0.5, 0.5, 0.5, 0.5, -2.0, -2.0)))) == inside.nonzero()[:, 0].tolist()


def test_gaussians_that_are_fainter_at_all_times_are_removed(scene):
    least = float(scene.splats(0.0).opacities.median())
    scene.scene.static.logit_opacities[::2] -= 3.0
    opaque = ever(scene, lambda splats: splats.opacities >= least)
    assert 0 < opaque.sum() < 60
    assert rows(scene, edited(scene, Edits(min_opacity=least))) == opaque.nonzero()[:, 0].tolist()


def test_what_is_left_looks_as_before(scene, capture):
    """Gaussians behind all cameras change no image."""
    scene.scene.static.means[:10] += torch.tensor([0.0, 0.0, -90.0])
    kept = edited(scene, Edits(max_gaussians=50), capture)
    assert rows(scene, kept) == [*range(10, 60)]
    for time in (0.0, 0.6):
        camera = scenes.camera(time=time)
        assert torch.equal(kept.render(camera).joint.image, scene.render(camera).joint.image)


def test_those_that_contribute_most_in_all_images_are_kept(scene, capture):
    total = sum(
        blend_weights_in(scene.splats(camera.time), camera, scene.config.render_settings)
        for camera in capture.cameras.values()
    )
    assert rows(scene, edited(scene, Edits(max_gaussians=12), capture)) == sorted(total.argsort()[-12:].tolist())


def test_contributions_are_summed_over_images_and_the_largest_is_known(scene):
    away = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -90], [0, 0, 0, 1]])
    behind = dataclasses.replace(scenes.camera(), viewmat=away)
    once = contribution(scene, [scenes.camera()])
    assert once.total.max() > 1
    assert torch.equal(once.total, once.largest)
    twice = contribution(scene, [behind, scenes.camera(), scenes.camera()])
    assert torch.equal(twice.total, 2 * once.total)
    assert torch.equal(twice.largest, once.largest)
    assert contribution(scene, [behind]).total.max() == 0


def test_contributions_are_those_of_the_time_of_each_camera(scene):
    early, late = (contribution(scene, [scenes.camera(time=time)]).total for time in (0.0, 1.0))
    assert (early[40:] != late[40:]).any()


def test_without_a_capture_default_cameras_see_what_contributes(scene):
    assert len(rows(scene, edited(scene, Edits(max_gaussians=7)))) == 7
    assert contribution(scene, sample_cameras(scene, None)).total.max() > 0


@pytest.fixture
def floating():
    """A dense scene, and one Gaussian far from it at the border of the image."""
    scene = scenes.trained_scene(400, 100)
    scene.scene.static.log_scales -= 1.0
    scene.scene.static.means[123] = torch.tensor([1.9, 1.4, -1.0])
    scene.scene.static.log_scales[123] = -5.0
    return scene


def test_an_isolated_gaussian_of_low_contribution_is_a_floater(floating, capture):
    kept = rows(floating, edited(floating, Edits(drop_floaters=True), capture))
    assert 123 not in kept
    assert len(kept) > 480


def test_an_isolated_gaussian_of_high_contribution_is_no_floater(floating, capture):
    floating.scene.static.means[123] = torch.tensor([0.0, 0.0, -1.9])
    floating.scene.static.log_scales[123] = -1.0
    assert isolation(floating.splats(0.0).means.numpy())[123] > 1.5
    assert 123 in rows(floating, edited(floating, Edits(drop_floaters=True), capture))


def test_a_gaussian_of_low_contribution_among_others_is_no_floater(floating, capture):
    floating.scene.static.means[123] = torch.tensor([0.1, 0.0, 0.0])
    contributions = contribution(floating, list(capture.cameras.values()))
    assert contributions.total[123] < contributions.total.quantile(0.1)
    assert not floaters(floating, contributions)[123]


def test_floaters_are_not_among_the_most_visible(floating, capture):
    edits = Edits(drop_floaters=True, max_gaussians=499)
    assert 123 not in rows(floating, edited(floating, edits, capture))


def test_isolation_is_one_in_regions_of_any_density():
    x, y, z = np.meshgrid(*[np.arange(12.0)] * 3)
    dense = np.stack([x, y, z], -1).reshape(-1, 3)
    points = np.concatenate([dense * 0.01, dense + 50])
    inner = ((dense > 2) & (dense < 9)).all(1)
    assert isolation(points)[np.concatenate([inner, inner])] == pytest.approx(1.0)
    alone = np.concatenate([points, [[25.0, 25.0, 25.0]]])
    assert isolation(alone)[-1] > 5


def test_points_that_are_not_finite_isolate_no_others():
    points = np.random.default_rng(0).random((40, 3))
    among = np.insert(points, 7, np.nan, axis=0)
    assert np.array_equal(np.delete(isolation(among), 7), isolation(points))


@pytest.mark.parametrize("count", [0, 1, NUM_NEIGHBORS])
def test_few_points_are_not_isolated(count):
    assert (isolation(np.random.default_rng(0).random((count, 3))) == 1).all()


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        (Edits(crop=(5.0, 5.0, 5.0, 6.0, 6.0, 6.0)), "edits leave no Gaussian; most have their centres between -"),
        (Edits(min_opacity=1.0), "edits leave no Gaussian"),
        (Edits(crop=(0.0, 0.0, 0.0, 1.0, 0.0, 1.0)), "--crop must be opposite corners of a box, got 0 0 0 1 0 1"),
        (Edits(crop=(0.0, 0.0, 0.0, 1.0, float("nan"), 1.0)), "--crop must be six numbers of at most"),
        (Edits(min_opacity=1.1), "--min-opacity must be in"),
        (Edits(min_opacity=float("nan")), "--min-opacity must be in"),
        (Edits(max_gaussians=0), "--max-gaussians must be at least 1, got 0"),
        (Edits(drop_floaters=True), "--drop-floaters needs the training cameras"),
    ],
)
def test_edits_that_cannot_be_made_are_refused(scene, edits, message):
    with pytest.raises(ValueError, match=message):
        edited(scene, edits)
