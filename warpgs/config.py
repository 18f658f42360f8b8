"""Every default, in one place."""

import dataclasses
import math
import reprlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal


@dataclass(frozen=True)
class RenderSettings:
    """What a render computes besides the joint image.

    Attributes:
        branches: Also the images of the static and of the dynamic Gaussians alone, from the same sorted lists.
        depth: Also depth, as one more channel.
        statistics: Also whether and how much each Gaussian contributed to the joint image.
        absgrad: On the way back, also the absolute-value variant of the screen-space gradient norms, summed over the
            pixels of all images.
        antialias: Opacity compensation for the low-pass filter (Mip-Splatting).
        near: Near plane [scene units].
        replay: On CUDA, the main thread's renders that are alike and small are replayed from CUDA graphs: the same
            results with less waiting for Python, for the memory of a few renders. Recording one waits for the GPU, and
            no other thread may wait for the whole GPU meanwhile (``ops/replay.py``).
    """

    branches: bool = False
    depth: bool = False
    statistics: bool = False
    absgrad: bool = False
    antialias: bool = False
    near: float = 0.01
    replay: bool = True

    def __post_init__(self) -> None:
        if not 0 < self.near < math.inf:
            raise ValueError(f"near must be positive and finite, got {self.near}")


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the two networks and of the first Gaussians."""

    position_bands: int = 10
    """Frequencies L of the encoding of positions (paper Eq. 6)."""
    time_bands: int = 10
    """Frequencies L of the encoding of time: 10 for real captures, 6 for synthetic ones (paper Eq. 6)."""
    depth: int = 8
    """Layers of each network."""
    width: int = 256
    """Units of each layer."""
    skip: int = 4
    """The encoding enters again after this layer."""
    sh_degree: int = 1
    """Highest degree of spherical harmonics."""
    appearance_degree: int = 0
    """Highest degree of spherical harmonics that the appearance network changes."""
    appearance_opacity: bool = False
    """Whether the appearance network changes opacities, too (paper Eq. 8); off, because seen from one camera at a time
    they fit shadows by making Gaussians at wrong depths come and go."""
    half: bool = True
    """On CUDA, multiply matrices of the networks in half precision, with sums and weights in single precision; only if
    ``width`` is a multiple of 8."""
    max_static_points: int = 100_000
    """Static Gaussians to begin with, at most."""
    dynamic_points: int = 20_000
    """Dynamic Gaussians to begin with."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms (paper Eq. 9, 12, 14, 15)."""

    ssim: float = 0.2
    """λ_ssim, the share of 1 − SSIM beside L1 in every image loss."""
    static: float = 1.0
    """Static image within the static region (Eq. 9)."""
    dynamic: float = 1.0
    """Dynamic image against the masked truth (Eq. 12)."""
    joint: float = 1.0
    """Joint image against the whole truth, in stage II."""
    dynamic_background: Literal["black", "random"] = "random"
    """What the dynamic image is rendered on: black (paper), or another colour in every iteration, so that Gaussians
    which are black there do not hide behind it."""
    depth: float = 2.0
    """λ_depth at the start: depth of the static image within the static region (Eq. 14)."""
    depth_dynamic: float = 1.0
    """The same of the dynamic image within the dynamic region, as a share of λ_depth; 0 in the paper."""
    depth_end: float = 0.2
    """λ_depth at the end of the run, reached exponentially."""


@dataclass(frozen=True)
class OptimConfig:
    """Learning rates of the one Adam; those of Deformable-3DGS where the paper names none."""

    means: float = 1.6e-4
    """Positions, times the extent of the capture; falls to a hundredth over the run, exponentially."""
    quats: float = 1e-3
    scales: float = 5e-3
    opacities: float = 0.05
    sh_dc: float = 2.5e-3
    sh_rest: float = 1.25e-4
    networks: float = 8e-4
    networks_end: float = 1.6e-6
    """Both networks, from the first rate to the second over their stages, exponentially (paper, protocol)."""


@dataclass(frozen=True)
class DensifyConfig:
    """When Gaussians are cloned, split and removed (3DGS, section 5)."""

    every: int = 100
    """Iterations between densifications; ``--iterations`` leaves it, because it is the size of a statistic."""
    gradient: float = 2e-4
    """Mean screen-space gradient norm above which a Gaussian is cloned or split."""
    dense_fraction: float = 0.01
    """Share of the extent above which a Gaussian is split, else cloned."""
    min_opacity: float = 0.005
    """Opacity under which a Gaussian is removed."""
    max_size: float = 0.1
    """Share of the extent above which a Gaussian is removed once opacities have been reset."""
    max_gaussians: int = 3_000_000
    """No further growth above this many, both branches together."""
    visibility: float = 3e-4
    """τ: static Gaussians whose visibility (paper Eq. 15) is lower are removed."""


