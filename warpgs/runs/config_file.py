"""config.json of a run folder: the training config, written and read back."""

import dataclasses
import json
import reprlib
import sys
import typing
from pathlib import Path
from typing import Any

from warpgs.config import TrainConfig, validate
from warpgs.config.builtin import is_builtin
from warpgs.errors import missing, suggestion
from warpgs.files import read_json, write_text

NAME = "config.json"
MAX_BYTES = 1 << 20
"""Size of config.json [bytes]."""

REMOVED_PRESETS = ("fast",)
REMOVED = {
    "densify": ("depth_gradients",),
    "loss": ("mask_tolerance",),
    "schedule": ("half_size_until", "mask_trial"),
}

RENAMED = {"relight_from": "appearance_from", "dense_fraction": "split_size"}
"""Fields that earlier versions wrote under another name."""

ALWAYS = {
    "": "antialias app assume checkpoint_every dap graph keep_checkpoints resident_bytes seed stage2 static_appearance "
    "static_geometry vdp",
    "densify": "every gradient max_gaussians max_size min_opacity split_size visibility",
    "loss": "depth depth_dynamic depth_end dynamic dynamic_background joint ssim static",
    "masks": "dilate erode holes",
    "model": "appearance_degree appearance_opacity depth dynamic_points half max_static_points position_bands "
    "sh_degree skip time_bands width",
    "optim": "means networks networks_end opacities quats scales sh_dc sh_rest",
    "schedule": "appearance_from deform_from densify_from densify_until noise_until pretrain prune_every realign_at "
    "reset_every sh_degree_every stage1 stage2 warmup",
}
"""Fields of each section, "" for those outside, that every version since 0.1.0 writes, but for those that may be null.
Others may be missing. With the default of one of these, a run would be resumed as another run."""


def former_option(name: str) -> str:
    """The end of the message that there is no option ``name``: what became of it; empty if no version had it."""
    *section, field = name.lstrip("-").replace("-", "_").split(".")
    if field in RENAMED:
        return f"; it is --{'.'.join([*section, RENAMED[field]]).replace('_', '-')} now"
    if field.removeprefix("no_") in REMOVED.get(".".join(section), ()):
        return " any more: omit it"
    return ""


def write_config(folder: Path, config: TrainConfig) -> None:
    """Writes config.json into a run folder, with absolute paths.

    Raises:
        OSError: If the file cannot be written.
    """
    data = config.data if config.data is None or is_builtin(config.data) else config.data.resolve()
    weights = config.lpips and config.lpips.resolve()
    plain = dataclasses.asdict(dataclasses.replace(config, out=folder, data=data, lpips=weights))
    write_text(folder / NAME, json.dumps(plain, indent=2, default=_as_json) + "\n")


def _as_json(value: Any) -> Any:
    """A path as text; a number of NumPy or torch as one of Python."""
    return value.item() if hasattr(value, "item") else str(value)


def read_config(folder: Path) -> TrainConfig:
    """The training config of a run folder.

    Raises:
        ValueError: If the folder or its config.json does not exist, or the file is damaged, or has unknown or mistyped
            fields, or lacks a section or a field that every version writes.
    """
    path = folder / NAME
    if not folder.exists():
        raise ValueError(missing(folder))
    if not path.exists():
        raise ValueError(f"{folder} is not a run folder: it has no {NAME}")
    values = _with_old_meaning(read_json(path, max_bytes=MAX_BYTES))
    config = parse_config(values, path)
    _require_complete(values, path)
    return dataclasses.replace(config, out=folder)


def _require_complete(values: dict[str, Any], path: Path) -> None:
    """Raises ValueError if a section or field is missing that every version writes, instead of taking its default."""
    for section, names in ALWAYS.items():
        present = {RENAMED.get(name, name) for name in (values.get(section, {}) if section else values)}
        lacking = [name for name in names.split() if name not in present]
        if lacking:
            is_gone = section and section not in values
            what = f"section {section}" if is_gone else ".".join(filter(None, (section, lacking[0])))
            raise ValueError(
                f"{path} has no {what}, which every version writes: restore the file from a copy, because with "
                "defaults in its place this would be another run"
            )


