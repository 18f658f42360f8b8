"""Configs without the remedies of the presets: a test turns on those that it is about.

They are the preset paper, but for values at which tests are quick, and those of ``best`` that most tests are about.
"""

from dataclasses import replace
from functools import partial

from warpgs.config import Plan, TrainConfig
from warpgs.config.presets import PAPER
from warpgs.training.schedule import Phase

model = partial(
    replace,
    replace(
        PAPER.model,
        raw_input=True,
        skip=4,
        sh_degree=1,
        appearance="color",
        dynamic_points=20_000,
        tracks=True,
    ),
)
loss = partial(replace, replace(PAPER.loss, depth=2.0, depth_dynamic=1.0, depth_end=0.2))
optim = partial(replace, replace(PAPER.optim, means=1.6e-4, means_anneal="run"))
densify = partial(replace, replace(PAPER.densify, unit="pixel"))
schedule = partial(
    replace, replace(PAPER.schedule, densify_from=500, densify_until=15_000, appearance_from=0, warmup=1_000)
)
config = partial(
    replace,
    replace(
        PAPER,
        preset=None,
        distortion=True,
        max_alpha=0.999,
        model=model(),
        loss=loss(),
        optim=optim(),
        densify=densify(),
        schedule=schedule(),
    ),
)
phase = partial(
    replace,
    Phase(
        "stage1",
        use_deformation=True,
        use_appearance=True,
        sh_degree=1,
        with_depth=False,
        with_branches=True,
        with_joint=True,
        use_dropout=False,
        densifies=False,
    ),
)


def plan(config: TrainConfig) -> Plan:
    """The plan of a config, on the CPU, over black unless it names a colour."""
    background = "black" if config.background in ("auto", "capture", "mean") else config.background
    return Plan.of(config, "cpu", background, config.loss.branches_in_stage2 != "no")