@dataclass(frozen=True)
class Schedule:
    """Everything that is counted in iterations; ``--iterations`` scales all of it together.

    Stage I counts from its own start.
    """

    pretrain: int = 2_000
    """Depth-aware pretraining."""
    stage1: int = 30_000
    stage2: int = 40_000
    realign_at: int = 1_000
    """Iteration of the pretraining at which monocular depth is aligned again, to the depth rendered so far."""
    densify_from: int = 500
    densify_until: int = 15_000
    reset_every: int = 3_000
    """Iterations between opacity resets, while densifying."""
    prune_every: int = 5_000
    """Iterations of stage I between visibility-driven prunings."""
    deform_from: int = 3_000
    """Iteration of stage I from which dynamic Gaussians move."""
    appearance_from: int = 0
    """Iteration of stage I from which the appearance network changes static Gaussians. In the paper that is stage II;
    by then moving shadows have become Gaussians at wrong depths (docs/results.md)."""
    warmup: int = 1_000
    """Iterations over which the rate of a network rises when it begins: at the full rate Adam's first steps, all of one
    sign, push most units below zero for good, and now and then all of them."""
    noise_until: int = 20_000
    """Iteration of stage I at which the noise on time has died away."""
    sh_degree_every: int = 1_000
    """Iterations of stage I between the degrees of spherical harmonics, 0 to ``model.sh_degree``."""


@dataclass(frozen=True)
class MaskPerturbation:
    """Damage done to the training masks on purpose, to see how much the method needs good ones (paper, robustness).

    Evaluation always uses the true masks.
    """

    erode: int = 0
    """Shrink the dynamic region by this many pixels."""
    dilate: int = 0
    """Grow the dynamic region by this many pixels."""
    holes: float = 0.0
    """Share of the dynamic region to take away as random holes, in [0, 1)."""


@dataclass(frozen=True)
class TrainConfig:
    """Trains SplitGaussian on a capture, or on the built-in scene when no capture is given."""

    data: Path | None = None
    """Folder of the capture; the built-in scene if left out."""
    dataset: Literal["nerfds", "hypernerf", "iphone"] | None = None
    """Layout of the capture; recognised from its files if left out."""
    factor: int | None = None
    """Downscaling of the pictures (the folder rgb/<factor>x); the dataset's usual one if left out."""
    out: Path | None = None
    """Run folder; runs/<capture>-<preset> if left out, with -2, -3 … behind it where there is one already."""
    resume: Path | None = None
    """Run folder to go on with, from its newest checkpoint."""
    preset: Literal["paper", "fast", "quick"] = "paper"
    """Defaults of everything below: paper (72k iterations), fast (one GPU, minutes), quick (two CPU cores, minutes).
    A capture has paper as its default, the built-in scene quick."""
    iterations: int | None = None
    """Iterations in all; scales every schedule together."""
    device: Literal["cuda", "cpu"] | None = None
    """Where to train; CUDA if there is a GPU."""
    seed: int = 0
    dap: bool = True
    """Depth-aware pretraining, and the depth loss of the stages after it."""
    vdp: bool = True
    """Visibility-driven pruning."""
    app: bool = True
    """Appearance network of the static Gaussians, from ``schedule.appearance_from`` on."""
    stage2: bool = True
    """Joint optimisation; without it, stage I takes its iterations too."""
    assume: Literal["masks", "static", "dynamic"] = "masks"
    """What moves: what the masks say, nothing, or everything."""
    static_geometry: bool = False
    """Whether stage II still optimises positions, sizes and rotations of static Gaussians."""
    static_appearance: bool = False
    """Whether stage II still optimises w⁰, the appearance that residuals are added to."""
    antialias: bool = False
    """Opacity compensation for the low-pass filter (Mip-Splatting)."""
    graph: bool = True
    """On CUDA, replay iterations as CUDA graphs."""
    masks: MaskPerturbation = field(default_factory=MaskPerturbation)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    schedule: Schedule = field(default_factory=Schedule)
    checkpoint_every: int = 5_000
    """Iterations between checkpoints."""
    keep_checkpoints: int = 2
    """Checkpoints to keep, the newest."""
    resident_bytes: int = 4 << 30
    """Memory on the device for the training views; captures above it are read from disk as they are needed."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS, for the evaluation at the end."""