def _with_old_meaning(values: dict[str, Any]) -> dict[str, Any]:
    """Values as today's version writes what an earlier one meant, so that its runs are resumed as they were begun.

    Before there was ``background``, it was always black; before ``densify.unit``, it was the extent. Before there was
    ``loss.depth_gate``, runs without depth-aware pretraining had no depth loss at all. A preset that is gone is none:
    the file has all of its values. ``loss.branches_in_stage2`` was a yes or no. The options of ``REMOVED`` changed
    nothing that is still to be done, but for ``densify.depth_gradients``: terms of depth count from now on where
    densification did not look at them.
    """
    values = {"background": "black", **values}
    if isinstance(densify := values.get("densify"), dict):
        values = {**values, "densify": {"unit": "extent", **densify}}
    if values.get("preset") in REMOVED_PRESETS:
        values = {**values, "preset": None}
    for part, names in REMOVED.items():
        if isinstance(known := values.get(part), dict):
            values = {**values, part: {k: v for k, v in known.items() if k not in names}}
    loss = values.get("loss")
    if isinstance(loss, dict) and isinstance(loss.get("branches_in_stage2"), bool):
        loss = {**loss, "branches_in_stage2": "yes" if loss["branches_in_stage2"] else "no"}
        values = {**values, "loss": loss}
    if values.get("dap") is False and isinstance(loss, dict) and "depth_gate" not in loss:
        return {**values, "loss": {**loss, "depth": 0.0}}
    return values


def parse_config(values: dict[str, Any], source: Path | str) -> TrainConfig:
    """A training config from parsed JSON or TOML; fields that are not given have the defaults of ``TrainConfig``.

    Args:
        values: Fields, nested as in ``TrainConfig``.
        source: Where they come from, for messages.

    Raises:
        ValueError: If there are unknown or mistyped fields, or numbers out of their range.
    """
    config: TrainConfig = _parse(TrainConfig, values, source)
    try:
        validate(config)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    return config


def _parse(cls: Any, values: Any, path: Path | str, prefix: str = "") -> Any:
    """A (nested) dataclass from parsed JSON; the prefix has the names of those around it, with dots."""
    if not isinstance(values, dict):
        raise ValueError(f"{path}: expected an object for {cls.__name__}, got {reprlib.repr(values)}")
    values = {RENAMED.get(name, name): value for name, value in values.items()}
    hints = typing.get_type_hints(cls)
    if unknown := sorted(set(values) - set(hints)):
        close = suggestion(unknown[0], set(hints) - set(values))
        raise ValueError(f"{path} has fields of another version: {', '.join(unknown):.200}{close}")
    fields = {}
    for name, value in values.items():
        hint = hints[name]
        if dataclasses.is_dataclass(hint):
            value = _parse(hint, value, path, f"{prefix}{name}.")
        elif Path in typing.get_args(hint) and isinstance(value, str):
            value = Path(value)
        elif not _matches(value, hint):
            raise ValueError(f"{path}: {prefix}{name} cannot be {reprlib.repr(value)}")
        if isinstance(value, list):
            value = tuple(float(item) for item in value)
        fields[name] = float(value) if hint is float else value
    return cls(**fields)


def _matches(value: Any, hint: Any) -> bool:
    if typing.get_origin(hint) is typing.Literal:
        return value in typing.get_args(hint)
    if typing.get_origin(hint) is tuple:
        items = typing.get_args(hint)
        return isinstance(value, list) and len(value) == len(items) and all(map(_matches, value, items))
    if choices := typing.get_args(hint):
        return any(_matches(value, choice) for choice in choices)
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
    return type(value) is hint
