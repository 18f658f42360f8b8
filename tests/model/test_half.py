"""The appearance network of the preset ``paper``, with its 49 outputs, in half precision.

torch multiplies half-precision matrices with sums in single precision on CUDA alone; here their products are taken in
single precision, which is the same: a product of two such numbers is exact in it.
"""

import pytest
import torch

from tests.ops.test_mlp import single_precision_product
from tests.reference.sh import bases
from tests.scenes import generator, relative_error
from warpgs.config.presets import PRESETS
from warpgs.model import trunk
from warpgs.model.scene import AppearanceField
from warpgs.ops import mlp

NUM, RESIDUAL = 1000, 0.1
TIME = torch.tensor([0.37])


@pytest.fixture
def field():
    """The network, with a head of random weights and residuals of a standard deviation of ``RESIDUAL``."""
    made = AppearanceField(PRESETS["paper"].model, torch.zeros(3), torch.ones(3))
    head = made.trunk.layers(made.trunk.values.data)[-1].weight
    head.copy_(torch.randn(head.shape, generator=generator()))
    with torch.no_grad():
        head *= RESIDUAL / made(positions(), TIME)[0].std()
    return made


def positions():
    return torch.rand(NUM, 3, generator=generator()) * 2 - 1


def evaluated(field, v_colors, v_opacities):
    """Colours in random directions, opacities of Gaussians that are half opaque, and the gradient of the weights."""
    residuals, logits = field(positions(), TIME)
    directions = torch.nn.functional.normalize(torch.randn(NUM, 3, generator=generator(1)), dim=1)
    colors = (bases(directions, 3)[..., None] * residuals).sum(1)
    opacities = torch.sigmoid(logits)
    field.trunk.values.grad = None
    ((colors * v_colors).sum() + (opacities * v_opacities).sum()).backward()
    return colors.detach(), opacities.detach(), field.trunk.values.grad


def test_colours_opacities_and_gradients_are_those_of_single_precision(field, monkeypatch):
    v_outputs = torch.randn(NUM, 3, generator=generator(2)), torch.randn(NUM, generator=generator(3))
    colors, opacities, gradient = evaluated(field, *v_outputs)

    encode = trunk.encode
    monkeypatch.setattr(mlp, "_product", single_precision_product)
    monkeypatch.setattr(trunk, "encode", lambda *inputs: encode(*inputs[:5], True, inputs[6]))
    half_colors, half_opacities, half_gradient = evaluated(field, *v_outputs)
    assert 0 < (half_colors - colors).abs().max() < 0.1 / 255  # of levels of 8-bit images
    assert (half_opacities - opacities).abs().max() < 1e-4
    assert relative_error(half_gradient, gradient) < 0.03  # ReLU units near zero pass gradients in one case only
