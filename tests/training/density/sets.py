"""Sets of Gaussians that density control changes."""

import torch

from tests import plain, tiny
from tests.scenes import generator
from warpgs.model.gaussians import PARAMETERS, Gaussians
from warpgs.model.scene import SplitScene
from warpgs.training.optimizer import make_optimizer

NETWORK = plain.model(position_bands=1, time_bands=1, depth=1, width=2)


def make_gaussians(sizes, opacities=0.8):
    """Gaussians of the given sizes, each twice as long as thick."""
    g, num = generator(), len(sizes)
    scales = torch.tensor(sizes).reshape(-1, 1) * torch.tensor([[0.5, 1.0, 0.5]])
    return Gaussians(
        torch.randn(num, 3, generator=g),
        torch.randn(num, 4, generator=g),
        scales.log(),
        torch.logit(torch.as_tensor(opacities, dtype=torch.float32).expand(num)).clone(),
        torch.randn(num, 1, 3, generator=g),
        torch.randn(num, 15, 3, generator=g),
    )


def make_scene(static, dynamic):
    """A scene, and its optimizer after one step at rate 0 that left every moment at 1 or more."""
    scene = SplitScene(static, dynamic, NETWORK, torch.zeros(3), torch.ones(3))
    optimizer = make_optimizer(dict(scene.named_parameters()), tiny.equal_rates(0.0))
    for parameter in scene.parameters():
        parameter.grad = torch.full_like(parameter, 100.0)
    optimizer.step()
    return scene, optimizer


def copies(gaussians):
    return {name: getattr(gaussians, name).detach().clone() for name in PARAMETERS}


def equal(a, b):
    return all(torch.equal(a[name], b[name]) for name in PARAMETERS)


def trained(data, folder, config):
    """A scene after a training with a config."""
    trainer = tiny.trainer(data, folder, config)
    with tiny.in_haste():
        tiny.train(trainer)
    return trainer.scene
