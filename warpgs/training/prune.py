"""Visibility-driven pruning of static Gaussians (paper Eq. 15)."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam
from warpgs.rendering import render

from . import optimizer as optim

MAX_ALPHA = 0.99
"""α of Eq. 15 is clamped, so that an opaque Gaussian that is always seen keeps a score of 0.01."""


@torch.no_grad()
def visibility(
    scene: SplitScene, cameras: Iterable[Camera], sh_degree: int, antialias: bool = False
) -> Float[Tensor, " N"]:
    """V̄ of every static Gaussian: 1/T Σ_t 1[rendered at t] (1 − α(t)), over all cameras.

    "Rendered" means that it changed a pixel of the static image. α is that of w⁰: the appearance network leaves
    opacities alone unless ``model.appearance_opacity`` says otherwise.
    """
    static = scene.static
    splats = scene.static_splats(sh_degree)
    seen = torch.zeros(len(static), device=static.means.device)
    num = 0
    for camera in cameras:
        rendering = render(splats, camera, settings=RenderSettings(statistics=True, antialias=antialias))
        assert rendering.contributed is not None
        seen += rendering.contributed
        num += 1
    return seen / max(num, 1) * (1.0 - static.opacities.clamp(max=MAX_ALPHA))


@torch.no_grad()
def prune_invisible(
    scene: SplitScene,
    optimizer: Adam,
    cameras: Iterable[Camera],
    sh_degree: int,
    threshold: float,
    antialias: bool = False,
) -> int:
    """Removes static Gaussians of V̄ < ``threshold``; returns how many."""
    kept = (visibility(scene, cameras, sh_degree, antialias) >= threshold).nonzero()[:, 0]
    removed = len(scene.static) - len(kept)
    optim.gather(optimizer, scene.static, kept, num_kept=len(kept))
    return removed
