"""Defaults of training, by name."""

import dataclasses

from .densify import DensifyConfig
from .loss import LossConfig
from .model import ModelConfig
from .optim import OptimConfig
from .options import TrainConfig
from .schedule import Schedule

PAPER = TrainConfig(
    preset="paper",
    vrig_factor=4,
    undistort=False,
    max_alpha=0.99,
    model=ModelConfig(
        raw_input=False,
        skip=5,
        sh_degree=3,
        appearance_degree=3,
        appearance_opacity=True,
        dynamic_points=100_000,
        dynamic_start="uniform",
        tracks=False,
        point_colors="grey",
        bound_sizes=False,
    ),
    loss=LossConfig(dynamic_background="black", depth=1.0, depth_dynamic=0.0, depth_end=0.01, depth_gate=False),
    optim=OptimConfig(means_scale=5.0, means_anneal="trained"),
    densify=DensifyConfig(unit="extent", split_size=0.01, max_size=0.1),
    schedule=Schedule(densify_from=600, densify_until=14_900, appearance_from=None, warmup=0),
)
"""The paper, and the code that it builds upon where it says nothing; docs/method.md explains every value."""

BEST = TrainConfig(
    preset="best",
    static_geometry=True,
    static_appearance=True,
    exposure=True,
    background="mean",
    antialias=True,
    try_masks=True,
    model=ModelConfig(
        position_bands=6,
        time_bands=6,
        min_period=4.0,
        appearance_depth=4,
        appearance_width=128,
        sh_degree=3,
        dropout=0.1,
    ),
    loss=LossConfig(
        squared=15.0,
        acceleration=0.1,
        hidden_appearance=False,
        dynamic_background="black",
        depth=0.5,
        depth_dynamic=4.0,
        depth_tolerance=0.03,
        depth_margin=3.0,
        depth_smooth=True,
        object_depth=True,
        mask_margin=0.008,
        branches_in_stage2="given-masks",
    ),
    optim=OptimConfig(means=5e-4, poses=5e-5),
    densify=DensifyConfig(gradient=3e-4, max_elongation=10.0, min_pixels=24, weakest=0.01, reseed=0.05),
    schedule=Schedule(
        pretrain=400,
        stage1=7_500,
        stage2=37_500,
        realign_at=200,
        densify_from=100,
        densify_until=4_500,
        reset_every=1_100,
        prune_every=1_500,
        fit_motion=2_000,
        deform_from=400,
        joint_from=0,
        warmup=400,
        noise_until=3_750,
        settle=7_500,
        sh_degree_every=400,
    ),
    checkpoint_every=2_500,
)
"""What real captures need is in docs/design/real-captures.md."""

PATIENT = dataclasses.replace(
    BEST,
    preset="patient",
    model=ModelConfig(
        position_bands=6,
        time_bands=5,
        min_period=4.0,
        depth=3,
        width=64,
        skip=2,
        sh_degree=3,
        max_static_points=8_000,
        dynamic_points=3_000,
    ),
    loss=dataclasses.replace(BEST.loss, ssim=0.0, acceleration=0.02),
    optim=OptimConfig(means=6.5e-4, sh_dc=1e-2, networks=3e-3, networks_end=1e-4),
    densify=DensifyConfig(gradient=2.5e-4, max_gaussians=20_000, min_pixels=8, reseed=0.05),
    schedule=Schedule(
        pretrain=300,
        stage1=2_400,
        stage2=2_300,
        realign_at=150,
        densify_from=100,
        densify_until=1_600,
        reset_every=10_000,
        prune_every=1_000,
        fit_motion=600,
        deform_from=50,
        warmup=100,
        joint_from=0,
        noise_until=800,
        sh_degree_every=400,
    ),
    checkpoint_every=500,
)
"""The networks are small and there is no SSIM, so that two CPU cores do thousands of iterations."""

QUICK = dataclasses.replace(
    PATIENT,
    preset="quick",
    try_masks=False,  # a trial is as long as two trainings of this preset
    model=dataclasses.replace(PATIENT.model, time_bands=4, sh_degree=1, max_static_points=4_000, dynamic_points=1_500),
    densify=dataclasses.replace(PATIENT.densify, gradient=4e-4, max_gaussians=10_000),
    schedule=Schedule(
        pretrain=200,
        stage1=1_000,
        stage2=1_000,
        realign_at=100,
        densify_from=100,
        densify_until=700,
        reset_every=10_000,
        prune_every=500,
        fit_motion=600,
        deform_from=50,
        warmup=100,
        joint_from=0,
        noise_until=400,
        sh_degree_every=400,
    ),
)

PRESETS = {"paper": PAPER, "best": BEST, "patient": PATIENT, "quick": QUICK}
"""Defaults by name."""

FAR = 10.0
"""Factor of the default, above which a learning rate may be why a training diverges."""


def far_rates(config: TrainConfig) -> str:
    """The end of a message on a training that diverged: the rates far above their defaults; empty if none is."""
    default = PRESETS[config.preset].optim if config.preset else TrainConfig().optim
    given, usual = dataclasses.asdict(config.optim), dataclasses.asdict(default)
    far = [
        f"--optim.{name.replace('_', '-')} is {given[name]:g}, by default {value:g}"
        for name, value in usual.items()
        if isinstance(value, float) and value > 0.0 and (given[name] or 0.0) > FAR * value
    ]
    return f"; {', '.join(far)}" if far else ""
