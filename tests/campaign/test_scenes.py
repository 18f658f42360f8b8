"""Whatever the Gaussians and the camera are, images, depths and all gradients are finite."""

import pytest
import torch

from tests.campaign.hostile import Scene
from warpgs.rendering import Layer, render

pytestmark = pytest.mark.usefixtures("contracts_off")


def check_layer(layer: Layer) -> None:
    assert layer.image.isfinite().all()
    assert ((layer.alpha >= 0) & (layer.alpha < 1)).all()
    if layer.depth is not None:
        assert (layer.depth.isfinite() & (layer.depth >= 0)).all()


def check(seed: int) -> bool:
    """Renders a hostile scene; returns whether anything is seen."""
    scene = Scene(seed)
    offsets = torch.zeros(len(scene.splats.means), 2, requires_grad=True)
    result = render(scene.splats, scene.camera, scene.background, scene.settings, offsets)
    layers = [layer for layer in (result.joint, result.static, result.dynamic) if layer is not None]
    for layer in layers:
        check_layer(layer)
    outputs = [value for layer in layers for value in layer if value is not None]
    sum((value * scene.weights(value)).sum() for value in outputs).backward()
    for name, leaf in scene.leaves().items():
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all(), name
    culled = (result.radii == 0).any(-1)
    assert offsets.grad.isfinite().all()
    assert not offsets.grad[culled].any()
    if result.weights is not None:
        assert result.weights.isfinite().all()
        assert not (result.contributed & culled).any()
    return bool((result.joint.alpha > 0).any())


def test_hostile_scenes(count):
    seen = 0
    for seed in range(count):
        try:
            seen += check(seed)
        except (AssertionError, RuntimeError) as error:
            raise AssertionError(f"scene {seed}") from error
    assert seen > 0.2 * count
