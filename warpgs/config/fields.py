"""One walk over all fields of a config."""

import dataclasses
from collections.abc import Iterator
from typing import Any


def fields(config: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Name, type with its metadata, and value of every field of a dataclass, and of those inside it instead of them.

    Args:
        config: The dataclass.
        prefix: Start of the names, which have dots: ``loss.ssim``.
    """
    for field in dataclasses.fields(config):
        name, value = f"{prefix}{field.name}", getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from fields(value, f"{name}.")
        else:
            yield name, field.type, value
