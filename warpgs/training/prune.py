"""Pruning: of static Gaussians by visibility (paper Eq. 15), and of both branches by contribution to the images."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam
from warpgs.rendering import DEFAULTS, render

from . import optimizer as optim
from .schedule import Phase
from .views import View, Views

MAX_ALPHA = 0.99
"""Maximum of α in Eq. 15, so that an opaque Gaussian that is visible in all views keeps a score of 0.01."""

MIN_OPAQUE_OPACITY = 0.9
"""Minimum opacity of the Gaussians that are counted as opaque."""


class Pruned(NamedTuple):
    """Numbers of Gaussians that were removed, by kind.

    V̄ = (fraction of the frames that show it) · (1 − α) is low if either factor is.

    Attributes:
        unseen: Those that no frame shows.
        opaque: Those that few frames show and that have an opacity of at least ``MIN_OPAQUE_OPACITY``.
        faint: The others that few frames show.
    """

    unseen: int
    opaque: int
    faint: int

    def __str__(self) -> str:
        kinds = f"{self.unseen:,} that no frame shows, {self.opaque:,} opaque and {self.faint:,} other that few show"
        return f"{sum(self):,} static Gaussians pruned by visibility: {kinds}"


@torch.no_grad()
def visibility(
    scene: SplitScene, cameras: Iterable[Camera], sh_degree: int, settings: RenderSettings = DEFAULTS
) -> Float[Tensor, " N"]:
    """V̄ of paper Eq. 15 for every static Gaussian: 1/T Σ_t 1[rendered at t] (1 − α(t)), over T cameras.

    "Rendered" means that it changes a pixel of the static image. α is that of w⁰, without residuals of the appearance
    network.

    The cameras are on the scene's device.
    """
    static, settings = scene.static, replace(settings, statistics=True)
    splats = scene.static_splats(sh_degree)
    num_rendered = torch.zeros(len(static), dtype=torch.float32, device=static.means.device)
    num = 0
    for camera in cameras:
        rendering = render(splats, camera, settings=settings)
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
    settings: RenderSettings = DEFAULTS,
) -> Pruned:
    """Removes the static Gaussians with V̄ < ``threshold``; returns their numbers. Arguments as for ``visibility``."""
    scores = visibility(scene, cameras, sh_degree, settings)
    pruned, is_opaque = scores < threshold, scene.static.opacities >= MIN_OPAQUE_OPACITY
    unseen = pruned & (scores == 0)  # 1 − α is at least 1 − MAX_ALPHA
    opaque = pruned & ~unseen & is_opaque
    removed = Pruned(*(int(kind.sum()) for kind in (unseen, opaque, pruned & ~unseen & ~opaque)))
    kept = (~pruned).nonzero()[:, 0]
    optim.gather(optimizer, scene.static, kept, num_kept=len(kept))
    return removed


@torch.no_grad()
def blend_weights(
    scene: SplitScene, views: Views, phase: Phase, settings: RenderSettings = DEFAULTS
) -> Float[Tensor, " N"]:
    """Sum of alpha times transmittance of every Gaussian, static ones first, over the joint images of all views.

    Args:
        scene: The scene.
        views: Training views, on the scene's device.
        phase: Says which networks and which degree of spherical harmonics are in use.
        settings: How images are rendered.
    """
    settings = replace(settings, statistics=True)

    def weights_in(view: View) -> tuple[Tensor]:
        splats = scene.splats(view.time, phase.use_deformation, phase.use_appearance, phase.sh_degree)
        weights = render(splats, view.camera, settings=settings).weights
        assert weights is not None
        return (weights,)

    total = torch.zeros(len(scene.static) + len(scene.dynamic), dtype=torch.float32, device=views.device)
    for (weights,) in views.map(weights_in):
        total += weights
    return total


@torch.no_grad()
def prune_weakest(scene: SplitScene, optimizer: Adam, weights: Float[Tensor, " N"], fraction: float) -> int:
    """Removes the Gaussians with the smallest weights, which hold at most a fraction of all; returns their number.

    If none has any weight, all stay: what no view shows may still be shown later.

    Args:
        scene: Changed in place, together with the optimizer's moments.
        optimizer: From ``optimizer.make_optimizer``.
        weights: [N] from ``blend_weights``.
        fraction: In [0, 1).
    """
    ascending, order = weights.double().sort()
    kept = torch.ones_like(weights, dtype=torch.bool)
    total = ascending.sum()
    kept[order[(ascending.cumsum(0) <= fraction * total) & (total > 0)]] = False
    branches = (scene.static, scene.dynamic)
    for gaussians, keeps in zip(branches, kept.split([len(gaussians) for gaussians in branches]), strict=True):
        indices = keeps.nonzero()[:, 0]
        optim.gather(optimizer, gaussians, indices, num_kept=len(indices))
    return int((~kept).sum())
