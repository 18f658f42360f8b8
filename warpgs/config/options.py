"""All options and their defaults. Imports neither torch nor NumPy, so that ``--help`` is fast."""

import dataclasses
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from .bounds import Bounds, check_bounds

NetName = Literal["vgg", "alex", "squeeze"]
"""Networks of LPIPS."""

ALPHA_BOUNDS = Bounds(positive=True, max=0.9998)
"""Range of ``max_alpha``: a Gaussian with an alpha of 0.9999 would end a pixel instead of contributing to it."""


@dataclass(frozen=True)
class RenderSettings:
    """What a render computes in addition to the joint image.

    Attributes:
        branches: Also render the static and the dynamic Gaussians alone, from the same sorted lists.
        depth: Also render depth, as one more channel.
        statistics: Also compute whether and how much each Gaussian contributed to the joint image.
        absgrad: The gradient of ``screen_offsets`` is the sum of its absolute values over the pixels (AbsGS).
        imagegrad: The gradient of ``screen_offsets`` is that of the images alone, without depth; not with absgrad.
        antialias: Compensate opacities for the low-pass filter (Mip-Splatting).
        max_alpha: Maximum alpha of a Gaussian in a pixel: 0.999 as in gsplat; 0.99 in 3DGS.
        near: Near plane [scene units].
        max_intersections: Size of the buffers for intersections of Gaussians with tiles; learned if None.
    """

    branches: bool = False
    depth: bool = False
    statistics: bool = False
    absgrad: bool = False
    imagegrad: bool = False
    antialias: bool = False
    max_alpha: float = 0.999
    near: float = 0.01
    max_intersections: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.near < math.inf:
            raise ValueError(f"near must be positive and finite, got {self.near}")
        ALPHA_BOUNDS.check("max_alpha", self.max_alpha)
        if self.absgrad and self.imagegrad:
            raise ValueError("expected absgrad or imagegrad, got both: both are the gradient of screen_offsets")
        if self.max_intersections is not None and not 0 < self.max_intersections < 1 << 30:
            raise ValueError(f"max_intersections must be between 1 and 2^30, got {self.max_intersections}")


