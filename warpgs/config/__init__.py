"""All options and their defaults; their bounds and the presets are in modules of their own.

Imports neither torch nor NumPy, so that ``--help`` is fast.
"""

from .densify import DensifyConfig
from .fields import fields
from .loss import LossConfig
from .masks import MaskPerturbation
from .model import ModelConfig
from .optim import OptimConfig
from .options import NetName, TrainConfig, scaled, validate
from .plan import Background, Color, Device, Plan, extended
from .render_settings import RenderSettings
from .schedule import Schedule

__all__ = [
    "Background",
    "Color",
    "DensifyConfig",
    "Device",
    "LossConfig",
    "MaskPerturbation",
    "ModelConfig",
    "NetName",
    "OptimConfig",
    "Plan",
    "RenderSettings",
    "Schedule",
    "TrainConfig",
    "extended",
    "fields",
    "scaled",
    "validate",
]
