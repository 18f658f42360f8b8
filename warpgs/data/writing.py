"""Files of a capture; errors name the file, which those of a full disk don't do by themselves."""

import io
import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt


def write_png(path: Path, image: UInt[np.ndarray, "H W"] | UInt[np.ndarray, "H W 3"]) -> None:
    """Writes grey levels or RGB, and makes the folders above.

    Raises:
        OSError: If it can't be written.
    """
    _, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    _write(path, data.tobytes())


def write_json(path: Path, values: object) -> None:
    """Writes values as JSON, and makes the folders above.

    Raises:
        OSError: If it can't be written.
    """
    _write(path, json.dumps(values).encode())


def write_array(path: Path, values: Shaped[np.ndarray, "..."]) -> None:
    """Writes an array as .npy, and makes the folders above.

    Raises:
        OSError: If it can't be written.
    """
    data = io.BytesIO()  # numpy's own writing to a file forgets why it failed
    np.save(data, values)
    _write(path, data.getvalue())


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise OSError(f"{path} could not be written: {error.strerror or error}") from error
