"""What happens when: the stages of the paper's protocol and everything that depends on the iteration."""

from dataclasses import dataclass
from typing import Literal

from warpgs.config import TrainConfig

from .optimizer import exponential

NOISE = 0.1
"""Amplitude of the noise on time, in frame intervals (Deformable-3DGS)."""

StageName = Literal["pretrain", "stage1", "stage2"]


@dataclass(frozen=True)
class Stage:
    """A stage of training.

    Attributes:
        start, end: First iteration, and the first one after it.
    """

    name: StageName
    start: int
    end: int


@dataclass(frozen=True)
class Moment:
    """All that an iteration does depending on its place in the schedule.

    Attributes:
        stage: The stage it belongs to.
        progress: Share of the run done.
        network_progress: Share done of the iterations in which each network is trained.
        network_warmth: Share of its rate that each network has; rises from 0 when it begins.
        moving, relit: Whether the deformation and the appearance network are in use.
        joint: Whether the joint image is compared with the whole truth.
        sh_degree: Highest degree of spherical harmonics in use.
        depth_weight: λ_depth(t) of paper Eq. 14; 0 = no depth.
        noise: Standard deviation of the noise on time, in frame intervals.
        densify, reset, prune, realign: What to do after this iteration.
        remove_large: Whether densification removes oversized Gaussians.
    """

    stage: Stage
    progress: float
    network_progress: dict[str, float]
    network_warmth: dict[str, float]
    moving: bool
    relit: bool
    joint: bool
    sh_degree: int
    depth_weight: float
    noise: float
    densify: bool
    reset: bool
    prune: bool
    realign: bool
    remove_large: bool


class Protocol:
    """Depth-aware pretraining → stage I, branches apart → stage II, jointly (paper, training protocol).

    Args:
        config: With its schedule already scaled.
        has_depth: Whether the capture has depth; without it there is no pretraining.
    """

    def __init__(self, config: TrainConfig, has_depth: bool) -> None:
        self.config = config
        self.has_depth = has_depth
        schedule = config.schedule
        # Pretraining is of the static branch.
        pretrain = schedule.pretrain if config.dap and has_depth and config.assume != "dynamic" else 0
        # A component that is off gives its iterations to stage I, so that runs compare at one budget.
        stage2 = schedule.stage2 if config.stage2 else 0
        stage1 = schedule.pretrain + schedule.stage1 + schedule.stage2 - pretrain - stage2
        self.pretrain = Stage("pretrain", 0, pretrain)
        self.stage1 = Stage("stage1", pretrain, pretrain + stage1)
        self.stage2 = Stage("stage2", pretrain + stage1, pretrain + stage1 + stage2)
        self.num_iterations = self.stage2.end
        # Iterations of stage I from which the networks are in use; in stage II they always are.
        starts = {"deformation": schedule.deform_from, "appearance": schedule.appearance_from}
        self._begin = {name: min(start, stage1) for name, start in starts.items()}

    def stage_at(self, iteration: int) -> Stage:
        return next(stage for stage in (self.pretrain, self.stage1, self.stage2) if iteration < stage.end)

    def at(self, iteration: int) -> Moment:
        config, schedule = self.config, self.config.schedule
        stage = self.stage_at(iteration)
        in_stage1 = iteration - self.stage1.start
        done = in_stage1 + 1
        growing = stage.name == "stage1" and schedule.densify_from <= done <= schedule.densify_until
        progress = iteration / self.num_iterations
        return Moment(
            stage=stage,
            progress=progress,
            network_progress={name: self._share_since(start, in_stage1) for name, start in self._begin.items()},
            network_warmth={name: self._warmth(in_stage1 - start) for name, start in self._begin.items()},
            moving=in_stage1 >= self._begin["deformation"],
            relit=config.app and in_stage1 >= self._begin["appearance"],
            joint=stage.name == "stage2",
            sh_degree=min(config.model.sh_degree, max(0, in_stage1) // schedule.sh_degree_every),
            depth_weight=self._depth_weight(progress),
            noise=NOISE * max(0.0, 1.0 - in_stage1 / max(1, schedule.noise_until)) if in_stage1 >= 0 else 0.0,
            densify=growing and done % config.densify.every == 0,
            reset=growing and done % schedule.reset_every == 0 and done < schedule.densify_until,
            prune=stage.name == "stage1"
            and config.vdp
            and (done % schedule.prune_every == 0 or iteration + 1 == self.stage2.start)
            and iteration + 1 < self.num_iterations,
            realign=stage.name == "pretrain" and iteration + 1 == min(schedule.realign_at, stage.end),
            remove_large=done > schedule.reset_every,
        )

    def _share_since(self, start: int, in_stage1: int) -> float:
        """Share done of the iterations from one of stage I to the end of the run."""
        return max(0.0, (in_stage1 - start) / max(1, self.num_iterations - self.stage1.start - start))

    def _warmth(self, iterations: int) -> float:
        warmup = self.config.schedule.warmup
        return min(1.0, max(0.0, (iterations + 1) / warmup)) if warmup else 1.0

    def _depth_weight(self, progress: float) -> float:
        loss = self.config.loss
        if not (self.has_depth and self.config.dap) or loss.depth <= 0.0:
            return 0.0
        return exponential(loss.depth, max(loss.depth_end, 1e-12), progress)
