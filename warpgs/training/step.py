"""One training step: render the three images, compare them with the ground truth, take one step of Adam."""

from collections import Counter
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from warpgs.config import RenderSettings, TrainConfig
from warpgs.data.capture import background_color
from warpgs.evaluation.image_quality import MIN_SQUARED_ERROR
from warpgs.initialization.alignment import DepthTrust
from warpgs.model.dome import Dome
from warpgs.model.scene import InTraining, SplitScene
from warpgs.ops.dropout import dropout
from warpgs.rendering import Rendering, render
from warpgs.runtime import ranks
from warpgs.runtime.graphs import GraphCache
from warpgs.views.views import View, Views

from . import optimizer as optim
from .acceleration import sampled_points
from .density import make_strategy
from .loss_terms import TERMS
from .losses import LossInputs, only_shown
from .schedule import IterationPlan, Phase
from .step_inputs import StepInputs

STEPS = "iterations"
"""Name of the number of iterations among the sums of loss terms."""

DECIBELS = -10.0
"""PSNR is this times the base-10 logarithm of the mean squared error."""


class Sample(NamedTuple):
    """The random choices of an iteration.

    Attributes:
        view: Index of the training view.
        time_noise: Added to the time that the deformation network sees.
        dropout_seed: Chooses the Gaussians that are omitted, an integer below ``ops.dropout.MAX_SEED``.
        color: Behind the dynamic image, RGB in [0, 1].
    """

    view: int
    time_noise: float
    dropout_seed: int
    color: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Means(NamedTuple):
    """Means over the iterations since the last check.

    Attributes:
        loss: The whole loss.
        terms: Each loss term, weighted, over the iterations that computed it; without terms that none computed.
        psnr: PSNR of the joint image [dB], without the Gaussians that ``model.dropout`` omits.
    """

    loss: float
    terms: dict[str, float]
    psnr: float


