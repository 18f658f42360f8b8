"""Scenes, cameras and settings that a diverged training, a damaged file or a careless caller may hand to ``render``."""

import random

import torch
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.splats import Splats

NAN, INF = float("nan"), float("inf")
MAX_MAGNITUDE = 1e19
"""Colours, coefficients and backgrounds up to this have finite gradients; products of larger ones overflow."""

NOT_FINITE = (NAN, INF, -INF)
HOSTILE = (0.0, -0.0, 1e-45, 1e-38, 1e-30, 1e-12, 1e-6, 1e3, 1e6, 1e12, 1e19, 1e30, 3.4e38, -1.0, -1e-6, -1e12)
COLORS = (0.0, 1e-45, 1e-30, -1.0, 1e6, -1e6, MAX_MAGNITUDE, -MAX_MAGNITUDE)
OPACITIES = (0.0, 1e-45, 1 / 255, 0.999, 1.0, 1.0000001, 2.0, 1e30, -0.5)
SIZES = ((1, 1), (1, 40), (40, 1), (16, 16), (17, 15), (40, 30))
COUNTS = (0, 1, 2, 7, 60, 60, 300)
SETTINGS = (
    RenderSettings(),
    RenderSettings(antialias=True, near=1e-30),
    RenderSettings(branches=True, depth=True, statistics=True, absgrad=True),
    RenderSettings(branches=True, depth=True, statistics=True, absgrad=True, antialias=True, near=4.0),
)


class Scene:
    """A scene, always the same for a seed: ``splats`` and ``camera`` with leaves, ``background`` and ``settings``."""

    def __init__(self, seed: int) -> None:
        self._r, self._g = random.Random(seed), torch.Generator().manual_seed(seed)
        self.settings = self._r.choice(SETTINGS)
        crowd = self._r.random() < 0.02
        self._num = 3000 if crowd else self._r.choice(COUNTS)
        size = self._r.choice(SIZES)
        means = torch.randn(self._num, 3, generator=self._g) + torch.tensor([0.0, 0.0, 4.0])
        if crowd or self._r.random() < 0.1:
            means[:] = means[:1].clone()  # coincident
        if self._r.random() < 0.1:
            means[::2, 2] = -means[::2, 2]
        branch = torch.rand(self._num, generator=self._g) > 0.5
        appearance = {"colors": self._spoil(torch.rand(self._num, 3, generator=self._g), COLORS)}
        if self._r.random() < 0.5:
            bases = self._r.choice((1, 16))
            appearance = {"sh": self._spoil(torch.randn(self._num, bases, 3, generator=self._g), COLORS)}
        self.splats = Splats(
            means=self._spoil(means, HOSTILE),
            quats=self._spoil(torch.randn(self._num, 4, generator=self._g), HOSTILE),
            scales=self._spoil(torch.exp(torch.randn(self._num, 3, generator=self._g) - 2), HOSTILE),
            opacities=self._spoil(torch.rand(self._num, generator=self._g), OPACITIES),
            is_dynamic=branch,
            **appearance,
        )
        self.camera = self._camera(size)
        self.background = None if self._r.random() < 0.3 else self._leaf(torch.rand(3, generator=self._g))

    def leaves(self) -> dict[str, Tensor]:
        """The differentiable tensors by name."""
        named = {name: getattr(self.splats, name) for name in Splats.tensor_names()}
        named |= {"viewmat": self.camera.viewmat, "K": self.camera.K, "background": self.background}
        return {name: t for name, t in named.items() if t is not None and t.requires_grad}

    def weights(self, like: Tensor) -> Tensor:
        """Random gradient of an output."""
        return torch.rand(like.shape, generator=self._g) - 0.5

    def _leaf(self, values: Tensor) -> Tensor:
        return values.contiguous().requires_grad_()

    def _spoil(self, values: Tensor, odd: tuple[float, ...]) -> Tensor:
        """Replaces a few numbers, whole Gaussians, or one number of every Gaussian by odd values; often nothing."""
        if values.numel() and self._r.random() < 0.5:
            for _ in range(self._r.choice((1, 3))):
                value = self._r.choice(NOT_FINITE) if self._r.random() < 0.2 else self._r.choice(odd)
                some = torch.rand(self._num, generator=self._g) < self._r.choice((0.05, 0.3, 0.3, 1.0))
                if self._r.random() < 0.5:
                    values[some] = value
                else:
                    values.view(self._num, -1)[some, self._r.randrange(values[0].numel())] = value
        return self._leaf(values)

    def _camera(self, size: tuple[int, int]) -> Camera:
        viewmat, K = torch.eye(4), torch.tensor([[30.0, 0.0, size[0] / 2], [0.0, 28.0, size[1] / 2], [0.0, 0.0, 1.0]])
        viewmat[:3, 3] = 0.3 * torch.randn(3, generator=self._g)
        kind = self._r.random()
        if kind < 0.1:
            K[0, 0] = K[1, 1] = self._r.choice((*HOSTILE, *NOT_FINITE))
        elif kind < 0.2:
            K[self._r.randrange(2), 2] = self._r.choice((*HOSTILE, *NOT_FINITE))
        elif kind < 0.3:
            viewmat[self._r.randrange(3), self._r.randrange(4)] = self._r.choice((*HOSTILE, *NOT_FINITE))
        return Camera(self._leaf(viewmat), self._leaf(K), *size)
