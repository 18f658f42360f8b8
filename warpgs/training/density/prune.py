"""Pruning: of static Gaussians by visibility (paper Eq. 15), and of both branches by contribution to the images."""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.editing.contribution import as_if_always_there, blend_weights_in, weakest
from warpgs.model.scene import SplitScene
from warpgs.ops.adam import Adam
from warpgs.rendering import DEFAULTS, render
from warpgs.training.schedule import Phase
from warpgs.views.views import View, Views

from .adaptation import Adaptation
from .operations import remove

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
    remove(scene.static, optimizer, pruned.nonzero()[:, 0])
    return removed


def prune(at: Adaptation) -> None:
    """Prunes the static branch by visibility; says so if any Gaussian is removed."""
    cameras, degree, threshold = at.views.cameras(), at.plan.phase.sh_degree, at.config.densify.visibility
    removed = prune_invisible(at.scene, at.optimizer, cameras, degree, threshold, at.config.render_settings)
    if any(removed):
        at.log(str(removed))


@torch.no_grad()
def blend_weights(
    scene: SplitScene, views: Views, phase: Phase, settings: RenderSettings = DEFAULTS
) -> Float[Tensor, " N"]:
    """Sum of the blend weights of every Gaussian, static ones first, over the images of all views.

    Dynamic ones count ``as_if_always_there``.

    Args:
        scene: The scene.
        views: Training views, on the scene's device.
        phase: Says which networks and which degree of spherical harmonics are in use.
        settings: How images are rendered.
    """

    def weights_in(view: View) -> tuple[Tensor]:
        delays = scene.with_delays(view.camera, view.time)
        splats = scene.splats(view.time, phase.use_deformation, phase.use_appearance, phase.sh_degree, delays)
        return (blend_weights_in(splats, view.camera, settings),)

    total = torch.zeros(len(scene.static) + len(scene.dynamic), dtype=torch.float32, device=views.device)
    for (weights,) in views.map(weights_in):
        total += weights
    return as_if_always_there(total, scene)


@torch.no_grad()
def remove_weakest(scene: SplitScene, optimizer: Adam, weights: Float[Tensor, " N"], fraction: float) -> int:
    """Removes the ``weakest`` Gaussians; returns their number.

    Args:
        scene: Changed in place, together with the optimizer's moments.
        optimizer: From ``optimizer.make_optimizer``.
        weights: [N] from ``blend_weights``.
        fraction: In [0, 1).
    """
    is_weak = weakest(weights, fraction)
    branches = (scene.static, scene.dynamic)
    for gaussians, weak in zip(branches, is_weak.split([len(gaussians) for gaussians in branches]), strict=True):
        remove(gaussians, optimizer, weak.nonzero()[:, 0])
    return int(is_weak.sum())


def prune_weakest(at: Adaptation) -> None:
    """Removes what contributes least to the images of the training views."""
    weights = blend_weights(at.scene, at.views, at.plan.phase, at.config.render_settings)
    number = remove_weakest(at.scene, at.optimizer, weights, at.config.densify.weakest)
    at.log(f"{number:,} Gaussians pruned that contribute least")
