"""Density control: where Gaussians are added and removed, one file per strategy.

To add one, write its class in a new file, add a line to ``DENSITY`` and a test; ``--densify.strategy`` selects it.
"""

from warpgs.config import DensifyConfig
from warpgs.errors import suggestion

from .absgrad import AbsoluteGradientStrategy
from .gradient import GradientStrategy
from .strategy import Strategy

DENSITY: dict[str, type[Strategy]] = {
    "3dgs": GradientStrategy,
    "absgrad": AbsoluteGradientStrategy,
}
"""Strategies by name, each constructed from a ``DensifyConfig``."""


def make_strategy(config: DensifyConfig) -> Strategy:
    """The strategy that ``config.strategy`` names.

    Raises:
        ValueError: If there is none of this name.
    """
    if config.strategy not in DENSITY:
        known = ", ".join(sorted(DENSITY)) + suggestion(config.strategy, DENSITY)
        raise ValueError(f"there is no density strategy {config.strategy!r}; densify.strategy is one of: {known}")
    return DENSITY[config.strategy](config)
