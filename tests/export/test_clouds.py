"""A run's scene as clouds: the exported Gaussians look like the rendered scene, and the least visible are omitted."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.export import scenes
from warpgs.export.cloud import Cloud
from warpgs.export.clouds import Clouds
from warpgs.model.splats import Splats
from warpgs.runs.trained import TrainedScene


def rendered(clouds, camera):
    return clouds.scene.render(camera).joint.image.clamp(0, 1)


@pytest.mark.parametrize("time", [0.0, 0.4, 1.0])
def test_a_cloud_looks_like_the_scene_at_its_time(clouds, time):
    camera = scenes.camera(time=time)
    assert (scenes.image(clouds.at(time), camera) - rendered(clouds, camera)).abs().max() < 1e-4


def test_dynamic_gaussians_move_and_static_ones_only_change_colour(clouds):
    a, b = clouds.at(0.1), clouds.at(0.9)
    static = ~a.is_dynamic
    assert (a.means[static] == b.means[static]).all()
    assert (a.sh[static, 0] != b.sh[static, 0]).any()
    assert (a.means[~static] != b.means[~static]).any()
    assert (a.sh[~static] == b.sh[~static]).all()


def test_unused_degrees_of_spherical_harmonics_are_omitted(clouds):
    metadata = dataclasses.replace(scenes.METADATA, sh_degree=0)
    early = Clouds(TrainedScene(clouds.scene.scene, clouds.scene.config, metadata))
    assert early.at(0.5).sh.shape[1:] == (1, 3)
    camera = scenes.camera(time=0.5)
    assert (scenes.image(early.at(0.5), camera) - rendered(early, camera)).abs().max() < 1e-4


def test_opaque_and_thin_splats_stay_finite():
    ones = torch.ones(1, 3)
    cloud = Cloud.of_splats(Splats(ones, torch.ones(1, 4), 0 * ones, torch.ones(1), sh=torch.zeros(1, 1, 3)))
    assert cloud.finite.all()
    assert not cloud.is_dynamic.any()


def test_gaussians_with_values_that_are_not_finite_are_reported():
    cloud = scenes.cloud(5)
    cloud.means[1, 2] = np.nan
    cloud.sh[3, 0, 1] = np.inf
    assert cloud.finite.tolist() == [True, False, True, False, True]


def test_the_least_visible_gaussians_are_omitted(clouds):
    clouds = scenes.clouds()
    hidden = torch.arange(40) % 2 == 0
    clouds.scene.scene.static.means[hidden] += torch.tensor([0.0, 0.0, -90.0])
    camera = scenes.camera(time=0.5)
    kept = clouds.most_visible(40, [camera])
    assert set(kept.rows.tolist()).isdisjoint(torch.where(hidden)[0].tolist())
    assert (kept.visibility([]) == clouds.visibility([camera])[kept.rows]).all()  # which is not measured again
    assert (scenes.image(kept.at(0.5), camera) - rendered(clouds, camera)).abs().max() < 1e-4


def test_visibility_is_the_maximum_over_cameras_of_summed_blend_weights():
    clouds = scenes.clouds()
    away = torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -90], [0, 0, 0, 1]])
    behind = dataclasses.replace(scenes.camera(), viewmat=away)
    seen, unseen = clouds.visibility([scenes.camera()]), clouds.visibility([behind])
    assert (unseen == 0).all()
    assert seen.max() > 1
    assert (clouds.visibility([behind, scenes.camera(), behind]) == seen).all()


def test_the_rows_are_the_same_at_every_time(clouds):
    kept = clouds.most_visible(11, [scenes.camera()])
    assert all((kept.at(time).means == clouds.at(time).means[kept.rows]).all() for time in (0.0, 0.6))
    assert len(kept.at(0.3)) == 11


@pytest.mark.parametrize("count", [60, 10_000])
def test_a_small_scene_is_kept_whole(clouds, count):
    assert clouds.most_visible(count, [scenes.camera()]) is clouds


@pytest.mark.parametrize("count", [0, -3])
def test_a_count_that_is_not_positive_is_refused(clouds, count):
    with pytest.raises(ValueError, match=f"expected at least 1 Gaussian to keep, got {count}"):
        clouds.most_visible(count, [])
