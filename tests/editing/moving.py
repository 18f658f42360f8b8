"""A trained scene of two balls of Gaussians that pass through each other, for tests of objects."""

import torch
from torch import nn

from tests.export import scenes

FAR = 10.0
"""Canonical distance of the balls along y, by which their paths are told apart."""


class Passing(nn.Module):
    """Both balls cross the origin at time 0.5, in opposite directions along x; the first one grows."""

    def forward(self, means, time):
        of_second = means[:, 1:2] > FAR / 2
        x = torch.where(of_second, -1.0, 1.0) * (2.0 * time[:, None] - 1.0) * torch.tensor([1.0, 0.0, 0.0])
        y = torch.where(of_second, -FAR, 0.0) * torch.tensor([0.0, 1.0, 0.0])
        growth = torch.where(of_second, 0.0, 1.0) * time[:, None] * means
        return nn.functional.pad(x + y + growth, (0, 7))


def ball(num, seed=0):
    """[num, 3] points in a ball."""
    random = torch.Generator().manual_seed(seed)
    directions = nn.functional.normalize(torch.randn(num, 3, generator=random), dim=1)
    return 0.3 * directions * torch.rand(num, 1, generator=random) ** (1 / 3)


def scene(num_first=200, num_second=150, num_static=40, others=()):
    """The scene; ``others`` are canonical positions of more dynamic Gaussians."""
    others = torch.tensor(others, dtype=torch.float32).view(-1, 3)
    trained = scenes.trained_scene(num_static, num_first + num_second + len(others))
    second = ball(num_second, 1) + torch.tensor([0.0, FAR, 0.0])
    trained.scene.dynamic.means.copy_(torch.cat([ball(num_first), second, others]))
    trained.scene.dynamic.logit_opacities.fill_(1.0)
    trained.scene.deformation = Passing()
    return trained