@dataclass(frozen=True)
class ModelConfig:
    """Sizes of the two networks and of the initial Gaussians."""

    position_bands: Annotated[int, Bounds(max=64)] = 10
    """Number of frequencies L in the encoding of positions (paper Eq. 6)."""
    time_bands: Annotated[int, Bounds(max=64)] = 10
    """Number of frequencies L in the encoding of time: 10 for real captures, 6 for synthetic ones (paper Eq. 6)."""
    raw_input: bool = True
    """Whether the networks get position and time beside their encodings, as in Deformable-3DGS; not in paper Eq. 6."""
    min_period: float = 0.0
    """Minimum period of the frequencies in the encoding of time [training frames]; higher frequencies overfit and are
    dropped. 0: all are kept (paper)."""
    depth: Annotated[int, Bounds(min=1, max=64)] = 8
    """Number of hidden layers of each network."""
    width: Annotated[int, Bounds(min=1, max=4096)] = 256
    """Number of units per hidden layer."""
    appearance_depth: Annotated[int | None, Bounds(min=1, max=64)] = None
    """Number of hidden layers of the appearance network; as ``depth`` if None."""
    appearance_width: Annotated[int | None, Bounds(min=1, max=4096)] = None
    """Number of units per hidden layer of the appearance network; that of both networks if None."""
    skip: int = 4
    """Hidden layer after which the encoding is concatenated again (5 in Deformable-3DGS), unless it is the last one."""
    deformation: str = "mlp"
    """Deformation model, a key of FIELDS in warpgs/model/fields.py; "splines" takes the place of "mlp" on tracks."""
    paths: Annotated[int, Bounds(min=1, max=4096)] = 1
    """Number of splines of the deformation model "splines"; training sets it to the number of objects."""
    path_points: Annotated[int, Bounds(min=4, max=65_536)] = 4
    """Number of control points of each spline of the deformation model "splines"; training sets it by the number of
    frames."""
    sh_degree: int = 1
    """Maximum degree of spherical harmonics."""
    appearance_degree: int = 0
    """Maximum degree of spherical harmonics that the appearance network changes."""
    appearance_opacity: bool = False
    """Whether the appearance network also changes opacities (paper Eq. 8). Off by default: with one camera at a time
    it fits shadows by fading Gaussians at wrong depths in and out."""
    half: bool = True
    """On CUDA, multiply the networks' matrices in half precision and sum in single; only if 8 divides ``width``."""
    max_static_points: int = 100_000
    """Maximum number of initial static Gaussians."""
    point_colors: Literal["capture", "grey"] = "capture"
    """Initial colours of Gaussians at the sparse points: those of the points, or without any the mean of the pixels
    that show them (capture), or mid-grey within 0.0011, as Deformable-3DGS starts captures in the layouts of NeRF-DS
    and HyperNeRF (grey)."""
    bound_sizes: bool = True
    """Whether initial sizes, which are distances to neighbours, are between 1/1000 and 10 times their median, and those
    of dynamic Gaussians of unknown depth under ``densify.max_size``; 3DGS has no such bounds."""
    dynamic_points: int = 20_000
    """Number of initial dynamic Gaussians."""
    tracks: bool = True
    """Whether small objects that move far between frames start on tracks (docs/design/tracks.md)."""
    dynamic_start: Literal["points", "uniform"] = "points"
    """Where dynamic Gaussians start if their depth is unknown: in front of the sparse points around them, or uniformly
    in the scene's box, as in the code of the paper's authors; the paper names no start."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the loss terms (paper Eq. 9, 12, 14, 15)."""

    ssim: float = 0.2
    """λ_ssim, the weight of 1 − SSIM next to L1 in every image term."""
    static: float = 1.0
    """Weight of the static image in the static region (Eq. 9)."""
    dynamic: float = 1.0
    """Weight of the dynamic image against the masked ground truth (Eq. 12)."""
    joint: float = 1.0
    """Weight of the joint image against the whole ground truth, in stage II and from ``schedule.joint_from`` on."""
    dynamic_background: Literal["black", "random"] = "random"
    """Background of the dynamic image unless ``background`` is white: black (paper), or random, hiding no Gaussian."""
    depth: float = 2.0
    """Initial λ_depth, the weight of the static image's depth in the static region (Eq. 14)."""
    depth_dynamic: float = 1.0
    """Weight of the dynamic image's depth in the dynamic region, relative to λ_depth; 0 in the paper."""
    depth_end: float = 0.2
    """Final λ_depth; it decays exponentially."""
    depth_gate: bool = True
    """Whether depth is compared only where the rendered opacity exceeds a half; paper Eq. 14 compares it everywhere."""
    branches_in_stage2: Literal["yes", "no", "given-masks"] = "yes"
    """Whether stage II keeps the terms of the single branches (Eq. 9, 12, 14) beside the joint image, as Eq. 15 does,
    or compares that image alone, as the authors' code does; given-masks: keeps them unless `prepare` made the masks."""
    depth_tolerance: float = 0.0
    """Relative error of a view's aligned depth at the sparse points at which its weight is halved: λ_depth is divided
    by 1 + (error / tolerance)², and depth hardly better than a constant is not used. 0: equal weights (paper)."""
    depth_margin: float = 0.0
    """Errors of the static depth up to this many times the relative error of the view's aligned depth at the sparse
    points are not penalized, because the images determine the geometry better. 0: every error is (paper)."""
    depth_smooth: bool = False
    """Whether aligned depth is also multiplied by a smooth factor per view that brings it to the sparse points."""
    object_depth: bool = False
    """Whether dynamic objects of unknown depth get one by their size (docs/design/object-depth.md)."""
    mask_margin: Annotated[float, Bounds(max=1)] = 0.0
    """Half width of the band along borders of masks in which the dynamic image is not compared, as a fraction of the
    image's larger side; 0 in the paper. Masks are a few pixels off: a rim of background would be learned as moving."""


