"""One training iteration: render the three images, compare each with its share of the truth, go downhill."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import mse_loss

from warpgs.config import RenderSettings, TrainConfig
from warpgs.model.scene import SplitScene
from warpgs.ops.depth_error import depth_error
from warpgs.rendering import Rendering, render
from warpgs.runtime.graphs import record
from warpgs.runtime.streams import PRIORITY

from . import losses
from . import optimizer as optim
from .densify import GradientStatistics
from .schedule import Moment
from .views import View, Views

TERMS = ("static", "dynamic", "joint", "depth", "depth_dynamic")
"""Terms of the loss."""

DECIBELS = -10.0
"""PSNR of the base-10 logarithm of the mean squared error."""

WARM_UPS = 3
"""Iterations of one kind before one is captured in a CUDA graph: all that is made once is then there."""


class Draw(NamedTuple):
    """What an iteration draws at random.

    Attributes:
        view: Index of the training view.
        noise: Added to the time that the deformation network sees.
        background: [3] colour behind the dynamic image.
    """

    view: int
    noise: float
    background: Float[Tensor, "3"]


class Step:
    """Trains a scene, one view an iteration.

    All that changes between iterations is read from tensors on the device, so that on CUDA an iteration is captured in
    a graph and replayed until the Gaussians or the stage change. Eager and replayed iterations run the same code.

    Attributes:
        scene: What is trained.
        optimizer: Its Adam.
        statistics: Screen-space gradients since the last densification.
        sums: [7] sums since the last look: each term of ``TERMS``, PSNR of the joint image, iterations.
    """

    def __init__(self, config: TrainConfig, scene: SplitScene, views: Views, alignments: Tensor, extent: float) -> None:
        self.config, self.scene, self.views, self.extent = config, scene, views, extent
        device = views.device
        self.alignments = alignments
        self.sums = torch.zeros(len(TERMS) + 2, device=device)
        self._index = torch.zeros(1, dtype=torch.int64, device=device)
        # What the host says anew in every iteration, in one copy: noise on time, colours behind the three images, what
        # each of ``sums`` is scaled by (terms of the loss by their weights), learning rates.
        lengths = (1, 9, len(self.sums), len(optim.GROUPS))
        self._numbers = torch.zeros(sum(lengths), device=device)
        self._noise, backgrounds, self._scales, self._rates = self._numbers.split(lengths)
        self._backgrounds = backgrounds.view(3, 3)
        self._nothing, self._one = torch.zeros((), device=device), torch.ones((), device=device)
        self.optimizer = optim.make_optimizer(scene, self._rates)
        self._replay: Callable[[], None] | None = None
        on_cuda = device.type == "cuda"
        self._pool = torch.cuda.graph_pool_handle() if on_cuda else None
        self._stream = torch.cuda.Stream(device, priority=PRIORITY) if on_cuda else None
        self._kind: tuple[object, ...] | None = None
        self._warm = 0
        self.resized()

    def resized(self) -> None:
        """To be called when the Gaussians have changed: forgets gradients, and the graph that knew the old ones."""
        num = len(self.scene.static) + len(self.scene.dynamic)
        self.statistics = GradientStatistics(num, self.views.device)
        self._is_recorded = False

    def __call__(self, moment: Moment, draw: Draw) -> None:
        """Runs the iteration of a moment of the schedule."""
        progress = (moment.progress, moment.network_progress, moment.network_warmth)
        rates = optim.learning_rates(self.config.optim, self.extent, *progress)
        weights = self.config.loss
        depth_weights = (moment.depth_weight, weights.depth_dynamic * moment.depth_weight)
        scales = (weights.static, weights.dynamic, weights.joint, *depth_weights, DECIBELS, 1.0)
        numbers = [draw.noise, *[0.0] * 6, *draw.background.tolist(), *scales, *rates]
        self._numbers.copy_(torch.tensor(numbers), non_blocking=True)
        self._index.fill_(draw.view)
        if not (self.config.graph and self.views.resident and self.views.device.type == "cuda"):
            self._run(moment, self.views[draw.view])
            return
        kind = (moment.stage.name, moment.moving, moment.relit, moment.sh_degree, moment.depth_weight > 0)
        if kind != self._kind:
            self._kind, self._warm, self._is_recorded = kind, 0, False
        if self._warm < WARM_UPS:
            self._warm += 1
            self._run_picked(moment)
            return
        if self._replay is None or not self._is_recorded:
            # An old graph lives until the new one has taken over its memory.
            self._replay = record(partial(self._run_picked, moment), self._stream, self._pool)
            self._is_recorded = True
        self._replay()

    def _run_picked(self, moment: Moment) -> None:
        """With the view that ``self._index`` says."""
        self._run(moment, self.views.pick(self._index))

    def _run(self, moment: Moment, view: View) -> None:
        self._choose_trained(moment)
        splats = self.scene.splats(view.time, moment.moving, moment.relit, moment.sh_degree, self._noise, late_sh=True)
        with_depth, antialias = moment.depth_weight > 0, self.config.antialias
        settings = RenderSettings(branches=True, depth=with_depth, antialias=antialias, replay=False)
        rendering = render(splats, view.camera, self._backgrounds, settings)
        terms = self._loss_terms(moment, view, rendering)
        # The gradient of a weighted sum, which is not wanted itself, starts from the weights.
        torch.autograd.backward(list(terms.values()), [self._scales[TERMS.index(name)] for name in terms])
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.statistics.observe(rendering.gradient_norms, rendering.radii)
        self._note(terms, rendering, view)

    def _loss_terms(self, moment: Moment, view: View, rendering: Rendering) -> dict[str, Tensor]:
        """Paper Eq. 15: static, dynamic and depth loss; in stage II also the joint image against the whole truth.

        Still without their weights, which are ``self._scales``.
        """
        weights = self.config.loss
        static, dynamic = rendering.static, rendering.dynamic
        assert static is not None
        assert dynamic is not None
        truth, mask = view.image, view.static_mask
        terms = {"static": losses.static_loss(static.image, truth, mask, weights.ssim)}
        branches = [("depth", static, mask)]
        if moment.stage.name != "pretrain":
            behind = self._backgrounds[2]
            terms["dynamic"] = losses.dynamic_loss(dynamic.image, truth, mask, weights.ssim, behind)
            if weights.depth_dynamic > 0:
                branches.append(("depth_dynamic", dynamic, ~mask))
        if moment.joint:
            terms["joint"] = losses.image_loss(rendering.joint.image, truth, weights.ssim)
        if moment.depth_weight > 0:
            alignment = self.alignments.index_select(0, self._index)[0]
            for name, layer, region in branches:
                assert layer.depth is not None
                terms[name] = depth_error(layer.depth, layer.alpha, view.inverse_depth, alignment, region)
        return terms

    def _choose_trained(self, moment: Moment) -> None:
        """Which parameters this stage trains; the others get no gradient and stay."""
        in_stage2 = moment.stage.name == "stage2"
        for name, parameter in self.scene.static.named_parameters():
            is_geometry = name in ("means", "quats", "log_scales")
            stays = self.config.static_geometry if is_geometry else self.config.static_appearance or not moment.relit
            parameter.requires_grad_(stays or not in_stage2)
        self.scene.deformation.requires_grad_(moment.moving)
        self.scene.appearance.requires_grad_(moment.relit)

    @torch.no_grad()
    def _note(self, terms: dict[str, Tensor], rendering: Rendering, view: View) -> None:
        """Adds to the sums since the last look, without waiting for the device."""
        error = mse_loss(rendering.joint.image.clamp(0, 1), view.image)
        values = [terms.get(name, self._nothing) for name in TERMS]
        self.sums.addcmul_(torch.stack([*values, error.log10(), self._one]), self._scales)