PRESETS: dict[str, TrainConfig] = {
    "paper": TrainConfig(),
    "fast": TrainConfig(
        preset="fast",
        schedule=Schedule(
            pretrain=1_000,
            stage1=4_000,
            stage2=10_000,
            realign_at=500,
            densify_from=300,
            densify_until=3_500,
            reset_every=2_500,
            prune_every=2_000,
            deform_from=500,
            warmup=500,
            noise_until=3_500,
            sh_degree_every=500,
        ),
        checkpoint_every=2_500,
    ),
    "quick": TrainConfig(
        preset="quick",
        model=ModelConfig(
            position_bands=6, time_bands=4, depth=3, width=64, skip=2, max_static_points=4_000, dynamic_points=1_500
        ),
        loss=LossConfig(ssim=0.0),
        optim=OptimConfig(means=3.2e-4, sh_dc=1e-2, networks=3e-3, networks_end=1e-4),
        densify=DensifyConfig(gradient=4e-4, max_gaussians=10_000),
        schedule=Schedule(
            pretrain=200,
            stage1=1_000,
            stage2=1_000,
            realign_at=100,
            densify_from=100,
            densify_until=700,
            reset_every=10_000,
            prune_every=500,
            deform_from=50,
            warmup=100,
            noise_until=400,
            sh_degree_every=400,
        ),
        checkpoint_every=500,
    ),
}
"""Named defaults."""


LEAST = {
    "factor": 1,
    "iterations": 3,
    "checkpoint_every": 1,
    "keep_checkpoints": 1,
    "model.depth": 1,
    "model.width": 1,
    "densify.every": 1,
    "schedule.reset_every": 1,
    "schedule.prune_every": 1,
    "schedule.sh_degree_every": 1,
}
"""Smallest values of numbers that must not be 0; no number of a config is negative."""

MOST = {
    "factor": 1024,
    "model.position_bands": 64,
    "model.time_bands": 64,
    "model.depth": 64,
    "model.width": 4096,
}
"""Largest values of numbers that memory is taken by before anything else bounds it."""

MAX_VALUE = 10**15
"""No number of a config is larger."""


def validate(config: TrainConfig) -> None:
    """Refuses numbers that training would stumble over later.

    Raises:
        ValueError: If one is out of its range; the message names it.
    """
    _check_numbers("", config)
    model, schedule = config.model, config.schedule
    if not model.appearance_degree <= model.sh_degree <= 3:
        raise ValueError(
            "expected model.appearance_degree <= model.sh_degree <= 3, "
            f"got {model.appearance_degree} and {model.sh_degree}"
        )
    if schedule.stage1 + schedule.stage2 == 0:
        raise ValueError("schedule.stage1 and schedule.stage2 are both 0: nothing to train")
    for name in ("networks", "networks_end"):
        if getattr(config.optim, name) == 0:
            raise ValueError(f"optim.{name} must be positive, got 0")


def _check_numbers(prefix: str, part: Any) -> None:
    for field_ in dataclasses.fields(part):
        name, value = prefix + field_.name, getattr(part, field_.name)
        if dataclasses.is_dataclass(value):
            _check_numbers(f"{name}.", value)
        elif isinstance(value, int | float):
            least, most = LEAST.get(name, 0), MOST.get(name, MAX_VALUE)
            if not value >= least:
                raise ValueError(f"{name} must be a number of at least {least}, got {value}")
            if value > most:
                raise ValueError(f"{name} must be a number of at most {most}, got {reprlib.repr(value)}")


def scaled(config: TrainConfig) -> TrainConfig:
    """The config with every schedule scaled so that the run takes ``config.iterations``, which is then None.

    Raises:
        ValueError: If a number of the config is out of its range.
    """
    validate(config)
    schedule = config.schedule
    if config.iterations is None:
        return config
    total = schedule.pretrain + schedule.stage1 + schedule.stage2
    factor = config.iterations / total
    # What is 0 stays 0, what is not stays more; the stage with the most takes what rounding leaves.
    values = {name: max(min(value, 1), round(value * factor)) for name, value in dataclasses.asdict(schedule).items()}
    stages = ("pretrain", "stage1", "stage2")
    longest = max(stages, key=values.__getitem__)
    values[longest] += config.iterations - sum(values[name] for name in stages)
    return dataclasses.replace(config, schedule=Schedule(**values), iterations=None)