@dataclass(frozen=True)
class OptimConfig:
    """Learning rates of Adam; those of Deformable-3DGS where the paper names none."""

    means: float = 1.6e-4
    """Positions, times ``means_scale``; decays exponentially to 1 %."""
    means_scale: Annotated[float | None, Bounds(positive=True)] = None
    """Factor of the rate of positions: the extent of the capture if None (3DGS), 5 in Deformable-3DGS, which the paper
    builds upon: 8e-4 is also the rate that it prints (section Experimental Setup)."""
    means_anneal: Literal["run", "trained"] = "run"
    """Iterations over which the rate of positions decays: the whole run, or those in which a branch's positions are
    trained: static ones until stage II (paper, section Static Component), dynamic ones from stage I."""
    quats: float = 1e-3
    """Rotations."""
    scales: float = 5e-3
    """Logarithms of the scales."""
    opacities: float = 0.05
    """Logits of the opacities."""
    sh_dc: float = 2.5e-3
    """Spherical harmonics of degree 0."""
    sh_rest: float = 1.25e-4
    """Spherical harmonics of higher degrees."""
    poses: float = 0.0
    """Initial rate of the corrections of camera poses [rad, and fractions of the extent]; decays exponentially to 1 %.
    0: cameras stay as the capture has them (paper)."""
    networks: Annotated[float, Bounds(positive=True)] = 8e-4
    """Initial rate of both networks (paper, training protocol)."""
    networks_end: Annotated[float, Bounds(positive=True)] = 1.6e-6
    """Final rate of both networks; it decays exponentially while they are trained."""


@dataclass(frozen=True)
class DensifyConfig:
    """When Gaussians are cloned, split and removed (3DGS, section 5)."""

    every: Annotated[int, Bounds(min=1)] = 100
    """Iterations between densifications; ``--iterations`` does not rescale it, because it is a sample size."""
    gradient: float = 2e-4
    """Mean screen-space gradient norm above which a Gaussian is cloned or split."""
    depth_gradients: bool = True
    """Whether that gradient includes the terms of depth, or those of images alone (paper)."""
    dense_fraction: float = 0.01
    """Size above which a Gaussian is split instead of cloned, as a fraction of the extent."""
    min_opacity: float = 0.005
    """Opacity below which a Gaussian is removed."""
    max_size: float = 0.1
    """Size above which a Gaussian is removed once opacities have been reset, as a fraction of the extent."""
    max_gaussians: int = 3_000_000
    """Maximum number of Gaussians up to which both branches together grow."""
    min_pixels: int = 0
    """Minimum number of training pixels per Gaussian: densification stops where there are fewer. 0: no limit."""
    visibility: float = 3e-4
    """τ: static Gaussians with a lower visibility (paper Eq. 15) are removed."""
    reseed: Annotated[float, Bounds(max=1)] = 0.0
    """Fraction of the training views' dynamic pixels. If at least so many show no dynamic Gaussian, new ones start at
    the next pruning during densification. 0: never."""
    weakest: Annotated[float, Bounds(max=0.99)] = 0.0
    """Each pruning after the end of densification also removes the Gaussians that contribute least to the training
    views: those that together hold this fraction of all blend weights. 0: none."""


