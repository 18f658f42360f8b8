"""The device to train and to render on."""

import torch

from warpgs.config import Device


def choose_device(asked: Device | None = None) -> Device:
    """The device that was asked for; CUDA if none was and there is a GPU, else the CPU.

    Raises:
        ValueError: If CUDA was asked for and torch finds no GPU.
    """
    if asked == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda was asked for, but torch sees no CUDA device; use --device cpu")
    return asked or ("cuda" if torch.cuda.is_available() else "cpu")
