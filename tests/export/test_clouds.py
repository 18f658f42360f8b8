"""A run's scene as clouds: the exported Gaussians look like the rendered scene."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.export import scenes
from warpgs.export.clouds import Clouds
from warpgs.formats.cloud import Cloud
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
