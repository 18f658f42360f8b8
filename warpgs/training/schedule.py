"""What every iteration does: the stages of the paper's protocol and everything that depends on the iteration."""

from dataclasses import dataclass
from typing import Literal

from warpgs.config import TrainConfig

from .optimizer import BRANCHES, RatePlan, exponential

NOISE = 0.1
"""Initial standard deviation of the noise on time, in frame intervals (Deformable-3DGS)."""

StageName = Literal["pretrain", "stage1", "stage2"]

Action = Literal["realign", "shorten", "densify", "prune", "reseed", "prune_weakest", "reset"]
"""Done after an iteration, in this order: align depth again, shorten needles, densify, prune by visibility, start new
dynamic Gaussians where none shows what moves, prune what contributes least, reset opacities. Needles come before
Gaussians are replaced, because their limit depends on what was observed of each."""

REPLACING = frozenset[Action](("densify", "prune", "reseed", "prune_weakest"))
"""Actions that add or remove Gaussians."""


@dataclass(frozen=True)
class Stage:
    """A stage of training.

    Attributes:
        name: Its name.
        start, end: First iteration, and the first one after the stage.
    """

    name: StageName
    start: int
    end: int


@dataclass(frozen=True)
class Phase:
    """Everything that a training step branches on; the key of its CUDA graph.

    Whatever else changes between iterations reaches the step as tensors. To branch on something new, add it here.

    Attributes:
        stage: Name of the stage.
        use_deformation: Whether the deformation network is in use.
        use_appearance: Whether the appearance network is in use.
        sh_degree: Maximum degree of spherical harmonics in use.
        with_depth: Whether depth is rendered and compared.
        with_branches: Whether the images of the single branches, and their depth, are compared.
        with_joint: Whether the joint image is compared.
        use_dropout: Whether random Gaussians are omitted.
        densifies: Whether Gaussians may still be densified, so that density control looks at their gradients.
    """

    stage: StageName
    use_deformation: bool
    use_appearance: bool
    sh_degree: int
    with_depth: bool
    with_branches: bool
    with_joint: bool
    use_dropout: bool
    densifies: bool


@dataclass(frozen=True)
class IterationPlan(RatePlan):
    """What the schedule says of one iteration.

    Attributes:
        phase: Everything that the training step branches on.
        depth_weight: λ_depth(t) of paper Eq. 14; 0 = no depth loss.
        time_noise: Standard deviation of the noise on time, in frame intervals.
        done: Iterations of stage I and later that are done after this one; at most 0 before.
        densifies_dynamic: Whether densification after this iteration includes the dynamic branch. Of K segments it does
            every K-th time, when each has been seen as often as a capture of its own would.
        actions: What to do after the iteration, in this order.
    """

    phase: Phase
    depth_weight: float
    time_noise: float
    done: int
    densifies_dynamic: bool
    actions: tuple[Action, ...]

    @property
    def replaces_gaussians(self) -> bool:
        """Whether Gaussians are added or removed after the iteration."""
        return not REPLACING.isdisjoint(self.actions)


