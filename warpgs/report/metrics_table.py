"""Rows of the tables that compare runs: metrics, and settings that differ."""

from collections.abc import Iterator, Sequence
from typing import Any

from warpgs.config import TrainConfig, fields
from warpgs.config.presets import PRESETS
from warpgs.evaluation.metrics import METRICS

from .evaluated_run import EvaluatedRun

TITLES = {
    "device": "FPS measured on",
    "lpips_net": "LPIPS network",
    "notes": "noted before the first step",
    "num_views": "views",
    "poses_aligned": "held-out cameras aligned",
    "train_seconds": "training time [h:m:s]",
    "mask_trial_seconds": "trial of the masks [h:m:s]",
}
"""Headings of facts, and of metrics that reports show in another unit than sweeps."""

UNRELATED = {"out", "resume", "preset", "lpips", "lpips_net"}
"""Settings that do not affect training."""

Row = tuple[str, list[Any], list[str]]
"""Name, values, and formatted values."""


def summary_rows(runs: Sequence[EvaluatedRun]) -> Iterator[Row]:
    """One row per metric of metrics.json that any run has, in the order of the first run."""
    names = dict.fromkeys(name for run in runs for name in run.metrics)
    for name in names:
        values = [run.metrics.get(name) for run in runs]
        if any(value is not None for value in values):
            yield name, values, [formatted(name, value) for value in values]
    speeds = [_speed(run.metrics) for run in runs]
    if any(speed is not None for speed in speeds):
        yield "iterations per second", speeds, ["" if speed is None else f"{speed:.1f}" for speed in speeds]


def _speed(metrics: dict[str, Any]) -> float | None:
    done, seconds = metrics.get("iterations"), metrics.get("train_seconds")
    if not isinstance(done, int | float) or not isinstance(seconds, int | float) or seconds <= 0:
        return None
    return done / seconds


def heading(name: str) -> str:
    """The heading of a value of metrics.json; its name if it has none."""
    return TITLES.get(name) or (METRICS[name].heading if name in METRICS else name)


def formatted(name: str, value: Any) -> str:
    """A value of metrics.json as text, with the digits of its metric."""
    if value is None:
        return "not measured"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return "; ".join(value) or "none"
    if not isinstance(value, int | float):
        return str(value)
    if name in ("train_seconds", "mask_trial_seconds"):
        minutes, seconds = divmod(round(value), 60)
        return f"{minutes // 60}:{minutes % 60:02}:{seconds:02}"
    if name in METRICS:
        return METRICS[name].number(value / METRICS[name].scale)
    return f"{value:,}" if isinstance(value, int) else f"{value:.4f}"


def config_rows(configs: Sequence[TrainConfig]) -> list[tuple[str, list[str]]]:
    """Settings that differ between runs; for a single run, those that differ from its preset."""
    usual = [PRESETS[configs[0].preset or "best"]] if len(configs) == 1 else []
    flat = [{name: value for name, _, value in fields(config)} for config in (*configs, *usual)]
    names = [name for name in flat[-1] if name not in UNRELATED and len({repr(values[name]) for values in flat}) > 1]
    return [(name, [_setting(name, values[name]) for values in flat[: len(configs)]]) for name in names]


def _setting(name: str, value: Any) -> str:
    return "builtin:room" if name == "data" and value is None else str(value)
