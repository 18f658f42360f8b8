"""Errors as people read them."""

import torch


def one_line(error: BaseException) -> str:
    """What an error says, without its line breaks."""
    return " ".join(str(error).split())


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error is the lack of memory; on the CPU, torch, Warp and OpenCV say so only in words."""
    return isinstance(error, torch.OutOfMemoryError | MemoryError) or "allocate" in str(error)


def out_of_memory(error: BaseException) -> str:
    """What to say of such an error, before any advice."""
    return f"out of memory ({one_line(error)[:200]})"
