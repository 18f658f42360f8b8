"""Exports of scenes with several segments of time."""

import dataclasses

import numpy as np
import pytest
import torch

from tests import plain, tiny
from tests.export.scenes import METADATA
from tests.scenes import as_gaussians, generator, make_splats
from warpgs.export.baking import bake, texture_bytes
from warpgs.export.clouds import Clouds
from warpgs.formats.cloud import sigmoid
from warpgs.model.scene import SplitScene
from warpgs.runs.trained import TrainedScene

KEYS, NUM_STATIC = 21, 7
SEGMENTS = [0, 0, 1, 1]


@pytest.fixture(scope="module")
def clouds():
    """Two segments, whose networks move what they deform."""
    config = dataclasses.replace(tiny.MODEL, sh_degree=3, segments=2)
    dynamic = as_gaussians(make_splats(len(SEGMENTS), 2))
    dynamic.segments = torch.tensor(SEGMENTS)
    scene = SplitScene(as_gaussians(make_splats(NUM_STATIC, 1)), dynamic, config, torch.zeros(3), torch.full((3,), 3.0))
    values = scene.deformation.network.trunk.values
    values.data = 0.2 * torch.randn(values.shape, generator=generator())
    scene.deformation.is_complete = True
    return Clouds(TrainedScene(scene.requires_grad_(False), plain.plan(plain.config(model=config)), METADATA))


def test_gaussians_wait_for_their_segment_where_they_appear(clouds):
    """So that programs that interpolate between key times do not drag them through the image."""
    rows = np.arange(NUM_STATIC + 2, NUM_STATIC + 4)
    later = [clouds.at(time).select(rows) for time in (0.0, 0.2, 0.475, 0.525)]
    assert np.array_equal(later[0].means, later[1].means)
    assert np.abs(later[0].means - later[2].means).max() < 1e-5
    assert np.abs(later[0].means - later[3].means).max() > 1e-3
    assert sigmoid(later[0].logit_opacities).max() < 1 / 255


def test_a_complete_deformation_does_not_change_what_is_seen(clouds):
    deformation = clouds.scene.scene.deformation
    seen = {True: clouds.scene.splats(0.51)}
    deformation.is_complete = False
    seen[False] = clouds.scene.splats(0.51)
    early = clouds.scene.splats(0.1)
    deformation.is_complete = True
    assert torch.equal(seen[True].means, seen[False].means)
    is_there = early.opacities > 0
    assert torch.allclose(clouds.scene.splats(0.1).means[is_there], early.means[is_there], atol=1e-6)


def test_pages_hold_opacities_of_each_key_time(clouds):
    baked = bake(clouds.at, np.linspace(0.0, 1.0, KEYS).tolist(), precision=8.0)
    assert baked.dynamic.opacities.levels.shape == (KEYS, len(SEGMENTS), 1)
    for time in (0.1, 0.5, 0.9):
        found = np.sort(sigmoid(baked.at(time).logit_opacities)[NUM_STATIC:])
        expected = np.sort(clouds.scene.splats(time).opacities[NUM_STATIC:].numpy())
        assert np.abs(found - expected).max() < 0.02
    assert texture_bytes(0, 10, KEYS, 0, fades=True) == texture_bytes(0, 10, KEYS, 0) + 10 * 4 * (KEYS - 1)