class Protocol:
    """Depth-aware pretraining → stage I, branches apart → stage II, jointly (paper, training protocol).

    Args:
        config: Config whose schedule is rescaled already (``config.scaled``).
        has_depth: Whether any view has depth to compare.
        pretrains: Whether that includes depth of the static region, which pretraining needs.
        branches_in_stage2: Whether stage II compares the images of the single branches.
    """

    def __init__(
        self, config: TrainConfig, has_depth: bool, pretrains: bool = True, branches_in_stage2: bool = True
    ) -> None:
        self.config, self.has_depth, self._branches_in_stage2 = config, has_depth, branches_in_stage2
        schedule = config.schedule
        pretrain = schedule.pretrain if "dap" not in config.omit and has_depth and pretrains else 0
        # A component that is disabled gives its iterations to stage I, so that runs have equal budgets.
        stage2 = schedule.stage2 if "stage2" not in config.omit else 0
        stage1 = schedule.num_iterations - pretrain - stage2
        self.pretrain = Stage("pretrain", 0, pretrain)
        self.stage1 = Stage("stage1", pretrain, pretrain + stage1)
        self.stage2 = Stage("stage2", pretrain + stage1, pretrain + stage1 + stage2)
        self.num_iterations = self.stage2.end
        # Iterations of stage I from which the networks are in use; in stage II they always are.
        deform_from = 0 if schedule.fit_motion else schedule.deform_from
        starts = {"deformation": deform_from, "appearance": schedule.appearance_from}
        self._network_starts = {name: stage1 if k is None else min(k, stage1) for name, k in starts.items()}
        self._settle_from = stage1 + stage2 - schedule.settle
        self._reseed_from = self._network_starts["deformation"] + schedule.warmup

    def remaining_cost(self, iteration: int) -> int:
        """About how much of the run is left after an iteration: iterations, those with the appearance network twice.

        In the sweep `ablation`, the network takes 0.7 to 1.3 times as long as the rest of an iteration.
        Visibility-driven pruning saves a fifth of the time there, which is not counted.
        """
        left = max(0, self.num_iterations - iteration)
        first = self.stage1.start + self._network_starts["appearance"]
        return left + (min(left, self.num_iterations - first) if "app" not in self.config.omit else 0)

    def stage_at(self, iteration: int) -> Stage:
        """The stage that an iteration belongs to."""
        return next(stage for stage in (self.pretrain, self.stage1, self.stage2) if iteration < stage.end)

    def phase_at(self, iteration: int) -> Phase:
        """Everything that the training step of an iteration branches on."""
        config, in_stage1 = self.config, iteration - self.stage1.start
        stage, joint_from = self.stage_at(iteration).name, config.schedule.joint_from
        with_branches = stage != "stage2" or self._branches_in_stage2
        return Phase(
            stage=stage,
            use_deformation=in_stage1 >= self._network_starts["deformation"],
            use_appearance="app" not in config.omit and in_stage1 >= self._network_starts["appearance"],
            sh_degree=min(config.model.sh_degree, max(0, in_stage1) // config.schedule.sh_degree_every),
            with_depth=self.has_depth and config.loss.depth > 0.0 and with_branches,
            with_branches=with_branches,
            with_joint=stage == "stage2" or (joint_from is not None and in_stage1 >= joint_from),
            use_dropout=config.model.dropout > 0.0 and 0 <= in_stage1 < self._settle_from,
            densifies=stage != "stage2" and in_stage1 < config.schedule.densify_until,
        )

    def at(self, iteration: int) -> IterationPlan:
        """The plan of an iteration."""
        phase, in_stage1 = self.phase_at(iteration), iteration - self.stage1.start
        num = self.config.model.segments or 1
        progress = iteration / self.num_iterations
        decay = max(0.0, 1.0 - in_stage1 / max(1, self.config.schedule.noise_until))
        return IterationPlan(
            phase=phase,
            progress=progress,
            settle_progress=self._progress_from(self._settle_from, in_stage1),
            means_progress=self._means_progress(iteration),
            network_progress={name: self._progress_from(k, in_stage1) for name, k in self._network_starts.items()},
            warmup_factors={name: self._warmup_factor(in_stage1 - k) for name, k in self._network_starts.items()},
            depth_weight=self._depth_weight(progress) if phase.with_depth else 0.0,
            time_noise=NOISE * decay if in_stage1 >= 0 else 0.0,
            done=in_stage1 + 1,
            densifies_dynamic=num == 1 or (in_stage1 + 1) % (num * self.config.densify.every) == 0,
            actions=self._actions(iteration),
        )

    def _actions(self, iteration: int) -> tuple[Action, ...]:
        """What to do after an iteration."""
        schedule, densify, stage = self.config.schedule, self.config.densify, self.stage_at(iteration)
        done, prunes = iteration + 1 - self.stage1.start, self._prunes(iteration)
        is_last, is_end_of_interval = iteration + 1 == self.num_iterations, done % densify.every == 0
        is_growing = stage.name == "stage1" and schedule.densify_from <= done <= schedule.densify_until
        is_grown = schedule.densify_until <= done <= 2 * schedule.densify_until
        is_reset = done % schedule.reset_every == 0 and done < schedule.densify_until
        is_due: dict[Action, bool] = {
            "realign": stage.name == "pretrain" and iteration + 1 == (stage.end + 1) // 2,
            "shorten": densify.max_elongation > 0.0 and (is_end_of_interval or is_last),
            "densify": is_growing and is_end_of_interval,
            "prune": "vdp" not in self.config.omit and prunes,
            "reseed": densify.reseed > 0.0 and prunes and self._reseed_from < done < schedule.densify_until,
            "prune_weakest": densify.weakest > 0.0 and prunes and is_grown,
            "reset": is_growing and is_reset,
        }
        return tuple(action for action, due in is_due.items() if due)

    def _means_progress(self, iteration: int) -> dict[str, float]:
        """By branch, fraction done of the iterations over which the rate of its positions decays."""
        if self.config.optim.means_anneal == "run":
            return dict.fromkeys(BRANCHES, iteration / self.num_iterations)
        start, end = self.stage1.start, self.num_iterations
        static_end = self.stage1.end if self.config.freezes("geometry") else end
        dynamic = max(0, iteration - start) / max(1, end - start)
        return {"static": min(1.0, iteration / max(1, static_end)), "dynamic": dynamic}

    def _progress_from(self, start: int, in_stage1: int) -> float:
        """Fraction done of the iterations from one of stage I to the end of the run."""
        return max(0.0, (in_stage1 - start) / max(1, self.num_iterations - self.stage1.start - start))

    def _warmup_factor(self, iterations: int) -> float:
        warmup = self.config.schedule.warmup
        return min(1.0, max(0.0, (iterations + 1) / warmup)) if warmup else 1.0

    def _depth_weight(self, progress: float) -> float:
        loss = self.config.loss
        return exponential(loss.depth, max(loss.depth_end, 1e-12), progress)

    def _prunes(self, iteration: int) -> bool:
        """Whether to prune: at intervals in stage I and at its end, but not at the end of the run."""
        if self.stage_at(iteration).name != "stage1" or iteration + 1 == self.num_iterations:
            return False
        done = iteration + 1 - self.stage1.start
        return done % self.config.schedule.prune_every == 0 or iteration + 1 == self.stage2.start
