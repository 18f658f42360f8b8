"""All options and their defaults; their bounds and the presets are in modules of their own."""

from .options import (
    DensifyConfig,
    LossConfig,
    MaskPerturbation,
    ModelConfig,
    NetName,
    OptimConfig,
    RenderSettings,
    Schedule,
    TrainConfig,
    scaled,
    validate,
)

__all__ = [
    "DensifyConfig",
    "LossConfig",
    "MaskPerturbation",
    "ModelConfig",
    "NetName",
    "OptimConfig",
    "RenderSettings",
    "Schedule",
    "TrainConfig",
    "scaled",
    "validate",
]
