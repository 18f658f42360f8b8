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
"""Maximum of α in Eq. 15, so that an opaque Gaussian that is visible in all views keeps a score of 0.01."""


@torch.no_grad()
def visibility(
    scene: SplitScene, cameras: Iterable[Camera], sh_degree: int, antialias: bool = False
) -> Float[Tensor, " N"]:
    """V̄ of paper Eq. 15 for every static Gaussian: 1/T Σ_t 1[rendered at t] (1 − α(t)), over T cameras.

    "Rendered" means that it changes a pixel of the static image. α is that of w⁰, without residuals of the appearance
    network.

    Args:
        scene: The scene.
        cameras: Cameras on the scene's device.
        sh_degree: Maximum degree of spherical harmonics in use.
        antialias: As in ``RenderSettings``.
    """
    static = scene.static
    splats = scene.static_splats(sh_degree)
    num_rendered = torch.zeros(len(static), device=static.means.device)
    num = 0
    for camera in cameras:
        rendering = render(splats, camera, settings=RenderSettings(statistics=True, antialias=antialias))
        assert rendering.contributed is not None
        num_rendered += rendering.contributed
        num += 1
    return num_rendered / max(num, 1) * (1.0 - static.opacities.clamp(max=MAX_ALPHA))


@torch.no_grad()
def prune_invisible(
    scene: SplitScene,
    optimizer: Adam,
    cameras: Iterable[Camera],
    sh_degree: int,
    threshold: float,
    antialias: bool = False,
) -> int:
    """Removes the static Gaussians with V̄ < ``threshold``; returns their number. Arguments as for ``visibility``."""
    kept = (visibility(scene, cameras, sh_degree, antialias) >= threshold).nonzero()[:, 0]
    removed = len(scene.static) - len(kept)
    optim.gather(optimizer, scene.static, kept, num_kept=len(kept))
    return removed