class Step:
    """Trains a scene by one view per iteration and rank.

    ``_run`` is all that happens on the device. It is given a ``Phase``, branches on nothing else that changes during a
    run, and reads whatever else changes from tensors. So on CUDA it is captured once per phase and replayed until the
    Gaussians change. Eager and replayed iterations run the same code.

    Args:
        config: Config of the run.
        scene: What is trained; on the device of the views.
        views: Training views.
        alignments: [T, 2] scale and offset of each view's inverse depth; may be changed in place.
        depth_trust: [T] how much the depth of each view is trusted.
        unit: The capture's view size, or whatever else a run was begun with; see ``TrainConfig.means_unit`` [scene
            units].

    Attributes:
        scene: What is trained.
        optimizer: Its Adam.
        density: Strategy of density control.
    """

    def __init__(
        self,
        config: TrainConfig,
        scene: SplitScene,
        views: Views,
        alignments: Float[Tensor, "T 2"],
        depth_trust: DepthTrust,
        unit: float,
    ) -> None:
        self.config, self.scene, self.views, self.unit = config, scene, views, unit
        device = views.device
        self.alignments, self._depth_trust = alignments, depth_trust
        sums = (*TERMS, "psnr", STEPS)
        self._inputs = StepInputs(sums, optim.GROUPS, device)
        self._background = torch.tensor(background_color(views.background), dtype=torch.float32, device=device)
        self._rays = None if scene.dome is None else views.lens_rays()
        self._sums = torch.zeros(len(sums), dtype=torch.float32, device=device)
        self._counts: Counter[str] = Counter()  # iterations with each term since the last check, and of all
        self._zero, self._one = (
            torch.zeros((), dtype=torch.float32, device=device),
            torch.ones((), dtype=torch.float32, device=device),
        )
        self.optimizer = optim.make_optimizer(self.parameters(), self._inputs.learning_rates)
        self._graphs: GraphCache[Phase] | None = None
        if views.uses_graphs:
            self._graphs = GraphCache(max_graphs=1, repeatable=False, shared_memory=device)
        self.density = make_strategy(config.densify)
        self.begin_density()

    def parameters(self) -> dict[str, nn.Parameter]:
        """Everything that is trained, by name: the scene and the corrections of the views' cameras."""
        return optim.trained_parameters(self.scene, self.views.poses)

    def begin_density(self, num_kept: int = 0) -> None:
        """Lets density control start anew and invalidates the graph; call it after the Gaussians were replaced.

        What was observed of the last ``num_kept`` of them, which were there before as the last ones, is kept.
        """
        observed = self.density.state() if num_kept else {}
        self.density.begin(len(self.scene.static) + len(self.scene.dynamic), self.views.device)
        for name, values in observed.items():
            self.density.state()[name][-num_kept:] = values[-num_kept:]
        if self.scene.num_segments > 1 and len(self.scene.dynamic):
            self.scene.rows()  # which a graph cannot read back from the device
        if self._graphs is not None:
            self._graphs.invalidate()

    def __call__(self, plan: IterationPlan, sample: Sample) -> None:
        """Runs one iteration."""
        weights = {name: term.weight(plan, self.config.loss) for name, term in TERMS.items()}
        self._counts.update([STEPS, *(name for name in self._active(plan.phase) if weights[name])])
        self._inputs.send(
            time_noise=sample.time_noise,
            dropout_seed=sample.dropout_seed,
            color=sample.color,
            scales={**weights, "psnr": DECIBELS, STEPS: 1.0},
            learning_rates=optim.learning_rates(self.config.optim, self.config.means_unit(self.unit), plan),
        )
        self.views.select(sample.view)
        if self._graphs is None:
            self._run(plan.phase)
        else:
            self._graphs.run(plan.phase, partial(self._run, plan.phase))

    def release_graphs(self) -> None:
        """Frees the memory of the CUDA graphs; from then on, iterations are eager."""
        self._graphs = None

    def take_means(self) -> Means:
        """Means over the iterations of all ranks since the last call; waits for the device."""
        ranks.add_(self._sums)
        *sums, psnr, iterations = self._sums.tolist()
        self._sums.zero_()
        means = {name: value / iterations for name, value in zip(TERMS, sums, strict=True)}
        # Each rank does as many iterations as this one.
        counts, self._counts = self._counts, Counter()
        terms = {name: means[name] * (counts[STEPS] / counts[name]) for name in TERMS if counts[name]}
        return Means(sum(means.values()), terms, psnr / iterations)

    def _run(self, phase: Phase) -> tuple[Tensor, ...]:
        """All that happens on the device."""
        self._choose_trained(phase)
        view = self.views.selected()
        flags = (phase.use_deformation, phase.use_appearance)
        noise = self._inputs.time_noise
        if phase.use_deformation:
            noise = self.scene.with_delays(view.camera, view.time, noise)
        splats, points = self.scene.splats_in_training(
            self._in_training(view, phase), view.time, *flags, phase.sh_degree, noise
        )
        if phase.use_dropout:
            opacities = dropout(splats.opacities, self._inputs.dropout_seed, self.config.model.dropout)
            splats = replace(splats, opacities=opacities)
        backgrounds = self._backgrounds()
        screen_offsets = self.density.screen_offsets if phase.densifies else None
        behind = backgrounds if phase.with_branches else backgrounds[0]
        rendering = render(splats, view.camera, behind, self._settings(phase), screen_offsets)
        rendering = rendering if self.scene.dome is None else self._under_sky(self.scene.dome, rendering, view)
        rendering = only_shown(rendering, view, backgrounds[2])
        alignment, trust = self._depth_of_view() if phase.with_depth else (None, None)
        config = self.config.loss
        length = self.config.length_unit(self.unit)
        inputs = LossInputs(config, view, splats, rendering, backgrounds, alignment, trust, points, length)
        terms = {name: TERMS[name].compute(inputs) for name in self._active(phase)}
        weights = torch.stack([self._inputs.scale[name] for name in terms])
        (torch.stack(list(terms.values())) * weights).sum().backward()
        optim.average_gradients(self.optimizer)
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.density.observe(splats, view.camera, rendering.radii)
        self._add_to_sums(terms, rendering, view)
        return ()

    def _in_training(self, view: View, phase: Phase) -> InTraining:
        """What this step asks of the scene.

        In an overlap of segments it sees each of them alone or both, in a third of the iterations each. So each segment
        learns to show all of the overlap by itself, and does not change where the other one fades.
        """
        seed, config = self._inputs.dropout_seed, self.config.loss
        is_hidden = self._is_hidden(view) if phase.use_appearance and not config.hidden_appearance else None
        points = None
        if phase.use_deformation and config.acceleration > 0:
            points = sampled_points(self.scene, view.time, self.views.interval, seed)
        return InTraining(is_hidden, points, seed % 3 - 1.0 if self.scene.num_segments > 1 else None)

    def _backgrounds(self) -> Float[Tensor, "3 3"]:
        """Colours behind the joint, the static and the dynamic image; the first two are black under a sky.

        The last one is another one in every iteration, so that no opaque Gaussian is as good as a transparent one where
        Eq. 12 wants nothing to be seen; such Gaussians would hide the static scene. Images over white have their own
        colour behind everything, because their alpha is exact.
        """
        behind = self._background if self.views.background == "white" else self._inputs.color
        return torch.stack([self._background, self._background, behind])

    def _under_sky(self, dome: Dome, rendering: Rendering, view: View) -> Rendering:
        """The sky behind the joint and the static image; it learns from static pixels that may show it."""
        (scale, offset), _ = self._depth_of_view()
        hidden = dome.hidden(scale * view.inverse_depth + offset) | ~view.static_mask
        colors = dome(view.camera, None if self._rays is None else self._rays.at(self.views.index))
        colors = torch.where(hidden[..., None], colors.detach(), colors)
        return rendering._replace(dynamic=None).under(colors)._replace(dynamic=rendering.dynamic)

    def _active(self, phase: Phase) -> list[str]:
        """The terms of the loss that are computed in a phase."""
        return [name for name, term in TERMS.items() if term.is_active(phase, self.config.loss)]

    @torch.no_grad()
    def _is_hidden(self, view: View) -> Bool[Tensor, " N"]:
        """Static Gaussians whose centres the mask says to be behind something dynamic."""
        row, column, _, is_inside = view.camera.project(self.scene.static.means)
        return is_inside & ~view.static_mask[row, column]

    def _depth_of_view(self) -> tuple[Tensor, DepthTrust]:
        """Alignment of the depth of the selected view, and how much it is trusted."""
        values = (self.alignments, *self._depth_trust)
        alignment, *trust = (tensor.index_select(0, self.views.index)[0] for tensor in values)
        return alignment, DepthTrust(*trust)

    def _settings(self, phase: Phase) -> RenderSettings:
        """What is rendered in a phase."""
        settings = replace(self.config.render_settings, branches=phase.with_branches, depth=phase.with_depth)
        return self.density.settings(settings) if phase.densifies else settings

    def _choose_trained(self, phase: Phase) -> None:
        """Requires gradients of the parameters that are trained in a phase; the others stay constant."""
        in_stage2 = phase.stage == "stage2"
        for name, parameter in self.scene.static.named_parameters():
            is_geometry = name in ("means", "quats", "log_scales")
            is_frozen = self.config.freezes("geometry" if is_geometry else "appearance")
            is_frozen &= is_geometry or phase.use_appearance  # without residuals, w⁰ is all there is
            parameter.requires_grad_(not (is_frozen and in_stage2))
        self.scene.deformation.requires_grad_(phase.use_deformation)
        self.scene.appearance.requires_grad_(phase.use_appearance)

    @torch.no_grad()
    def _add_to_sums(self, terms: dict[str, Tensor], rendering: Rendering, view: View) -> None:
        """Adds the terms and the PSNR to the sums since the last check, without waiting for the device."""
        error = mse_loss(rendering.joint.image.clamp(0, 1), view.image)
        error = (error if view.shown is None else error / view.shown.float().mean()).clamp_min(MIN_SQUARED_ERROR)
        values = [terms.get(name, self._zero) for name in TERMS]
        self._sums.addcmul_(torch.stack([*values, error.log10(), self._one]), self._inputs.scales)
