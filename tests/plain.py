"""Configs without the remedies of the presets: a test turns on those that it is about."""

from dataclasses import replace
from functools import partial

from warpgs.config import DensifyConfig, LossConfig, ModelConfig, OptimConfig, Plan, Schedule, TrainConfig

model = partial(
    replace,
    ModelConfig(
        position_bands=10,
        time_bands=10,
        min_period=0.0,
        appearance_depth=None,
        appearance_width=None,
        sh_degree=1,
        dropout=0.0,
    ),
)
loss = partial(
    replace,
    LossConfig(
        squared=0.0,
        acceleration=0.0,
        hidden_appearance=True,
        depth=2.0,
        depth_dynamic=1.0,
        branches_in_stage2="yes",
        depth_tolerance=0.0,
        depth_margin=0.0,
        depth_smooth=False,
        object_depth=False,
        mask_margin=0.0,
    ),
)
optim = partial(replace, OptimConfig(means=1.6e-4, poses=0.0))
densify = partial(replace, DensifyConfig(gradient=2e-4, max_elongation=0.0, min_pixels=0, reseed=0.0, weakest=0.0))
schedule = partial(
    replace,
    Schedule(
        pretrain=2_000,
        stage1=30_000,
        stage2=40_000,
        densify_from=500,
        densify_until=15_000,
        reset_every=3_000,
        prune_every=5_000,
        fit_motion=0,
        deform_from=3_000,
        joint_from=None,
        warmup=1_000,
        noise_until=20_000,
        settle=0,
        sh_degree_every=1_000,
    ),
)
config = partial(
    replace,
    TrainConfig(
        preset=None,
        try_masks=False,
        background="capture",
        static_geometry=False,
        static_appearance=False,
        exposure=False,
        antialias=False,
        checkpoint_every=5_000,
        model=model(),
        loss=loss(),
        optim=optim(),
        densify=densify(),
        schedule=schedule(),
    ),
)


def plan(config: TrainConfig) -> Plan:
    """The plan of a config, on the CPU, over black unless it names a colour."""
    background = "black" if config.background in ("capture", "mean") else config.background
    return Plan.of(config, "cpu", background, config.loss.branches_in_stage2 != "no")
