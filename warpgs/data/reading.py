"""Reading JSON and arrays: damage is told in one line that names the file."""

from pathlib import Path
from tokenize import TokenError

import numpy as np


def read_bytes(path: Path, hint: str = "") -> bytes:
    """What a file holds.

    Args:
        path: The file.
        hint: Why it is wanted, for the message when it is missing.

    Raises:
        ValueError: If it is missing or can't be read.
    """
    try:
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ValueError(f"{path} is missing{': ' + hint if hint else ''}") from error
    except OSError as error:
        raise ValueError(f"{path} can't be read: {error.strerror}") from error


def read_array(path: Path, most: int) -> np.ndarray:
    """A numeric .npy file of at most ``most`` values; never unpickles.

    Raises:
        ValueError: If it is missing, truncated, larger, or not of numbers.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # what the header claims is not allocated
    except FileNotFoundError as error:
        raise ValueError(f"{path} is missing") from error
    except (ValueError, OSError, EOFError, OverflowError, TypeError, SyntaxError, TokenError) as error:
        raise ValueError(f"{path} is damaged or no .npy file of numbers") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise ValueError(f"{path} must be an .npy file of numbers")
    if array.size > most:
        raise ValueError(f"{path} holds {array.size} numbers, more than {most}")
    return np.array(array)
