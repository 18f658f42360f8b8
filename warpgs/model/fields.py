"""Deformation models, one file per model.

To add one, write its class in a new file, add a line to ``FIELDS`` and a test; ``--model.deformation`` selects it.
"""

from jaxtyping import Float
from torch import Tensor, nn

from warpgs.config import ModelConfig
from warpgs.errors import suggestion

from .mlp_deformation import MlpDeformation
from .segmented_deformation import SegmentedDeformation
from .spline_deformation import SplineDeformation

FIELDS: dict[str, type[nn.Module]] = {
    "mlp": MlpDeformation,
    "splines": SplineDeformation,
}
"""Deformation models by name.

Each is a ``torch.nn.Module`` that is constructed as ``Model(config, center, half_size)`` from a ``ModelConfig`` and the
[3] box of the scene, and called as ``model(means, time)`` with [N, 3] canonical positions and a [1] time in [0, 1] of
all or [N] times of each. It returns [N, 10] offsets: of positions (3), of rotations as an addition to the unit
quaternion (4), and of log-scales (3). Offsets are 0 at first. Parameters have single precision and are created on the
device of ``center``.
"""


def make_deformation(config: ModelConfig, center: Float[Tensor, "3"], half_size: Float[Tensor, "3"]) -> nn.Module:
    """The deformation model that ``config.deformation`` names; with several segments, one network for each of them.

    Positions are in the box ``center`` ± ``half_size``, [3] each.

    Raises:
        ValueError: If there is no deformation model of this name.
    """
    if config.deformation not in FIELDS:
        known = ", ".join(sorted(FIELDS)) + suggestion(config.deformation, FIELDS)
        raise ValueError(f"there is no deformation model {config.deformation!r}; model.deformation is one of: {known}")
    if (config.segments or 1) > 1:
        return SegmentedDeformation(config, center, half_size)
    return FIELDS[config.deformation](config, center, half_size)
