"""Training: the paper's algorithm, step by step."""

import hashlib
import math
import time
from pathlib import Path

import torch

from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.model.scene import SplitScene
from warpgs.runs import checkpoint

from . import initialize
from .densify import densify, reset_opacities
from .interrupt import Interrupt
from .logger import Status, TrainingLogger
from .prune import prune_invisible
from .schedule import Moment, Protocol
from .step import TERMS, Draw, Step
from .views import Views

LOOK_EVERY = 50
"""Iterations between looks at the loss: reading it waits for the device."""

MAX_ROLLBACKS = 3
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
        num_aligned: Views whose depth could be aligned to the sparse points.
        seconds: Training time of earlier sessions of this run.
    """

    def __init__(self, config: TrainConfig, capture: Capture, run: Path) -> None:
        self.config, self.capture, self.run = config, capture, run
        self.device = torch.device(config.device or "cpu")
        self.views = Views(capture, self.device, config.resident_bytes, config.assume)
        self.iteration = 0
        self.rollbacks = 0
        self.seconds, self._started = 0.0, time.monotonic()
        self._earlier_peak = 0
        self.alignments = initialize.align_to_points(capture, self.views)
        self.num_aligned = int(self.alignments.isfinite().all(1).sum())
        self.protocol = Protocol(config, has_depth=self.num_aligned > 0)
        self._order: tuple[int, int, list[int]] = (-1, 0, [])
        self._begin_with(initialize.first_scene(config, capture, self._generator("points")))

    def _begin_with(self, scene: SplitScene) -> None:
        """Takes a scene on, with a fresh optimizer."""
        self.scene = scene.to(self.device)
        self.step = Step(self.config, self.scene, self.views, self.alignments, self.capture.extent)

    # The algorithm ----------------------------------------------------------------------------------------------------

    def train(self, logger: TrainingLogger, interrupt: Interrupt | None = None) -> bool:
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
            self.step(moment, self._draw(moment))
            self._adapt(moment, logger)
            self.iteration += 1
            at_checkpoint = self.iteration % self.config.checkpoint_every == 0
            at_checkpoint |= self.iteration == self.protocol.num_iterations
            stop = interrupt is not None and interrupt.wanted
            if at_checkpoint or stop or self.iteration % LOOK_EVERY == 0:
                if not self._look(moment, logger):
                    self._roll_back(logger)
                elif at_checkpoint or stop:
                    self.save()
            if stop:
                return False
        return True

    def _adapt(self, moment: Moment, logger: TrainingLogger) -> None:
        """Changes depth alignment and the set of Gaussians where the schedule says so."""
        scene, config = self.scene, self.config.densify
        if moment.realign:
            # In place: the iterations' graph reads them.
            rendered = (scene, moment.sh_degree, self.config.antialias)
            self.alignments.copy_(initialize.align_to_rendering(self.alignments, self.views, *rendered))
        if moment.densify:
            means = self.step.statistics.mean().split([len(scene.static), len(scene.dynamic)])
            generator = self._generator("densify")
            room = config.max_gaussians - len(scene.static) - len(scene.dynamic)
            wanting = [int((gradients > config.gradient).sum()) for gradients in means]
            for gaussians, gradients, want in zip((scene.static, scene.dynamic), means, wanting, strict=True):
                # What room there is is shared in proportion to how many want to grow.
                share = room * want // max(1, sum(wanting))
                extent, large = self.capture.extent, moment.remove_large
                densify(gaussians, self.step.optimizer, gradients, extent, config, share, large, generator)
        if moment.prune:
            cameras = [self.capture.cameras[name].to(self.device) for name in self.capture.train]
            settings = (moment.sh_degree, config.visibility, self.config.antialias)
            removed = prune_invisible(scene, self.step.optimizer, cameras, *settings)
            logger.say(f"iteration {self.iteration + 1}: {removed:,} static Gaussians pruned by visibility")
        if moment.reset:
            for gaussians in (scene.static, scene.dynamic):
                reset_opacities(gaussians, self.step.optimizer)
        if moment.densify or moment.prune:
            self.step.resized()

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

    def _draw(self, moment: Moment) -> Draw:
        """The view of this iteration (every epoch takes each once, in a new order), noise on time and background."""
        epoch, place = divmod(self.iteration, len(self.views))
        if self._order[:2] != (epoch, self.rollbacks):
            order = torch.randperm(len(self.views), generator=self._generator("views", epoch))
            self._order = (epoch, self.rollbacks, order.tolist())
        generator = self._generator("draw")
        noise = moment.noise / len(self.views) * torch.randn(1, generator=generator).item()
        is_random = self.config.loss.dynamic_background == "random"
        background = torch.rand(3, generator=generator) if is_random else torch.zeros(3)
        return Draw(self._order[2][place], noise, background)

    # Looking, saving, going back --------------------------------------------------------------------------------------

    def _look(self, moment: Moment, logger: TrainingLogger) -> bool:
        """Shows the means since the last look; false if the loss or a parameter was not finite.

        Gaussians that are not finite are not drawn: the loss alone would not tell.
        """
        *sums, psnr, steps = self.step.sums.tolist()
        self.step.sums.zero_()
        means = {name: value / steps for name, value in zip(TERMS, sums, strict=True)}
        loss = sum(means.values())
        finite = torch.stack([parameter.isfinite().all() for parameter in self.scene.parameters()]).all()
        if not math.isfinite(loss) or not bool(finite):
            return False
        num_static, num_dynamic = len(self.scene.static), len(self.scene.dynamic)
        logger.show(Status(self.iteration, moment.stage.name, loss, psnr / steps, means, num_static, num_dynamic))
        return True

    def _roll_back(self, logger: TrainingLogger) -> None:
        """Returns to the newest checkpoint; what follows is random in another way."""
        newest = checkpoint.list_checkpoints(self.run)[-1]
        failed_at, rollbacks = self.iteration, self.rollbacks + 1
        if rollbacks > MAX_ROLLBACKS:
            raise ValueError(
                f"the loss or a parameter is not finite after iteration {failed_at}, and was not after "
                f"{MAX_ROLLBACKS} returns to a checkpoint; {newest} holds the last good state"
            )
        self.restore(newest)
        self.rollbacks = rollbacks
        logger.say(
            f"the loss or a parameter is not finite after iteration {failed_at}: back to iteration {self.iteration}, "
            f"with views and noise in another order ({rollbacks} of at most {MAX_ROLLBACKS} times)"
        )

    def save(self) -> None:
        """Writes a checkpoint of everything that training goes on from."""
        tensors = {f"scene.{name}": tensor for name, tensor in self.scene.state_dict().items()}
        for name, parameter in self.scene.named_parameters():
            for part, value in self.step.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{part}.{name}"] = value
        tensors["gradients.total"], tensors["gradients.count"] = self.step.statistics.total, self.step.statistics.count
        tensors["alignments"] = self.alignments
        moment = self.protocol.at(max(0, self.iteration - 1))
        metadata = checkpoint.Metadata(
            iteration=self.iteration,
            use_deformation=moment.moving,
            use_appearance=moment.relit,
            sh_degree=moment.sh_degree,
            train_seconds=self.seconds + time.monotonic() - self._started,
            peak_bytes=self._peak_bytes(),
            rollbacks=self.rollbacks,
            views=tuple(self.capture.train),
        )
        checkpoint.save(checkpoint.path_of(self.run, self.iteration), tensors, metadata)
        checkpoint.keep_newest(self.run, self.config.keep_checkpoints)

    def _peak_bytes(self) -> int | None:
        """Most memory that tensors have taken on the device, also before this session; None on CPU."""
        if self.device.type != "cuda":
            return None
        return max(self._earlier_peak, torch.cuda.max_memory_allocated(self.device))

    def restore(self, path: Path) -> None:
        """Takes up the state of a checkpoint.

        Raises:
            ValueError: If it is damaged or of another config.
        """
        loaded = checkpoint.load(path)
        if loaded.metadata.views != self.capture.train:
            raise ValueError(f"{path} was trained on other frames than {self.capture.name} has now")
        self.alignments = loaded.tensor("alignments", self.alignments.shape).to(self.device)
        self._begin_with(checkpoint.load_scene(loaded, self.config.model))
        for name, parameter in self.scene.named_parameters():
            if f"adam.step.{name}" in loaded.tensors:
                shapes = {"step": torch.Size(), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
                self.step.optimizer.state[parameter] = {
                    part: loaded.tensor(f"adam.{part}.{name}", shape).to(self.device) for part, shape in shapes.items()
                }
        statistics = self.step.statistics
        statistics.total = loaded.tensor("gradients.total", statistics.total.shape).to(self.device)
        statistics.count = loaded.tensor("gradients.count", statistics.count.shape).to(self.device)
        metadata = loaded.metadata
        self.iteration, self.rollbacks = metadata.iteration, metadata.rollbacks
        self.seconds, self._started = metadata.train_seconds, time.monotonic()
        self._earlier_peak = metadata.peak_bytes or 0

    def restore_newest(self) -> None:
        """Takes up the newest checkpoint of the run folder; a run that died before its first one begins anew.

        Raises:
            ValueError: If it is damaged; the one before it is then the newest once it is deleted.
        """
        saved = checkpoint.list_checkpoints(self.run)
        if saved:
            self.restore(saved[-1])
