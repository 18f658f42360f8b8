"""Numbers of other methods, from a JSON file: ``--compare peers.json``.

    {"Deformable-3DGS": {"studio": {"psnr": 25.8, "ssim": [0.826, 0.002]}, "mean": {"psnr": 24.1}}}

by method, capture and metric of metrics.json; a pair is mean and standard deviation. "mean" stands for the mean over
captures; without it, that is computed where a method has numbers of every capture.
"""

import reprlib
from pathlib import Path
from typing import Any

from warpgs.config.bounds import MAX_VALUE
from warpgs.files import read_json

from .table import Statistic, columns

MAX_BYTES = 1 << 20


def read_peers(path: Path) -> dict[str, dict[str, dict[str, Statistic]]]:
    """Numbers by method, capture and metric.

    Raises:
        ValueError: If the file is missing, damaged or has unknown metrics; the message names it.
    """
    values = read_json(path, "numbers of other methods, by method, capture and metric", MAX_BYTES)
    return {
        method: {
            scene: {key: _statistic(f"{path}: {method}, {scene}", key, value) for key, value in metrics.items()}
            for scene, metrics in _table(f"{path}: {method}", scenes).items()
            if _table(f"{path}: {method}, {scene}", metrics)
        }
        for method, scenes in values.items()
    }


def _table(where: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where} must be an object, got {reprlib.repr(value)}")
    return value


def _statistic(where: str, key: str, value: Any) -> Statistic:
    if key not in (known := columns()):
        raise ValueError(f"{where}: there is no metric {key:.60}, expected {', '.join(known)}")
    numbers = value if isinstance(value, list) else [value]
    valid = all(isinstance(n, int | float) and not isinstance(n, bool) and abs(n) <= MAX_VALUE for n in numbers)
    if not valid or len(numbers) not in (1, 2):
        raise ValueError(f"{where}: {key} must be a number or [mean, standard deviation], got {reprlib.repr(value)}")
    return Statistic(float(numbers[0]), float(numbers[1]) if len(numbers) == 2 else None)