@dataclass(frozen=True)
class Schedule:
    """Everything that is counted in iterations; ``--iterations`` rescales all of it but ``fit_motion`` and ``warmup``.

    Except for the lengths of the stages and ``realign_at``, iterations count from the start of stage I.
    """

    pretrain: int = 2_000
    """Length of the depth-aware pretraining."""
    stage1: int = 30_000
    """Length of stage I, in which each branch has its own losses."""
    stage2: int = 40_000
    """Length of stage II, the joint optimization."""
    realign_at: int = 1_000
    """Iteration of the pretraining at which monocular depth is aligned again, to the rendered depth."""
    densify_from: int = 500
    """Iteration from which Gaussians are densified."""
    densify_until: int = 15_000
    """Iteration until which Gaussians are densified."""
    reset_every: Annotated[int, Bounds(min=1)] = 3_000
    """Iterations between opacity resets during densification; rescaling shortens it to 100 at least."""
    prune_every: Annotated[int, Bounds(min=1)] = 5_000
    """Iterations between visibility-driven prunings, in stage I."""
    fit_motion: int = 0
    """Steps that fit the deformation to dynamic points of known depth before stage I; 0: none (paper)."""
    deform_from: int = 3_000
    """Iteration from which dynamic Gaussians are deformed; 0 where the deformation was fitted to points."""
    appearance_from: int | None = 0
    """Iteration from which the appearance network changes static Gaussians; in stage II alone if None (paper, section
    Training Protocol). By then moving shadows have become Gaussians at wrong depths (docs/method.md)."""
    joint_from: int | None = None
    """Iteration of stage I from which the joint image is compared; in stage II alone if None (paper)."""
    warmup: int = 1_000
    """Iterations over which a network's learning rate rises once it is in use, whatever the length of the run. With the
    full rate, Adam's first steps would leave ReLU units inactive forever and move the Gaussians of an object away."""
    noise_until: int = 20_000
    """Iteration at which the noise on time has decayed to 0."""
    sh_degree_every: Annotated[int, Bounds(min=1)] = 1_000
    """Iterations between increments of the degree of spherical harmonics, from 0 to ``model.sh_degree``."""

    @property
    def num_iterations(self) -> int:
        """Iterations of the whole run."""
        return self.pretrain + self.stage1 + self.stage2


@dataclass(frozen=True)
class MaskPerturbation:
    """Deliberate damage to the training masks (paper, robustness); evaluation always uses the true masks."""

    erode: int = 0
    """Erode the dynamic region by this many pixels."""
    dilate: int = 0
    """Dilate the dynamic region by this many pixels."""
    holes: float = 0.0
    """Fraction of the dynamic region to remove as random holes, in [0, 1)."""


