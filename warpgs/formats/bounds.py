"""Bounds on what compressed files of Gaussians may claim to hold."""

from pathlib import Path

from warpgs.data.archive import MAX_RATIO, MAX_SMALL

MAX_BYTES = 4 << 30
"""Maximum size of a compressed file [bytes]."""


def require_plausible(path: Path, claimed: int, size: int) -> None:
    """Refuses a file that claims to hold far more than its size can.

    Args:
        path: The file.
        claimed: Size of its content, as it says [bytes].
        size: Its own [bytes].

    Raises:
        ValueError: If it claims more than any compression of Gaussians reaches; the message names the file.
    """
    if claimed > max(MAX_SMALL, MAX_RATIO * size):
        raise ValueError(f"{path} is damaged: it claims {claimed:,} bytes of Gaussians in {size:,}")
