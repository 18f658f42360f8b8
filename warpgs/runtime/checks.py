"""Input checks of the public functions, with readable messages."""

import math
import operator
import reprlib
from collections.abc import Mapping
from numbers import Real
from typing import Any, SupportsIndex

import numpy as np
import torch
from torch import Tensor


def check_tensor(
    name: str,
    value: object,
    shape: tuple[int | str, ...],
    sizes: dict[str, int],
    dtypes: tuple[torch.dtype, ...] = (torch.float32,),
) -> None:
    """Raises ``ValueError`` unless ``value`` is a contiguous tensor of a shape and dtype.

    Args:
        name: Name of the tensor in messages.
        shape: The size of each axis: a number, or a name that stands for the same size wherever it occurs.
        sizes: Known sizes by name; extended by those of this tensor.
        dtypes: The allowed types.
    """
    if not isinstance(value, Tensor):
        raise ValueError(f"{name} must be a torch tensor of shape {_text(shape)}, got {type(value).__name__}")
    if value.ndim != len(shape):
        raise ValueError(f"{name} must have shape {_text(shape)}, got {list(value.shape)}")
    for want, got in zip(shape, value.shape, strict=True):
        if isinstance(want, str):
            known = sizes.setdefault(want, got)
            if known != got:
                wanted = f"{_text(shape)} with {want} = {known}"
                raise ValueError(f"{name} must have shape {wanted}, got {list(value.shape)}")
        elif want != got:
            raise ValueError(f"{name} must have shape {_text(shape)}, got {list(value.shape)}")
    if value.dtype not in dtypes:
        raise ValueError(f"{name} must be {' or '.join(str(d) for d in dtypes)}, got {value.dtype}")
    if not value.is_contiguous():
        raise ValueError(f"{name} must be contiguous in memory; call .contiguous() on it")


def _text(shape: tuple[int | str, ...]) -> str:
    return "[" + ", ".join(str(size) for size in shape) + "]"


def check_same_device(tensors: Mapping[str, Tensor | None]) -> None:
    """Raises ``ValueError`` unless all tensors are on the same CPU or CUDA device."""
    first_name, first = "", None
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        device = tensor.device
        if first is None:
            first_name, first = name, device
            if not (tensor.is_cuda or tensor.is_cpu):
                raise ValueError(f"{first_name} must be on a CPU or CUDA device, got {first}")
        elif device != first:
            raise ValueError(f"all tensors must be on one device: {first_name} is on {first}, {name} on {device}")


def as_number(name: str, value: Any) -> float:
    """A number of Python, NumPy or torch, also as an array or tensor of one element, as one of Python.

    Raises:
        ValueError: If it is something else, such as a text or a bool.
    """
    number = value.item() if isinstance(value, Tensor | np.ndarray) and math.prod(value.shape) == 1 else value
    if isinstance(number, bool) or not isinstance(number, Real):
        raise ValueError(f"{name} must be a number, got {one_line_repr(value)}")
    try:
        return float(number)
    except OverflowError as error:  # an integer of hundreds of digits
        raise ValueError(f"{name} must be a number, got {one_line_repr(value)}") from error


def one_line_repr(value: object) -> str:
    """A short text for any value: those of tensors have several lines."""
    return " ".join(reprlib.repr(value).split())


def as_whole_number(value: object) -> object:
    """An integer of NumPy or torch as one of Python; everything else as it is."""
    if isinstance(value, bool) or not isinstance(value, SupportsIndex):
        return value
    try:
        return operator.index(value)
    except TypeError:  # a tensor that is not a whole number
        return value


def check_image_size(width: int, height: int) -> None:
    """Raises ``ValueError`` unless an image of ``width`` × ``height`` pixels can be rendered."""
    for name, value in (("width", width), ("height", height)):
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"{name} must be an int, got {value!r}")
        if not 0 <= value <= 32768:
            raise ValueError(f"{name} must be between 0 and 32768 pixels, got {value}")