@dataclass(frozen=True)
class TrainConfig:
    """Trains SplitGaussian on a capture, or on the built-in scene if no capture is given."""

    data: Path | None = None
    """Folder of the capture, or builtin:studio (docs/cluster.md) or builtin:balls; the built-in scene if omitted."""
    dataset: str | None = None
    """Layout of the capture: nerfds, hypernerf, iphone, nerfstudio, blender (D-NeRF), llff (NVIDIA), colmap, vipe or
    megasam; recognized from its files if omitted."""
    factor: Annotated[int | None, Bounds(min=1, max=1024)] = None
    """Downscaling factor of the images (folder rgb/<factor>x); the dataset's default if omitted."""
    vrig_factor: Annotated[int | None, Bounds(min=1, max=1024)] = None
    """Downscaling factor of the images of HyperNeRF's captures of two cameras (vrig), if ``factor`` is omitted;
    Deformable-3DGS reads them at 4."""
    undistort: bool = True
    """Undistort frames, masks and depth, and keep each camera's principal point. Without it the run is trained and
    evaluated on frames as they are, with pinhole cameras whose principal point is the centre, as in Deformable-3DGS
    (paper)."""
    out: Path | None = None
    """Run folder; runs/<capture>-<preset> if omitted, with the suffix -2, -3 … if that exists."""
    resume: Path | None = None
    """Run folder to continue from its newest checkpoint; a larger --iterations extends it."""
    preset: Literal["paper", "best", "patient", "quick"] | None = None
    """Defaults of everything below: best (one GPU, minutes), paper (as published, 72k iterations; docs/method.md),
    patient (two CPU cores, 20 minutes), quick (two CPU cores, minutes). On the command line the default is best for a
    capture and quick for the built-in scene; in Python it is none."""
    iterations: Annotated[int | None, Bounds(min=3)] = None
    """Total iterations; every schedule is rescaled to it."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to train on; CUDA if there is a GPU."""
    seed: int = 0
    """Seed of all random numbers."""
    depth: bool = True
    """Use the capture's depth; without it there is no pretraining, no depth loss, and no depth to start from."""
    dap: bool = True
    """Depth-aware pretraining; without it, its iterations are added to stage I, and depth is still compared there."""
    vdp: bool = True
    """Visibility-driven pruning."""
    app: bool = True
    """Appearance network of the static Gaussians, from ``schedule.appearance_from`` on."""
    stage2: bool = True
    """Joint optimization; without it, its iterations are added to stage I."""
    assume: Literal["masks", "static", "dynamic"] = "masks"
    """What moves: what the masks mark, nothing (static), or everything (dynamic)."""
    try_masks: bool = False
    """Try out masks that `prepare` made in two short trainings, with them and without, before runs that are longer, and
    take everything as dynamic if held-out frames are better without."""
    background: Literal["capture", "black", "white"] = "capture"
    """Colour behind all Gaussians; that of the capture is white if D-NeRF's images have alpha, else black."""
    static_geometry: bool = False
    """Whether stage II still optimizes positions, scales and rotations of static Gaussians."""
    static_appearance: bool = False
    """Whether stage II still optimizes w⁰, the appearance to which residuals are added."""
    exposure: bool = False
    """Divide jumps of exposure and white balance between frames out of the training images."""
    antialias: bool = False
    """Compensate opacities for the low-pass filter (Mip-Splatting)."""
    max_alpha: Annotated[float, ALPHA_BOUNDS] = RenderSettings.max_alpha
    """Maximum alpha of a Gaussian in a pixel: 0.999 as in gsplat; 0.99 in 3DGS (paper)."""
    graph: bool = True
    """On CUDA, replay iterations and the steps of ``schedule.fit_motion`` as CUDA graphs."""
    masks: MaskPerturbation = field(default_factory=MaskPerturbation)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    densify: DensifyConfig = field(default_factory=DensifyConfig)
    schedule: Schedule = field(default_factory=Schedule)
    checkpoint_every: Annotated[int, Bounds(min=1)] = 5_000
    """Iterations between checkpoints."""
    keep_checkpoints: Annotated[int, Bounds(min=1)] = 2
    """Number of newest checkpoints to keep."""
    resident_bytes: int = 4 << 30
    """Maximum memory for training views on the device [bytes]; larger captures are decoded once into a file in
    the user's cache and read from there."""
    lpips: Path | None = None
    """Folder with the weights of LPIPS, for the evaluation at the end."""
    lpips_net: NetName = "vgg"
    """Network of LPIPS: vgg (3DGS), alex (DyCheck's mLPIPS) or squeeze."""
    as_taken: bool = False
    """Whether the evaluation at the end compares frames as they were taken, with the distortion of their lens."""

    @property
    def render_settings(self) -> RenderSettings:
        """How all images of the run are rendered."""
        return RenderSettings(antialias=self.antialias, max_alpha=self.max_alpha)


def validate(config: TrainConfig) -> None:
    """Refuses numbers with which training would fail later.

    Raises:
        ValueError: If a number is out of its range; the message names it.
    """
    check_bounds("", config)
    model, schedule = config.model, config.schedule
    if not model.appearance_degree <= model.sh_degree <= 3:
        raise ValueError(
            "expected model.appearance_degree <= model.sh_degree <= 3, "
            f"got {model.appearance_degree} and {model.sh_degree}"
        )
    if not model.raw_input and 0 in (model.position_bands, model.time_bands):
        raise ValueError(
            "without model.raw_input the networks need model.position_bands and model.time_bands of at least 1, "
            f"got {model.position_bands} and {model.time_bands}"
        )
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
