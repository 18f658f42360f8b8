"""The options of a training as a whole; those of a group, such as ``--loss.*``, are in the module of its name."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from .bounds import Bounds, check_bounds
from .densify import DensifyConfig
from .loss import LossConfig
from .masks import MaskPerturbation
from .model import MAX_DEPTH, MAX_WIDTH, ModelConfig
from .optim import OptimConfig
from .render_settings import ALPHA_BOUNDS, RenderSettings
from .schedule import Schedule

NetName = Literal["vgg", "alex", "squeeze"]
"""Networks of LPIPS."""

Component = Literal["dap", "vdp", "app", "stage2"]
"""Components of the paper, by their names in its Table 4."""

BackgroundName = Literal["auto", "sky", "mean", "capture", "black", "white"]
"""Backgrounds that have a name."""


@dataclass(frozen=True)
class TrainConfig:
    """Trains SplitGaussian on a capture, or on the built-in scene if no capture is given."""

    data: Path | None = None
    """Folder of the capture, or a built-in one (docs/cluster.md): builtin:studio, builtin:rig or builtin:balls; else
    builtin:room."""
    dataset: str | None = None
    """Layout of the capture: nerfds, hypernerf, iphone, nerfstudio, blender (D-NeRF), dynerf, llff (NVIDIA), colmap,
    vipe or megasam; recognized from its files if omitted."""
    factor: Annotated[int | None, Bounds(min=1, max=1024)] = None
    """Downscaling factor of the images (folder rgb/<factor>x); the dataset's default if omitted."""
    distortion: bool = True
    """Project by the principal point and the distortion of each camera's lens. Without it cameras are as in
    Deformable-3DGS (paper): pinholes whose principal point is the centre, and HyperNeRF's captures of two cameras
    (vrig) have a factor of 4."""
    readout: Annotated[float | None, Bounds(min=-1, max=1)] = None
    """Rolling shutter: time in which the rows of a frame are read from top to bottom, as a part of the time between two
    frames; negative from bottom to top. That of the capture's files if omitted, 0 (global shutter) without any."""
    readout_from: Literal["top", "bottom", "left", "right"] | None = None
    """Side of the images at which a positive readout begins: left or right in portrait videos of phones. That of the
    capture's files if omitted, to which prepare writes how a video was rotated; top without any."""
    out: Path | None = None
    """Run folder; runs/<capture>-<preset> if omitted, with the suffix -2, -3 … if that exists."""
    resume: Path | None = None
    """Run folder to continue from its newest checkpoint; a larger --iterations extends it."""
    preset: Literal["paper", "best", "patient", "quick"] | None = "best"
    """Defaults of everything below: best (one GPU, minutes), paper (as published, 72k iterations; docs/method.md),
    patient (two CPU cores, 10 minutes), quick (two CPU cores, minutes). On the command line the default is best for a
    capture and quick for the built-in scene; ``TrainConfig()`` is best. None: one that an earlier version had."""
    iterations: Annotated[int | None, Bounds(min=3)] = None
    """Total iterations; every schedule is rescaled to it."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to train on; CUDA if there is a GPU."""
    seed: int = 0
    """Seed of all random numbers."""
    depth: bool = True
    """Use the capture's depth; without it there is no pretraining, no depth loss, and no depth to start from: points
    that are unprojected from depth are not read either."""
    omit: tuple[Component, ...] = ()
    """Components of the paper to omit (Table 4): depth-aware pretraining (dap; depth is still compared),
    visibility-driven pruning (vdp), the appearance network of static Gaussians (app), stage II. Iterations of dap and
    stage2 go to stage I."""
    assume: Literal["auto", "masks", "static", "dynamic"] = "auto"
    """What moves: what the masks mark, nothing (static), or everything (dynamic). With auto it is the masks, unless
    they are estimates of `prepare` and two short trainings, before runs that are longer, are better on held-out frames
    with everything dynamic."""
    background: BackgroundName | tuple[float, float, float] = "auto"
    """Behind all Gaussians: that of the capture, which is white if D-NeRF's images have alpha, else black; the same,
    but the mean colour of the training frames instead of black (mean); learned colours by direction (sky); a sky where
    depth shows one beyond all points, else as mean (auto); or red, green and blue in [0, 1]."""
    frozen: Literal["nothing", "geometry", "appearance", "all"] = "nothing"
    """What stage II no longer optimizes of static Gaussians: positions, scales and rotations (geometry), w⁰, to which
    residuals are added (appearance), or both (all; paper)."""
    exposure: bool = True
    """Divide jumps of exposure and white balance between frames, and the gains of several cameras and their drift, out
    of the training images, and evaluate frames with the gain of their camera."""
    antialias: bool = True
    """Compensate opacities for the low-pass filter (Mip-Splatting)."""
    max_alpha: Annotated[float, ALPHA_BOUNDS] = RenderSettings.max_alpha
    """Maximum alpha of a Gaussian in a pixel: 0.999 as in gsplat; 0.99 in 3DGS (paper)."""
    damage_masks: str | None = None
    """Deliberate damage to the training masks (paper, robustness): erode:PIXELS or dilate:PIXELS of the dynamic region,
    or holes:FRACTION of it, or several with commas between. Evaluation has the true masks."""
    graph: bool = True
    """On CUDA, replay iterations and the steps of ``schedule.fit_motion`` as CUDA graphs."""
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    schedule: Schedule = field(default_factory=Schedule)
    checkpoint_every: Annotated[int, Bounds(min=1)] = 2_500
    """Iterations between checkpoints; the two newest are kept."""
    resident_bytes: int = 4 << 30
    """Maximum memory for training views on the device [bytes]; larger captures are decoded once into a file in
    the user's cache and read from there."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS, for the evaluation at the end."""
    lpips_net: NetName = "vgg"
    """Network of LPIPS: vgg (3DGS), alex (DyCheck's mLPIPS) or squeeze."""

    @property
    def render_settings(self) -> RenderSettings:
        """How all images of the run are rendered."""
        return RenderSettings(antialias=self.antialias, max_alpha=self.max_alpha)

    @property
    def assumption(self) -> Literal["masks", "static", "dynamic"]:
        """What is taken to move, unless a trial says something else."""
        return "masks" if self.assume == "auto" else self.assume

    def freezes(self, part: Literal["geometry", "appearance"]) -> bool:
        """Whether stage II no longer optimizes this part of static Gaussians."""
        return self.frozen in (part, "all")

    def means_unit(self, view_size: float) -> float:
        """Length of 1 in the learning rate of positions [scene units], from a capture's view size."""
        return self.length_unit(view_size)

    def length_unit(self, view_size: float) -> float:
        """Length of 1 in the loss and the noise [scene units], from a capture's view size."""
        return view_size if self.densify.unit == "pixel" else 1.0

    def offset_unit(self, view_size: float) -> float:
        """Length of 1 in the deformation [scene units]: half of a view, from the centre of an image to its border."""
        return 0.5 * view_size if self.densify.unit == "pixel" else 1.0


