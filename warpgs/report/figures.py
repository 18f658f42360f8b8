"""Figures of runs, beside each other."""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

from warpgs.config import PRESETS, TrainConfig

from .record import Record

HIGHER = {
    "psnr",
    "ssim",
    "psnr_static",
    "psnr_dynamic",
    "ssim_static",
    "ssim_dynamic",
    "masked_psnr",
    "masked_ssim",
    "fps",
}
LOWER = {"lpips", "flicker", "train_seconds", "peak_bytes"}
"""Figures of which more, or less, is better."""

NAMES = {
    "psnr": "PSNR [dB]",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "psnr_static": "PSNR, static region [dB]",
    "psnr_dynamic": "PSNR, dynamic region [dB]",
    "ssim_static": "SSIM, static region",
    "ssim_dynamic": "SSIM, dynamic region",
    "masked_psnr": "PSNR, co-visible [dB]",
    "masked_ssim": "SSIM, co-visible",
    "fps": "frames a second",
    "lpips_net": "network of LPIPS",
    "num_views": "views",
    "train_seconds": "training time [h:m:s]",
    "peak_bytes": "peak memory",
    "num_static": "static Gaussians",
    "num_dynamic": "dynamic Gaussians",
}
"""Figures in words; others are called as in metrics.json."""

OWN = {"out", "resume", "preset", "lpips"}
"""Settings that say nothing of how a run was trained."""

Row = tuple[str, list[Any], list[str]]
"""Name, values, and the values in words."""


def summary_rows(records: Sequence[Record]) -> Iterator[Row]:
    """Every figure of metrics.json that a run has, in the order of the first run's."""
    names = dict.fromkeys(name for record in records for name in record.metrics)
    for name in names:
        values = [record.metrics.get(name) for record in records]
        if any(value is not None for value in values):
            yield name, values, [in_words(name, value) for value in values]
    speeds = [_speed(record.metrics) for record in records]
    if any(speed is not None for speed in speeds):
        yield "iterations a second", speeds, ["" if speed is None else f"{speed:.1f}" for speed in speeds]


def _speed(metrics: dict[str, Any]) -> float | None:
    done, seconds = metrics.get("iterations"), metrics.get("train_seconds")
    if not isinstance(done, int | float) or not isinstance(seconds, int | float) or seconds <= 0:
        return None
    return done / seconds


def in_words(name: str, value: Any) -> str:
    """A figure for people: times and sizes in units, numbers with as many digits as mean something."""
    if value is None:
        return "not measured"
    if isinstance(value, bool) or not isinstance(value, int | float):
        return str(value)
    if name == "train_seconds":
        minutes, seconds = divmod(round(value), 60)
        return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"
    if name == "peak_bytes":
        return f"{value / 1e9:.2f} GB"
    if isinstance(value, int):
        return f"{value:,}"
    digits = 2 if "psnr" in name else 1 if name == "fps" else 5 if name == "flicker" else 4
    return f"{value:.{digits}f}"


def config_rows(configs: Sequence[TrainConfig]) -> list[tuple[str, list[str]]]:
    """Settings that differ between runs; of one run, those that are not its preset's."""
    flat = [dict(_flat("", config)) for config in configs]
    shown = list(flat)
    if len(flat) == 1:
        flat.append(dict(_flat("", PRESETS[configs[0].preset])))
    names = [name for name in flat[0] if name not in OWN and len({repr(values[name]) for values in flat}) > 1]
    return [(name, [str(values[name]) for values in shown]) for name in names]


def _flat(prefix: str, part: Any) -> Iterator[tuple[str, Any]]:
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flat(f"{prefix}{field.name}.", value)
        else:
            yield prefix + field.name, value
