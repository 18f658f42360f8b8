"""Training on a capture in other units, or elsewhere in the world, takes the same decisions."""

import copy
import dataclasses
import math

import pytest
import torch

from tests import tiny
from warpgs.config.presets import BEST
from warpgs.data.loaders import LoadOptions, load_with
from warpgs.initialization.prepare_start import prepare_start
from warpgs.training.density import DENSITY
from warpgs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("quickly")

LENGTH = 15
"""Iterations: two densifications, a pruning by visibility, a search for lost objects and a reset. After more, rounding
decides what is near a threshold: Adam makes large steps of tiny gradients."""

SMALL = dataclasses.replace(
    BEST,
    device="cpu",
    seed=1,
    background="black",
    model=dataclasses.replace(
        BEST.model,
        position_bands=2,
        time_bands=2,
        depth=2,
        width=8,
        skip=1,
        appearance_size=(2, 8),
        sh_degree=1,
        max_static_points=50,
        dynamic_points=20,
    ),
    densify=dataclasses.replace(BEST.densify, every=4, gradient=3e-3, min_pixels=0, max_gaussians=500),
    schedule=dataclasses.replace(tiny.SCHEDULE, warmup=4, settle=6),
    checkpoint_every=1000,
)
"""The preset best with few Gaussians, small networks and a short schedule. With this seed and threshold, no gradient of
3dgs and absgrad is closer than 3 % to the threshold, and no size closer than 1 %, so that rounding decides nothing."""


def moved(capture, scale, shift):
    """The capture in a world in which a point p is at ``scale`` · p + ``shift``; its depth is not metric."""
    assert not capture.metric_depth

    def of(camera):
        viewmat = camera.viewmat.clone()
        viewmat[:3, 3] = scale * viewmat[:3, 3] - viewmat[:3, :3] @ torch.tensor(shift)
        return dataclasses.replace(camera, viewmat=viewmat)

    capture = copy.copy(capture).with_cameras({name: of(camera) for name, camera in capture.cameras.items()})
    capture.points = scale * capture.points + torch.tensor(shift)
    return capture


def trained(data, folder, config, scale=1.0, shift=(0.0, 0.0, 0.0)):
    """Numbers of Gaussians after each iteration, terms of the loss, and the Gaussians in units of the view size."""
    capture = moved(load_with(data, None, LoadOptions()), scale, shift)
    trainer, numbers, terms = Trainer(prepare_start(config, capture), folder), [], {}
    trainer.callbacks = [lambda progress: terms.update(progress.status.terms)]

    def stop():
        numbers.append((len(trainer.scene.static), len(trainer.scene.dynamic)))
        return trainer.iteration >= LENGTH

    tiny.train(trainer, tiny.StopWhen(stop))
    found = {}
    for name, branch in (("static", trainer.scene.static), ("dynamic", trainer.scene.dynamic)):
        found[f"means of {name}"] = (branch.means.detach() - torch.tensor(shift)) / trainer.unit
        found[f"sizes of {name}"] = branch.log_scales.detach() - math.log(trainer.unit)
        found[f"opacities of {name}"] = branch.opacities.detach()
    return numbers, terms, found


@pytest.fixture(scope="module", params=DENSITY)
def plain(request, data, quickly, tmp_path_factory):
    """A config of each strategy, and what it trains on the capture as it is."""
    config = dataclasses.replace(SMALL, densify=dataclasses.replace(SMALL.densify, strategy=request.param))
    torch.manual_seed(0)
    return config, trained(data, tmp_path_factory.mktemp("plain"), config)


@pytest.mark.parametrize("change", [{"scale": 10.0}, {"scale": 0.1}, {"shift": (2.0, -1.0, 3.0)}], ids=str)
def test_scaling_and_moving_a_capture_changes_no_decision(data, tmp_path, plain, change):
    config, (numbers, terms, expected) = plain
    numbers_then, terms_then, found = trained(data, tmp_path / "changed", config, **change)
    assert numbers_then == numbers
    assert numbers[0][0] < numbers[-1][0] < 4 * numbers[0][0]  # some grow, and not all
    assert terms_then == pytest.approx(terms, rel=0.1)  # in depth terms, single pixels pass the threshold of opacity
    for name, values in expected.items():
        differences = (found[name] - values).abs()
        assert differences.median() < 1e-3, name
        assert differences.max() < 0.02, name
