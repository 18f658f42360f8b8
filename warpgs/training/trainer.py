"""The training loop."""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from warpgs.command_line.interrupt import Interrupt
from warpgs.config.presets import far_rates
from warpgs.initialization import alignment
from warpgs.initialization.by_segment import dynamic_start
from warpgs.initialization.start import Start
from warpgs.model.scene import SplitScene
from warpgs.runs import checkpoint
from warpgs.runs.captures import require_same_times
from warpgs.runs.logger import TrainingLogger
from warpgs.runs.progress import Callback, Progress, Status
from warpgs.runs.trained import TrainedScene
from warpgs.runtime import ranks
from warpgs.runtime.random_numbers import random_numbers

from . import optimizer as optim
from .density.adaptation import Adaptation
from .sampling import Sampler
from .schedule import IterationPlan, Phase, Protocol
from .step import Sample, Step

CHECK_EVERY = 50
"""Iterations between checks of the loss, which synchronize with the device."""

AGREE_EVERY = 10
"""Iterations after which several ranks tell each other whether to stop, as long as a single one does in each."""

MAX_ROLLBACKS = 3
"""Maximum number of returns to the last checkpoint after a loss that is not finite."""


class Trainer:
    """Trains a scene on a capture into a run folder.

    All random numbers are a function of the seed, the iteration, the number of rollbacks and the rank, so that a
    resumed run continues exactly as the interrupted one would have.

    Several ranks (``runtime.ranks``) train one scene: an iteration is one step of Adam over one view of each. Nothing
    in the schedule depends on their number, as in gsplat, whose users shorten it by ``--steps_scaler``.

    Args:
        start: What training starts from; its views and scene are changed.
        run: Run folder, for the checkpoints.

    Attributes:
        capture: The capture, with the masks and background that the config implies.
        scene: What is trained.
        iteration: Iterations done.
        unit: Of learning rates of positions and of corrections of poses [scene units]: the capture's view size, or
            the one with which the run was begun.
        depth_trust: How much each view's depth is trusted.
        notes: Sentences on the start.
        seconds: Training time of earlier sessions of this run [s].
        callbacks: Called after regular checks and before checkpoints, off the clock.
    """

    def __init__(self, start: Start, run: Path) -> None:
        self.config, self.run = start.plan, run
        self.capture, self.views = start.capture, start.views
        self.alignments, self.depth_trust, self.notes = start.alignments, start.trust, start.notes
        self.device, self.unit = start.views.device, start.capture.view_size
        self.iteration, self.rollbacks = 0, 0
        self.seconds, self._started = 0.0, time.monotonic()
        self.callbacks: Sequence[Callback] = ()
        self._earlier_peak = 0
        self.protocol = Protocol(start.plan, start.has_depth, start.num_aligned > 0, start.plan.branches_in_stage2)
        self._sampler = Sampler(self.config.seed, len(self.views))
        self._start_from(start.scene)

    def _start_from(self, scene: SplitScene) -> None:
        """Replaces the scene on all ranks by that of rank 0, with a new optimizer."""
        optim.copy_first(list(optim.trained_parameters(scene.to(self.device), self.views.poses).values()))
        self._copy_first_segments(scene)
        self._set_scene(scene)

    def _copy_first_segments(self, scene: SplitScene) -> None:
        """Replaces the segments of the dynamic Gaussians by those of rank 0, which has sent the Gaussians before."""
        dynamic = scene.dynamic
        if dynamic.segments is not None and ranks.num_ranks() > 1:
            if not ranks.is_first():
                dynamic.segments = dynamic.segments.new_empty(len(dynamic))
            ranks.copy_first_(dynamic.segments)

    def _set_scene(self, scene: SplitScene) -> None:
        """Replaces the scene, with a new optimizer."""
        self.scene = scene.to(self.device)
        self.step = Step(self.config, self.scene, self.views, self.alignments, self.depth_trust, self.unit)

    # The algorithm ----------------------------------------------------------------------------------------------------

    def train(self, logger: TrainingLogger, interrupt: Interrupt | None = None) -> bool:
        """Trains from the current iteration to the end of the protocol and saves a checkpoint where it stops.

        Returns:
            Whether the end was reached; false after an interrupt, or if a callback returned true.

        Raises:
            ValueError: If the loss is repeatedly not finite, or a branch that is needed has lost its last Gaussian.
        """
        if self.iteration == 0:
            self.save()
        while self.iteration < self.protocol.num_iterations:
            if self.iteration == self.protocol.stage1.start and not self._add_dynamic_gaussians(interrupt, logger):
                self.save()
                return False
            plan = self.protocol.at(self.iteration)
            self.views.announce(self._sampler.views(self.iteration, self.rollbacks))
            self.step(plan, self._sample(plan))
            if plan.actions:
                self._adapt(plan, logger)
            self.iteration += 1
            at_checkpoint = self.iteration % self.config.checkpoint_every == 0
            at_checkpoint |= self.iteration == self.protocol.num_iterations
            is_check = at_checkpoint or self.iteration % CHECK_EVERY == 0
            stop = self._is_stop_requested(interrupt, is_check)
            if is_check or stop:
                status = self._check(plan.phase, logger)
                stop |= status is not None and ranks.any_rank(self._call_back(status, logger))
                if status is None:
                    self._roll_back(logger)
                elif at_checkpoint or stop:
                    self.save()
            if stop:
                return False
        return True

    def _is_stop_requested(self, interrupt: Interrupt | None, is_check: bool) -> bool:
        """Whether training is to stop after this iteration; the same answer on all ranks.

        They agree before every check, too: a lost rank is found here, where no rank waits for its GPU yet.
        """
        requested = interrupt is not None and interrupt.requested
        if ranks.num_ranks() == 1:
            return requested
        return (is_check or self.iteration % AGREE_EVERY == 0) and ranks.any_rank(requested)

    def _adapt(self, plan: IterationPlan, logger: TrainingLogger) -> None:
        """Lets rank 0 do what is planned after an iteration, and sends the result to the others."""
        ranks.any_rank(False)  # finds a lost rank
        self.step.density.merge()
        before = self.scene.dynamic.means.data
        if ranks.is_first():
            if "realign" in plan.actions:
                self._realign(plan.phase)
            self.step.density.adapt(self._adaptation(plan, logger))
        optim.copy_first(list(self.step.parameters().values()), self.step.optimizer)
        ranks.copy_first_(self.alignments)
        if plan.replaces_gaussians:  # otherwise CUDA graphs go on to read segments where they are
            self._copy_first_segments(self.scene)
            dynamic = self.scene.dynamic
            stays = self.scene.num_segments > 1 and dynamic.means.data_ptr() == before.data_ptr()
            self.step.begin_density(num_kept=len(dynamic) * stays)

    def _realign(self, phase: Phase) -> None:
        """Aligns the depth of the views to the rendered depth, in place, because CUDA graphs read it."""
        if not self.capture.metric_depth:
            settings = self.config.render_settings
            found = alignment.align_to_rendering(self.alignments, self.views, self.scene, phase.sh_degree, settings)
            self.alignments.copy_(torch.where(self.depth_trust.weight[:, None] > 0, found, torch.nan))

    def _adaptation(self, plan: IterationPlan, logger: TrainingLogger) -> Adaptation:
        """All that density control changes and depends on after the current iteration."""
        number = self.iteration + 1
        return Adaptation(
            scene=self.scene,
            optimizer=self.step.optimizer,
            plan=plan,
            config=self.config,
            capture=self.capture,
            views=self.views,
            alignments=self.alignments,
            generator=self._generator,
            log=lambda text: logger.log(f"iteration {number}: {text}"),
        )

    def _add_dynamic_gaussians(self, interrupt: Interrupt | None = None, logger: TrainingLogger | None = None) -> bool:
        """Adds the dynamic Gaussians at the start of stage I, when depth is aligned; false if interrupted before."""
        logger = logger or TrainingLogger(None, self.protocol.num_iterations, self.iteration, quiet=True)
        ranks.any_rank(False)  # finds a lost rank
        sources = (self.config, self.capture, self.views, self.alignments, self.scene.deformation)
        if steps := self.config.schedule.fit_motion:
            logger.log(f"before stage I, {steps:,} steps fit the deformation to points on what moves")
        with logger.fitting("fitting what moves") as show:

            def is_stopped(done: float) -> bool:
                show(done)
                return interrupt is not None and interrupt.requested

            found = dynamic_start(*sources, self._generator("dynamic"), is_stopped)
        if ranks.any_rank(found is None) or found is None:
            return False
        if found.lacks_fit:
            logger.log("warning: no deformation follows what moves: dynamic Gaussians start where frames show them")
        if (tracks := self.capture.tracks) is not None:
            logger.log(f"the deformation follows {found.num_tracks:,} of {len(tracks.positions):,} tracks")
        self.scene.set_dynamic(found.gaussians)
        self._start_from(self.scene)
        return True

    # Randomness -------------------------------------------------------------------------------------------------------

    def _generator(self, purpose: str, device: torch.device | str = "cpu") -> torch.Generator:
        """Random numbers for a purpose at the current iteration, the same on all ranks."""
        return random_numbers(self.config.seed, purpose, self.iteration, self.rollbacks, device)

    def _sample(self, plan: IterationPlan) -> Sample:
        """This rank's view, noise on time and seed of the dropout in the current iteration."""
        return self._sampler(self.iteration, self.rollbacks, plan.time_noise)

    # Checks and checkpoints -------------------------------------------------------------------------------------------

    def _check(self, phase: Phase, logger: TrainingLogger) -> Status | None:
        """Reports the means since the last check; None if the loss or a parameter is not finite.

        Gaussians that are not finite are culled, so the loss alone does not reveal them.
        """
        means = self.step.take_means()
        finite = torch.stack([parameter.isfinite().all() for parameter in self.step.parameters().values()]).all()
        if not math.isfinite(means.loss) or not bool(finite):
            return None
        counts = len(self.scene.static), len(self.scene.dynamic)
        status = Status(self.iteration, phase.stage, means.loss, means.psnr, means.terms, *counts)
        logger.report(status)
        return status

    def _call_back(self, status: Status, logger: TrainingLogger) -> bool:
        """Calls the callbacks; whether one of them asks to stop. Their time is not training time."""
        if not self.callbacks:
            return False
        start = time.monotonic()
        scene = TrainedScene(self.scene, self.config, self._metadata())
        progress = Progress(status, self.protocol.num_iterations, scene, self.capture)
        stop = [bool(callback(progress)) for callback in self.callbacks]
        seconds = time.monotonic() - start
        self._started += seconds
        logger.skip(seconds)
        return any(stop)

    def _roll_back(self, logger: TrainingLogger) -> None:
        """Returns to the newest checkpoint; from there, random numbers are different ones."""
        failed_at, rollbacks = self.iteration, self.rollbacks + 1
        saved = checkpoint.list_checkpoints(self.run)
        if rollbacks > MAX_ROLLBACKS or not saved:
            half = self.config.model.half and self.device.type == "cuda"
            raise ValueError(
                f"the loss or a parameter is not finite after iteration {failed_at}, even after {self.rollbacks} "
                f"returns to a checkpoint; {saved[-1] if saved else 'no checkpoint'} holds the last valid state"
                + (far_rates(self.config) or ("; a new run with --model.no-half trains in single precision" * half))
            )
        self.restore_newest(logger.log)
        logger.begin(self.iteration)
        self.rollbacks = rollbacks
        logger.log(
            f"the loss or a parameter is not finite after iteration {failed_at}: back to iteration {self.iteration}, "
            f"with another order of views and other noise ({rollbacks} of at most {MAX_ROLLBACKS} times)"
        )

    def save(self) -> None:
        """Writes a checkpoint of the whole state of training, on rank 0; the others only hand over what they have."""
        self.step.density.merge()
        if not ranks.is_first():
            return
        tensors = {f"scene.{name}": tensor for name, tensor in self.scene.state_dict().items()}
        if self.views.poses is not None:
            tensors |= {f"poses.{name}": tensor for name, tensor in self.views.poses.state_dict().items()}
        for name, parameter in self.step.parameters().items():
            for part, value in self.step.optimizer.state.get(parameter, {}).items():
                tensors[f"adam.{part}.{name}"] = value
        tensors |= {f"gradients.{name}": tensor for name, tensor in self.step.density.state().items()}
        tensors["alignments"] = self.alignments
        checkpoint.save(checkpoint.path_of(self.run, self.iteration), tensors, self._metadata())
        checkpoint.keep_newest(self.run, checkpoint.NUM_KEPT)

    def _metadata(self) -> checkpoint.Metadata:
        """The plain values of a checkpoint of the current iteration."""
        phase = self.protocol.phase_at(max(0, self.iteration - 1))
        return checkpoint.Metadata(
            iteration=self.iteration,
            use_deformation=phase.use_deformation,
            use_appearance=phase.use_appearance,
            sh_degree=phase.sh_degree,
            train_seconds=self.seconds + time.monotonic() - self._started,
            peak_bytes=self._peak_bytes(),
            rollbacks=self.rollbacks,
            views=tuple(self.capture.train),
            times=tuple(self.capture.cameras[name].time for name in self.capture.train),
            unit=self.unit,
        )

    def _peak_bytes(self) -> int | None:
        """Peak memory of tensors on the GPU in all sessions [bytes]; None on CPU."""
        if self.device.type != "cuda":
            return None
        return max(self._earlier_peak, torch.cuda.max_memory_allocated(self.device))

    def restore(self, path: Path) -> None:
        """Restores the state of a checkpoint.

        Raises:
            DamagedCheckpointError: If it is damaged.
            ValueError: If it is of another config or capture.
        """
        loaded = checkpoint.load(path)
        if loaded.metadata.views != self.capture.train:
            raise ValueError(f"{path} was trained on other frames than {self.capture.name} has now")
        require_same_times(self.capture, loaded.metadata)
        self.alignments = loaded.tensor("alignments", self.alignments.shape).to(self.device)
        self.unit = checkpoint.unit_of(loaded, [self.capture.cameras[name] for name in self.capture.train])
        if self.views.poses is not None:
            self.views.poses = checkpoint.load_poses(loaded, self.unit).to(self.device)
        self._set_scene(checkpoint.load_scene(loaded, self.config.model, self.config.background == "sky"))
        for name, parameter in self.step.parameters().items():
            if f"adam.step.{name}" in loaded.tensors:
                shapes = {"step": torch.Size(), "exp_avg": parameter.shape, "exp_avg_sq": parameter.shape}
                self.step.optimizer.state[parameter] = {
                    part: loaded.tensor(f"adam.{part}.{name}", shape).to(self.device) for part, shape in shapes.items()
                }
        if ranks.is_first():
            for name, tensor in self.step.density.state().items():
                tensor.copy_(loaded.tensor(f"gradients.{name}", tensor.shape))
        metadata = loaded.metadata
        self.iteration, self.rollbacks = metadata.iteration, metadata.rollbacks
        self.seconds, self._started = metadata.train_seconds, time.monotonic()
        self._earlier_peak = metadata.peak_bytes or 0

    def restore_newest(self, log: Callable[[str], None]) -> None:
        """Restores the newest checkpoint of the run folder; without any, training starts from the beginning.

        Damaged ones are renamed, with a warning, and the one before them is restored. Rank 0 decides which; the others
        read the same file.

        Raises:
            ValueError: If all are damaged, or the newest that is not is of another config or capture.
        """
        path = checkpoint.restore_newest(self.run, self.restore, log) if ranks.is_first() else None
        name = ranks.text_of_first("" if path is None else path.name)
        if name and not ranks.is_first():
            self.restore(self.run / checkpoint.FOLDER / name)
