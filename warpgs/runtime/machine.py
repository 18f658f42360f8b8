"""What a training runs on, in words: the GPU, its compute capability, and whether kernels are compiled for it."""

import torch
import warp as wp

from warpgs.config import Device
from warpgs.kernels.adam import adam_step
from warpgs.kernels.tiles import tile_ranges

from . import kernel_cache
from .launch import BLOCK_DIM


def described(device: Device) -> str:
    """A device for messages: cpu, or cuda with the GPU in use."""
    if device == "cpu":
        return "cpu"
    major, minor = torch.cuda.get_device_capability()
    return f"cuda ({torch.cuda.get_device_name()}, compute capability {major}.{minor})"


def kernels_note(device: Device) -> str:
    """Whether kernels are compiled for a device.

    On CUDA that of Adam is the last one of a training step. On CPU Adam is torch's, and every image needs tiles.
    """
    alias = "cpu" if device == "cpu" else f"cuda:{torch.cuda.current_device()}"
    kernel = tile_ranges if device == "cpu" else adam_step
    if kernel_cache.is_compiled(kernel, wp.get_device(alias), BLOCK_DIM):
        return f"kernels for it are in {wp.config.kernel_cache_dir}"
    return "kernels for it are compiled at the first start, which takes about a minute"
