"""Defaults of training, by name. A preset that is not ``best`` is written as its changes to another one."""

import dataclasses
from dataclasses import replace

from .options import TrainConfig

BEST = TrainConfig()
"""What real captures need is in docs/design/real-captures.md."""

PAPER = replace(
    BEST,
    preset="paper",
    distortion=False,
    assume="masks",
    background="capture",
    frozen="all",
    exposure=False,
    antialias=False,
    max_alpha=0.99,
    model=replace(
        BEST.model,
        position_bands=10,
        time_bands=10,
        raw_input=False,
        min_period=0.0,
        appearance_size=None,
        skip=5,
        appearance="all",
        dynamic_points=100_000,
        segments=1,
        dropout=0.0,
        tracks=False,
    ),
    loss=replace(
        BEST.loss,
        squared=0.0,
        acceleration=0.0,
        hidden_appearance=True,
        depth=1.0,
        depth_dynamic=0.0,
        depth_end=0.01,
        branches_in_stage2="yes",
        depth_tolerance=0.0,
        object_depth=False,
        mask_margin=0.0,
    ),
    optim=replace(BEST.optim, means_anneal="trained", poses=0.0),
    densify=replace(
        BEST.densify,
        gradient=2e-4,
        max_elongation=0.0,
        min_pixels=0,
        reseed=0.0,
        weakest=0.0,
    ),
    schedule=replace(
        BEST.schedule,
        pretrain=2_000,
        stage1=30_000,
        stage2=40_000,
        densify_from=600,
        densify_until=14_900,
        reset_every=3_000,
        prune_every=5_000,
        fit_motion=0,
        deform_from=3_000,
        appearance_from=None,
        joint_from=None,
        warmup=0,
        noise_until=20_000,
        settle=0,
        sh_degree_every=1_000,
    ),
    checkpoint_every=5_000,
)
"""The paper, and the code that it builds upon where it says nothing; docs/method.md explains every value."""

PATIENT = replace(
    BEST,
    preset="patient",
    model=replace(
        BEST.model,
        time_bands=5,
        depth=3,
        width=64,
        appearance_size=None,
        skip=2,
        max_static_points=8_000,
        dynamic_points=3_000,
        dropout=0.0,
    ),
    loss=replace(BEST.loss, ssim=0.0, acceleration=0.02),
    optim=replace(BEST.optim, means=6.5e-4, sh_dc=1e-2, poses=0.0, networks=3e-3, networks_end=1e-4),
    densify=replace(BEST.densify, gradient=2.5e-4, max_elongation=0.0, max_gaussians=20_000, weakest=0.0),
    schedule=replace(
        BEST.schedule,
        pretrain=300,
        stage1=2_400,
        stage2=2_300,
        densify_until=1_600,
        reset_every=10_000,
        prune_every=1_000,
        fit_motion=600,
        deform_from=50,
        warmup=100,
        noise_until=800,
        settle=0,
    ),
    checkpoint_every=500,
)
"""The networks are small and there is no SSIM, so that two CPU cores do thousands of iterations."""

QUICK = replace(
    PATIENT,
    preset="quick",
    assume="masks",  # a trial is as long as two trainings of this preset
    model=replace(PATIENT.model, time_bands=4, sh_degree=1, max_static_points=4_000, dynamic_points=1_500),
    densify=replace(PATIENT.densify, gradient=4e-4, max_gaussians=10_000),
    schedule=replace(
        PATIENT.schedule,
        pretrain=200,
        stage1=1_000,
        stage2=1_000,
        densify_until=700,
        prune_every=500,
        noise_until=400,
    ),
)

PRESETS = {"paper": PAPER, "best": BEST, "patient": PATIENT, "quick": QUICK}
"""Defaults by name."""

FAR = 10.0
"""Factor of the default, above which a learning rate may be why a training diverges."""


def far_rates(config: TrainConfig) -> str:
    """The end of a message on a training that diverged: the rates far above their defaults; empty if none is."""
    default = PRESETS[config.preset or "best"].optim
    given, usual = dataclasses.asdict(config.optim), dataclasses.asdict(default)
    far = [
        f"--optim.{name.replace('_', '-')} is {given[name]:g}, by default {value:g}"
        for name, value in usual.items()
        if isinstance(value, float) and value > 0.0 and (given[name] or 0.0) > FAR * value
    ]
    return f"; {', '.join(far)}" if far else ""
