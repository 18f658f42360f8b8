"""Training: the paper's algorithm, step by step."""

import hashlib
import math
import time
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from . import checkpoint, depth, initialize, losses, optim
from .config import RenderSettings, TrainConfig
from .data.capture import Capture
from .densify import GradientStatistics, densify, reset_opacities
from .interrupt import Interrupt
from .logbook import Logbook, Status
from .prune import prune_invisible
from .render import Rendering, render
from .scene.split import SplitScene
from .stages import Moment, Protocol
from .views import View, Views

LOOK_EVERY = 50
"""Iterations between looks at the loss: reading it waits for the device."""

MOST_ROLLBACKS = 3
"""Returns to the last checkpoint because of a loss that is not finite, before giving up."""


class Trainer:
    """Trains a scene on a capture into a run folder.

    Everything random is a function of the seed, the iteration and the number of rollbacks, so that a resumed run goes
    on exactly as the interrupted one would have.

    Args:
        config: Resolved: schedule scaled, device chosen.
        capture: What to train on.
        run: Run folder; checkpoints go below it.

    Attributes:
        scene: What is trained.
        iteration: Iterations done.
        seconds: Training time of earlier sessions of this run.
    """

    def __init__(self, config: TrainConfig, capture: Capture, run: Path) -> None:
        self.config, self.capture, self.run = config, capture, run
        self.device = torch.device(config.device or "cpu")
        if self.device.type == "cuda" and config.tf32:
            torch.set_float32_matmul_precision("high")
        self.views = Views(capture, capture.train, self.device, config.resident_bytes, config.assume)
        self.protocol = Protocol(config, has_depth=self.views[0].inverse_depth is not None)
        self.iteration = 0
        self.rollbacks = 0
        self.seconds, self._started = 0.0, time.monotonic()
        self.alignments = initialize.align_to_points(capture, self.views)
        self._order: tuple[int, int, list[int]] = (-1, 0, [])
        self._begin_with(initialize.first_scene(config, capture, self._generator("points")))

    def _begin_with(self, scene: SplitScene) -> None:
        """Takes a scene on, with a fresh optimizer."""
        self.scene = scene.to(self.device)
        self.optimizer = optim.make_optimizer(self.scene)
        self._forget_gradients()
        self._sums: dict[str, Tensor] = {}

    def _forget_gradients(self) -> None:
        self.statistics = GradientStatistics(len(self.scene.static) + len(self.scene.dynamic), self.device)

    # The algorithm ----------------------------------------------------------------------------------------------------

    def train(self, logbook: Logbook, interrupt: Interrupt | None = None) -> bool:
        """Trains to the end of the protocol, from wherever it stands, and leaves a checkpoint of where it stops.

        Returns:
            Whether the end was reached: false if ``interrupt`` came first.

        Raises:
            ValueError: If the loss stops being finite again and again.
        """
        if self.iteration == 0:
            self.save()
        while self.iteration < self.protocol.num_iterations:
            if self.iteration == self.protocol.stage1.start:
                self._add_dynamic()
            moment = self.protocol.at(self.iteration)
            self.step(moment)
            self._adapt(moment, logbook)
            self.iteration += 1
            at_checkpoint = self.iteration % self.config.checkpoint_every == 0
            at_checkpoint |= self.iteration == self.protocol.num_iterations
            stop = interrupt is not None and interrupt.wanted
            if at_checkpoint or stop or self.iteration % LOOK_EVERY == 0:
                if not self._look(moment, logbook):
                    self._roll_back(logbook)
                elif at_checkpoint or stop:
                    self.save()
            if stop:
                return False
        return True

    def step(self, moment: Moment) -> None:
        """One view: render the three images, compare each with its share of the truth, go downhill."""
        index = self._view_index()
        view = self.views[index]
        self._choose_trained(moment)
        noise = self._time_noise(moment.noise)
        splats = self.scene.splats(view.time, moment.moving, moment.relit, moment.sh_degree, noise)
        settings = RenderSettings(branches=True, depth=moment.depth_weight > 0, antialias=self.config.antialias)
        rendering = render(splats, view.camera, settings=settings)
        terms = self._loss_terms(moment, view, rendering, self.alignments[index])
        torch.stack(list(terms.values())).sum().backward()
        optim.set_learning_rates(
            self.optimizer, self.config.optim, self.capture.extent, moment.progress, moment.network_progress
        )
        self.optimizer.step()
        self.optimizer.zero_grad()
        self.statistics.observe(rendering.gradient_norms, rendering.radii)
        self._note(terms, rendering, view)

    def _loss_terms(
        self, moment: Moment, view: View, rendering: Rendering, alignment: Float[Tensor, "2"]
    ) -> dict[str, Tensor]:
        """Paper Eq. 15: static, dynamic and depth loss; in stage II also the joint image against the whole truth."""
        weights = self.config.loss
        static, dynamic = rendering.static, rendering.dynamic
        assert static is not None
        assert dynamic is not None
        truth, mask = view.image, view.static_mask
        terms = {"static": weights.static * losses.static_loss(static.image, truth, mask, weights.ssim)}
        if moment.stage.name != "pretrain":
            background = self._dynamic_background()
            image = dynamic.image + (1.0 - dynamic.alpha)[..., None] * background
            terms["dynamic"] = weights.dynamic * losses.dynamic_loss(image, truth, mask, weights.ssim, background)
        if moment.joint:
            terms["joint"] = weights.joint * losses.image_loss(rendering.joint.image, truth, weights.ssim)
        if moment.depth_weight > 0 and view.inverse_depth is not None:
            target = depth.metric_depth(view.inverse_depth, alignment)
            branches = [("depth", static, mask, moment.depth_weight)]
            if weights.depth_dynamic > 0 and moment.stage.name != "pretrain":
                branches.append(("depth_dynamic", dynamic, ~mask, weights.depth_dynamic * moment.depth_weight))
            for name, layer, region, weight in branches:
                assert layer.depth is not None
                terms[name] = weight * losses.depth_loss(layer.depth, layer.alpha, target, region)
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

    def _adapt(self, moment: Moment, logbook: Logbook) -> None:
        """Changes depth alignment and the set of Gaussians where the schedule says so."""
        scene, config = self.scene, self.config.densify
        if moment.realign:
            self.alignments = initialize.align_to_rendering(self.alignments, self.views, scene, moment.sh_degree)
        if moment.densify:
            means = self.statistics.mean().split([len(scene.static), len(scene.dynamic)])
            generator = self._generator("densify")
            for gaussians, gradients in zip((scene.static, scene.dynamic), means, strict=True):
                room = config.max_gaussians - len(scene.static) - len(scene.dynamic)
                extent, large = self.capture.extent, moment.remove_large
                densify(gaussians, self.optimizer, gradients, extent, config, room, large, generator)
        if moment.prune:
            cameras = [self.capture.cameras[name].to(self.device) for name in self.capture.train]
            removed = prune_invisible(scene, self.optimizer, cameras, moment.sh_degree, config.visibility)
            logbook.say(f"iteration {self.iteration + 1}: {removed:,} static Gaussians pruned by visibility")
        if moment.reset:
            for gaussians in (scene.static, scene.dynamic):
                reset_opacities(gaussians, self.optimizer)
        if moment.densify or moment.prune:
            self._forget_gradients()

    def _add_dynamic(self) -> None:
        """The dynamic Gaussians come with stage I, when depth is aligned."""
        scene = self.scene
        scene.dynamic = initialize.dynamic_gaussians(
            self.config, self.capture, self.views, self.alignments, scene, self._generator("dynamic")
        )
        self._begin_with(scene)

    # Randomness -------------------------------------------------------------------------------------------------------

    def _generator(self, purpose: str, moment: int | None = None) -> torch.Generator:
        """Random numbers for a purpose at an iteration."""
        moment = self.iteration if moment is None else moment
        words = f"{self.config.seed} {purpose} {moment} {self.rollbacks}"
        return torch.Generator().manual_seed(
            int.from_bytes(hashlib.blake2b(words.encode(), digest_size=7).digest(), "big")
        )

    def _view_index(self) -> int:
        """The view of this iteration: every epoch takes each once, in a new order."""
        epoch, place = divmod(self.iteration, len(self.views))
        if self._order[:2] != (epoch, self.rollbacks):
            order = torch.randperm(len(self.views), generator=self._generator("views", epoch))
            self._order = (epoch, self.rollbacks, order.tolist())
        return self._order[2][place]

    def _time_noise(self, deviation: float) -> Float[Tensor, "1"] | None:
        """Noise on time, ``deviation`` in frame intervals (Deformable-3DGS, annealed smoothing)."""
        if deviation <= 0.0:
            return None
        noise = torch.randn(1, generator=self._generator("time")) * (deviation / len(self.views))
        return noise.to(self.device, non_blocking=True)

    def _dynamic_background(self) -> Float[Tensor, "3"]:
        """What lies behind the dynamic image: black as in the paper, or a new colour each iteration."""
        if self.config.loss.dynamic_background == "black":
            return torch.zeros(3, device=self.device)
        return torch.rand(3, generator=self._generator("background")).to(self.device, non_blocking=True)

    # Looking, saving, going back --------------------------------------------------------------------------------------

    @torch.no_grad()
    def _note(self, terms: dict[str, Tensor], rendering: Rendering, view: View) -> None:
        """Adds to the sums since the last look, without waiting for the device."""
        error = (rendering.joint.image.clamp(0, 1) - view.image).square().mean()
        values = {**terms, "psnr": -10.0 * error.log10(), "steps": torch.ones_like(error)}
        for name, value in values.items():
            self._sums[name] = self._sums.get(name, 0.0) + value.detach()

    def _look(self, moment: Moment, logbook: Logbook) -> bool:
        """Shows the means since the last look; false if the loss was not finite."""
        names = list(self._sums)
        sums = dict(zip(names, torch.stack([self._sums[name] for name in names]).tolist(), strict=True))
        steps = sums.pop("steps")
        means = {name: value / steps for name, value in sums.items()}
        psnr = means.pop("psnr")
        self._sums = {}
        loss = sum(means.values())
        if not math.isfinite(loss):
            return False
        num_static, num_dynamic = len(self.scene.static), len(self.scene.dynamic)
        logbook.show(Status(self.iteration, moment.stage.name, loss, psnr, means, num_static, num_dynamic))
        return True

    def _roll_back(self, logbook: Logbook) -> None:
        """Returns to the newest checkpoint; what follows is random in another way."""
        newest = checkpoint.saved(self.run)[-1]
        failed_at, rollbacks = self.iteration, self.rollbacks + 1
        if rollbacks > MOST_ROLLBACKS:
            raise ValueError(
                f"the loss is not finite after iteration {failed_at}, and was not after {MOST_ROLLBACKS} returns to a "
                f"checkpoint; {newest} holds the last good state"
            )
        self.restore(newest)
        self.rollbacks = rollbacks
        logbook.say(
            f"the loss is not finite after iteration {failed_at}: back to iteration {self.iteration}, with views and "
            f"noise in another order ({rollbacks} of at most {MOST_ROLLBACKS} times)"
        )

    def save(self) -> None:
        """Writes a checkpoint of everything that training goes on from."""
        tensors = {f"scene.{name}": tensor for name, tensor in self.scene.state_dict().items()}
        for name, parameter in self.scene.named_parameters():
            for part, value in self.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{part}.{name}"] = value
        tensors["gradients.total"], tensors["gradients.count"] = self.statistics.total, self.statistics.count
        tensors["alignments"] = self.alignments
        moment = self.protocol.at(max(0, self.iteration - 1))
        facts = {
            "iteration": self.iteration,
            "rollbacks": self.rollbacks,
            "moving": moment.moving,
            "relit": moment.relit,
            "sh_degree": moment.sh_degree,
            "train_seconds": self.seconds + time.monotonic() - self._started,
            "peak_bytes": torch.cuda.max_memory_allocated(self.device) if self.device.type == "cuda" else None,
        }
        checkpoint.save(checkpoint.path_of(self.run, self.iteration), tensors, facts)
        checkpoint.keep_newest(self.run, self.config.keep_checkpoints)

    def restore(self, path: Path) -> None:
        """Takes up the state of a checkpoint.

        Raises:
            ValueError: If it is damaged or of another config.
        """
        loaded = checkpoint.load(path)
        self._begin_with(checkpoint.load_scene(loaded, self.config.model, path))
        for name, parameter in self.scene.named_parameters():
            state = {
                part: loaded.tensors[f"adam.{part}.{name}"].to(self.device)
                for part in ("step", "exp_avg", "exp_avg_sq")
                if f"adam.{part}.{name}" in loaded.tensors
            }
            if state:
                self.optimizer.state[parameter] = state
        self.statistics.total = loaded.tensors["gradients.total"].to(self.device)
        self.statistics.count = loaded.tensors["gradients.count"].to(self.device)
        self.alignments = loaded.tensors["alignments"].to(self.device)
        self.iteration, self.rollbacks = int(loaded.facts["iteration"]), int(loaded.facts["rollbacks"])
        self.seconds, self._started = float(loaded.facts["train_seconds"]), time.monotonic()

    def restore_newest(self) -> None:
        """Takes up the newest checkpoint of the run folder.

        Raises:
            ValueError: If there is none, or it is damaged.
        """
        saved = checkpoint.saved(self.run)
        if not saved:
            raise ValueError(f"{self.run} has no checkpoint to go on from")
        self.restore(saved[-1])
