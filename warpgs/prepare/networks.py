"""Loads networks of the transformers package and prepares their inputs."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from .weights import Network

MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
"""Mean and standard deviation of ImageNet's RGB values in [0, 1], which both networks' inputs are normalized by."""


def load(network: Network, folder: Path) -> Any:
    """The network with its weights, on the GPU if there is one.

    Raises:
        ValueError: If the weights are damaged or incomplete.
    """
    import transformers

    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)  # problems are reported below
    transformers.utils.logging.disable_progress_bar()
    model_class = getattr(transformers, network.model)
    try:
        model, info = model_class.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # safetensors raises its own exceptions
        raise ValueError(f"{folder}: the weights of {network.title} cannot be read: {error}") from error
    if missing := info["missing_keys"]:
        raise ValueError(
            f"{folder}: {len(missing)} tensors of {network.title} are missing, {sorted(missing)[0]} the first"
        )
    return model.eval().to("cuda" if torch.cuda.is_available() else "cpu")


def normalized(image: UInt8[np.ndarray, "H W 3"], width: int, height: int) -> Float[Tensor, "3 h w"]:
    """[3, h, w] an RGB image, resized and normalized by ImageNet's mean and standard deviation."""
    resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
    values = (resized.astype(np.float32) / 255.0 - MEAN) / DEVIATION
    return torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))
