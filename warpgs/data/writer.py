"""Files of captures, and pictures of runs; errors name the file, which those of a full disk don't do by themselves."""

import io
import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt

from warpgs.files import write_whole


def write_png(path: Path, image: UInt[np.ndarray, "H W"] | UInt[np.ndarray, "H W 3"]) -> None:
    """Writes grey levels or RGB, and makes the folders above.

    Raises:
        OSError: If it can't be written; the message names the file.
    """
    whole, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not whole:
        raise OSError(f"{path} could not be encoded")
    write_whole(path, [data.tobytes()])


def write_json(path: Path, values: object) -> None:
    """Writes values as JSON, and makes the folders above.

    Raises:
        OSError: If it can't be written.
    """
    write_whole(path, [json.dumps(values).encode()])


def write_array(path: Path, values: Shaped[np.ndarray, "..."]) -> None:
    """Writes an array as .npy, and makes the folders above.

    Raises:
        OSError: If it can't be written.
    """
    data = io.BytesIO()  # numpy's own writing to a file forgets why it failed
    np.save(data, values)
    write_whole(path, [data.getvalue()])