def validate(config: TrainConfig) -> None:
    """Refuses numbers with which training would fail later.

    Raises:
        ValueError: If a number is out of its range; the message names it.
    """
    check_bounds(config)
    model, schedule = config.model, config.schedule
    if model.sh_degree > 3:
        raise ValueError(f"expected model.sh_degree <= 3, got {model.sh_degree}")
    for size, most in zip(model.appearance_size or (), (MAX_DEPTH, MAX_WIDTH), strict=False):
        Bounds(min=1, max=most).check("each number of model.appearance_size", size)
    if not model.raw_input and 0 in (model.position_bands, model.time_bands):
        raise ValueError(
            "without model.raw_input the networks need model.position_bands and model.time_bands of at least 1, "
            f"got {model.position_bands} and {model.time_bands}"
        )
    MaskPerturbation.parse(config.damage_masks)
    names, rgb = get_args(BackgroundName), config.background
    is_rgb = isinstance(rgb, tuple) and len(rgb) == 3 and all(0.0 <= value <= 1.0 for value in rgb)
    if rgb not in names and not is_rgb:
        raise ValueError(f"background must be {', '.join(names)}, or three numbers in [0, 1], got {rgb!r}")
    if schedule.stage1 + schedule.stage2 == 0:
        raise ValueError("schedule.stage1 and schedule.stage2 are both 0: nothing to train")


def scaled(config: TrainConfig) -> TrainConfig:
    """The config with every schedule rescaled so that the run takes ``config.iterations``, which is None afterwards.

    Raises:
        ValueError: If a number of the config is out of its range.
    """
    validate(config)
    schedule = config.schedule
    if config.iterations is None:
        return config
    factor = config.iterations / schedule.num_iterations
    # What is 0 stays 0, what is positive stays positive; the longest stage absorbs the rounding.
    values: dict[str, Any] = {
        name: value if value is None else max(min(value, 1), round(value * factor))
        for name, value in dataclasses.asdict(schedule).items()
    }
    values["warmup"], values["fit_motion"] = schedule.warmup, schedule.fit_motion  # as many steps in a short run
    values["reset_every"] = max(values["reset_every"], min(schedule.reset_every, 100))  # so that opacities recover
    stages = ("pretrain", "stage1", "stage2")
    longest = max(stages, key=values.__getitem__)
    values[longest] += config.iterations - sum(values[name] for name in stages)
    return dataclasses.replace(config, schedule=Schedule(**values), iterations=None)
