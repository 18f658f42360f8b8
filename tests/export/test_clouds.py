"""A run's scene as clouds: what the renderer shows is what is exported, and what is left out is what counts least."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.export import scenes
from warpgs.export.cloud import Cloud
from warpgs.model.splats import Splats
from warpgs.runs.trained import Player


@pytest.fixture(scope="module")
def moments():
    return scenes.moments()


def rendered(moments, camera):
    return Player(moments.scene, moments.config, moments.facts)(camera, False).joint.image.clamp(0, 1)


@pytest.mark.parametrize("time", [0.0, 0.4, 1.0])
def test_a_cloud_looks_as_the_scene_does_at_its_moment(moments, time):
    camera = scenes.camera(time=time)
    assert (scenes.image(moments.at(time), camera) - rendered(moments, camera)).abs().max() < 1e-4


def test_dynamic_gaussians_move_and_static_ones_change_colour_only(moments):
    a, b = moments.at(0.1), moments.at(0.9)
    still = ~a.is_dynamic
    assert (a.means[still] == b.means[still]).all()
    assert (a.sh[still, 0] != b.sh[still, 0]).any()
    assert (a.means[~still] != b.means[~still]).any()
    assert (a.sh[~still] == b.sh[~still]).all()


def test_bands_that_are_not_in_use_yet_are_left_out(moments):
    young = dataclasses.replace(moments, facts={**scenes.FACTS, "sh_degree": 0})
    assert young.at(0.5).sh.shape[1:] == (1, 3)
    camera = scenes.camera(time=0.5)
    assert (scenes.image(young.at(0.5), camera) - rendered(young, camera)).abs().max() < 1e-4


def test_splats_that_are_opaque_or_thin_stay_finite():
    ones = torch.ones(1, 3)
    cloud = Cloud.of_splats(Splats(ones, torch.ones(1, 4), 0 * ones, torch.ones(1), sh=torch.zeros(1, 1, 3)))
    assert cloud.finite.all()
    assert not cloud.is_dynamic.any()


def test_values_that_are_not_finite_are_told():
    cloud = scenes.cloud(5)
    cloud.means[1, 2] = np.nan
    cloud.sh[3, 0, 1] = np.inf
    assert cloud.finite.tolist() == [True, False, True, False, True]


# Leaving Gaussians out ----------------------------------------------------------------------------------------------


def test_what_is_left_out_is_what_cameras_see_least_of(moments):
    hidden = torch.arange(40) % 2 == 0
    with torch.no_grad():
        moments.scene.static.means[hidden] += torch.tensor([0.0, 0.0, -90.0])
    camera = scenes.camera(time=0.5)
    kept = moments.lightest_left_out(40, [camera])
    assert set(kept.rows.tolist()).isdisjoint(torch.where(hidden)[0].tolist())
    assert (scenes.image(kept.at(0.5), camera) - rendered(moments, camera)).abs().max() < 1e-4


def test_rows_are_the_same_at_every_moment(moments):
    kept = moments.lightest_left_out(11, [scenes.camera()])
    assert all((kept.at(time).means == moments.at(time).means[kept.rows]).all() for time in (0.0, 0.6))
    assert len(kept.at(0.3)) == 11


@pytest.mark.parametrize("most", [60, 10_000])
def test_nothing_is_left_out_of_a_scene_that_is_small_enough(moments, most):
    assert moments.lightest_left_out(most, [scenes.camera()]) is moments


@pytest.mark.parametrize("most", [0, -3])
def test_a_number_that_is_not_positive_is_refused(moments, most):
    with pytest.raises(ValueError, match=f"--max-gaussians must be at least 1, got {most}"):
        moments.lightest_left_out(most, [])
