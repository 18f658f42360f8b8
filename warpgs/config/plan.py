"""What runs: a config whose values are all known."""

import dataclasses
from dataclasses import dataclass, field
from typing import Literal

from .options import TrainConfig

Device = Literal["cuda", "cpu"]
"""Type of device."""

Color = tuple[float, float, float]
"""Red, green and blue in [0, 1]."""

Background = Literal["black", "white", "sky"] | Color
"""What is behind all Gaussians: a colour, or learned colours by direction."""


@dataclass(frozen=True)
class Plan(TrainConfig):
    """What runs: a config, with the values that depend on the capture and on the machine, and a rescaled schedule.

    ``initialization.plan.make_plan`` makes it for a new run; ``runs.config_file`` reads it for one that was begun. It
    can be used as a config. What needs a value that was looked up takes a plan, and no config.

    Attributes:
        branches_in_stage2: Whether stage II compares the images of the single branches.
        means_in_views: Whether ``optim.means`` is in view sizes, not in scene units: as ``densify.unit`` says, but for
            runs of version 0.3.
    """

    iterations: None = None
    assume: Literal["masks", "static", "dynamic"] = "masks"
    device: Device = field(kw_only=True)
    background: Background = field(kw_only=True)
    branches_in_stage2: bool = field(kw_only=True)
    means_in_views: bool = field(kw_only=True)

    @staticmethod
    def of(config: TrainConfig, device: Device, background: Background, branches_in_stage2: bool) -> "Plan":
        """The plan of a config whose schedule is rescaled already."""
        values = {name.name: getattr(config, name.name) for name in dataclasses.fields(TrainConfig)}
        values |= {"device": device, "background": background, "iterations": None, "assume": config.assumption}
        in_views = config.densify.unit == "pixel"
        return Plan(**values, branches_in_stage2=branches_in_stage2, means_in_views=in_views)

    def means_unit(self, view_size: float) -> float:
        """See ``TrainConfig.means_unit``."""
        return view_size if self.means_in_views else 1.0


def extended(plan: Plan, iterations: int | None) -> Plan:
    """The plan of a run whose last stage is longer, so that the run takes ``iterations`` in total.

    Learning rates that decay over the run decay over the longer one: they rise where the run is continued.

    Args:
        plan: Plan of the run.
        iterations: Total iterations; the plan stays as it is if None.

    Raises:
        ValueError: If that is less than the run has.
    """
    schedule = plan.schedule
    total = schedule.num_iterations
    if iterations is None:
        return plan
    if iterations < total:
        raise ValueError(f"--resume with --iterations extends a run: expected at least its {total}, got {iterations}")
    last = "stage2" if schedule.stage2 else "stage1"
    longer = dataclasses.replace(schedule, **{last: getattr(schedule, last) + iterations - total})
    return dataclasses.replace(plan, schedule=longer)
