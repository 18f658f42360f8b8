"""Memory that is not there."""

import torch


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error is the lack of memory; on the CPU, torch, Warp and OpenCV say so only in words."""
    return isinstance(error, torch.OutOfMemoryError | MemoryError) or "allocate" in str(error)
