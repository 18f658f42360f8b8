"""Options of earlier versions: their values as today's version writes them, and advice on those that are gone."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

REMOVED_PRESETS = ("fast",)

RENAMED = {"relight_from": "appearance_from", "undistort": "distortion"}
"""Fields that earlier versions wrote under another name."""


class Removed(NamedTuple):
    """An option that is gone.

    Attributes:
        advice: What to do instead of giving it.
        is_kept: Whether a run with this value trains on as it was begun, given the other fields of the section.
    """

    advice: str = "omit it"
    is_kept: Callable[[Any, dict[str, Any]], bool] = lambda value, section: True


def _always(constant: float) -> Removed:
    return Removed(f"it is always {constant:g}", lambda value, section: value == constant)


def _sizes(in_pixels: float, of_extent: float) -> Removed:
    def is_kept(value: Any, densify: dict[str, Any]) -> bool:
        return bool(value == (in_pixels if densify.get("unit") == "pixel" else of_extent))

    return Removed("--densify.unit says all sizes", is_kept)


COMPONENTS = ("dap", "vdp", "app", "stage2")
"""Components of the paper, each of which had a switch."""

FROZEN = {(True, True): "nothing", (False, True): "geometry", (True, False): "appearance", (False, False): "all"}
"""What stage II kept of static Gaussians, by whether it optimized their geometry and their appearance."""

DAMAGE = {"erode": "PIXELS", "dilate": "PIXELS", "holes": "FRACTION"}
"""Kinds of damage to masks, each of which had an option, and what it was measured in."""

REMOVED: dict[str, Removed] = {
    "as_taken": Removed("frames are always compared as they were recorded"),
    **{name: Removed(f"--omit {name} omits it") for name in COMPONENTS},
    "keep_checkpoints": Removed("the two newest are kept"),
    "masks": Removed("--damage-masks is for that"),
    **{f"masks.{kind}": Removed(f"--damage-masks {kind}:{size} is for that") for kind, size in DAMAGE.items()},
    "static_appearance": Removed("--frozen says what stage II keeps"),
    "static_geometry": Removed("--frozen says what stage II keeps"),
    "try_masks": Removed("--assume auto tries masks out, --assume masks does not"),
    "vrig_factor": Removed("--factor is for these captures, too"),
    "densify.dense_fraction": _sizes(2.0, 0.01),
    "densify.depth_gradients": Removed(),
    "densify.max_size": _sizes(20.0, 0.1),
    "densify.min_opacity": _always(0.005),
    "densify.noise": Removed("there is no strategy mcmc any more"),
    "densify.split_size": _sizes(2.0, 0.01),
    "loss.depth_gate": Removed("depth is compared where the opacity exceeds a half"),
    "loss.depth_margin": Removed(
        "it is 3 with loss.depth_tolerance, else 0",
        lambda value, loss: value == (3.0 if loss.get("depth_tolerance") else 0.0),
    ),
    "loss.depth_smooth": Removed(
        "it is on with loss.depth_tolerance, else off",
        lambda value, loss: value == bool(loss.get("depth_tolerance")),
    ),
    "loss.dynamic": _always(1.0),
    "loss.dynamic_background": Removed(),
    "loss.joint": _always(1.0),
    "loss.mask_tolerance": Removed(),
    "loss.opacity": Removed("there is no such term any more", lambda value, section: value == 0.0),
    "loss.scale": Removed("there is no such term any more", lambda value, section: value == 0.0),
    "loss.static": _always(1.0),
    "model.appearance_degree": Removed("--model.appearance is for that"),
    "model.appearance_depth": Removed("--model.appearance-size is for that"),
    "model.appearance_opacity": Removed("--model.appearance is for that"),
    "model.appearance_width": Removed("--model.appearance-size is for that"),
    "model.bound_sizes": Removed(),
    "model.dynamic_start": Removed(),
    "model.path_points": Removed(),
    "model.paths": Removed(),
    "model.point_colors": Removed(),
    "model.start": Removed(),
    "optim.means_scale": Removed("--optim.means is in view sizes, with --densify.unit extent in scene units"),
    "optim.opacities": _always(0.05),
    "optim.quats": _always(1e-3),
    "optim.scales": _always(5e-3),
    "optim.sh_rest": _always(1.25e-4),
    "schedule.half_size_until": Removed(),
    "schedule.mask_trial": Removed(),
    "schedule.realign_at": Removed(
        "depth is aligned again in the middle of the pretraining, schedule.pretrain",
        # Rescaling rounded both.
        lambda value, schedule: abs(2 * value - schedule["pretrain"]) <= 2 or schedule["pretrain"] == 0,
    ),
}
"""Options that are gone, by name with their section."""

FORMER: dict[str, dict[str, Any]] = {
    "": {
        "background": "black",
        "data": None,
        "dataset": None,
        "depth": True,
        "device": None,
        "distortion": True,
        "exposure": False,
        "factor": None,
        "iterations": None,
        "lpips": None,
        "lpips_net": "vgg",
        "max_alpha": 0.999,
        "out": None,
        "preset": None,
        "readout": None,
        "readout_from": None,
        "resume": None,
    },
    "densify": {
        "max_elongation": 0.0,
        "min_pixels": 0,
        "reseed": 0.0,
        "strategy": "3dgs",
        "unit": "extent",
        "weakest": 0.0,
    },
    "loss": {
        "acceleration": 0.0,
        "branches_in_stage2": "yes",
        "depth_tolerance": 0.0,
        "hidden_appearance": True,
        "mask_margin": 0.0,
        "object_depth": False,
        "squared": 0.0,
    },
    "model": {
        "deformation": "mlp",
        "dropout": 0.0,
        "min_period": 0.0,
        "raw_input": True,
        "reflections": False,
        "segments": 1,
        "tracks": True,
    },
    "optim": {"means_anneal": "run", "poses": 0.0},
    "schedule": {"fit_motion": 0, "joint_from": None, "settle": 0},
}
"""Values that runs of versions without these fields had, by section, "" for those outside. A field that is not here has
been written by every version since 0.1.0: with a default in its place, a run would be resumed as another run."""


def former_option(name: str) -> str:
    """The end of the message that there is no option ``name``: what became of it; empty if no version had it."""
    *section, field = name.lstrip("-").replace("-", "_").split(".")
    field, no = field.removeprefix("no_"), "no-" if field.startswith("no_") else ""
    if field in RENAMED:
        return f"; it is --{'.'.join([*section, no + RENAMED[field]]).replace('_', '-')} now"
    removed = REMOVED.get(".".join([*section, field]))
    return f" any more: {removed.advice}" if removed else ""


def not_kept(values: dict[str, Any]) -> str | None:
    """The first removed option of a config.json without which a run would not train on as it was begun."""
    for name, removed in REMOVED.items():
        *section, field = name.split(".")
        part = values.get(section[0], {}) if section else values
        try:
            is_kept = field not in part or removed.is_kept(part[field], part)
        except TypeError:
            is_kept = False
        if not is_kept:
            return f"{name} is {part[field]}; this version has no such option any more: {removed.advice}"
    return None


def as_today(values: dict[str, Any]) -> dict[str, Any]:
    """Values as today's version writes those of an earlier one, so that its runs are resumed as they were begun."""
    values = {name: dict(value) if isinstance(value, dict) else value for name, value in values.items()}
    for change in CHANGES:
        change(values)
    for name in REMOVED:
        *section, field = name.split(".")
        part = values.get(section[0]) if section else values
        if isinstance(part, dict):
            part.pop(field, None)
    return values


def _looked_up(values: dict[str, Any]) -> None:
    """A preset that is gone is none: the file has all of its values. A background that was not looked up is black."""
    if values.get("preset") in REMOVED_PRESETS:
        values["preset"] = None
    if values.get("background") == "capture":
        values["background"] = "black"
    if values.get("device") is None:
        from warpgs.runtime.devices import choose_device  # imports torch, which advice on options does not need

        values["device"] = choose_device()


def _losses(values: dict[str, Any]) -> None:
    """``loss.branches_in_stage2`` was a yes or no, and later what runs as well as what was asked for.

    Before there was ``loss.depth_gate``, runs without depth-aware pretraining had no depth loss at all. After
    ``densify.depth_gradients``, terms of depth count from now on where densification did not look at them.
    """
    if isinstance(loss := values.get("loss"), dict):
        if isinstance(branches := loss.get("branches_in_stage2"), bool):
            loss["branches_in_stage2"] = "yes" if branches else "no"
        values.setdefault("branches_in_stage2", loss.get("branches_in_stage2") != "no")
        if values.get("dap") is False and "depth_gate" not in loss:
            loss["depth"] = 0.0


def _switches(values: dict[str, Any]) -> None:
    """Each component of the paper had a switch, and so had each part of static Gaussians in stage II."""
    if all(isinstance(values.get(name), bool) for name in COMPONENTS):
        values.setdefault("omit", [name for name in COMPONENTS if not values[name]])
    geometry, appearance = values.get("static_geometry"), values.get("static_appearance")
    if isinstance(geometry, bool) and isinstance(appearance, bool):
        values.setdefault("frozen", FROZEN[geometry, appearance])


def _factor(values: dict[str, Any]) -> None:
    """HyperNeRF's captures of two cameras had a factor of their own, whatever ``distortion`` is."""
    data, dataset = values.get("data"), values.get("dataset")
    if "vrig_factor" not in values or values.get("factor") is not None or not isinstance(data, str):
        return
    from warpgs.data.loaders import is_vrig  # imports all loaders, which playing a scene does not need

    if is_vrig(Path(data), dataset):
        values["factor"] = values["vrig_factor"] or 2


def _appearance(values: dict[str, Any]) -> None:
    """The appearance network had options of its own for its two sizes, and for what it changes.

    Raises:
        ValueError: If it changes something that today's does not: the checkpoint has a network of another shape.
    """
    model = values.get("model")
    if not isinstance(model, dict) or "depth" not in model or "width" not in model:
        return
    size = model.get("appearance_depth"), model.get("appearance_width")
    model.setdefault("appearance_size", [size[0] or model["depth"], size[1] or model["width"]] if any(size) else None)
    degree, changes_opacity = model.get("appearance_degree"), model.get("appearance_opacity")
    if (degree, changes_opacity) == (0, False):
        model.setdefault("appearance", "color")
    elif (degree, changes_opacity) == (model.get("sh_degree"), True):
        model.setdefault("appearance", "all")
    elif degree is not None and changes_opacity is not None:
        raise ValueError(
            f"its appearance network changes degrees up to {degree} of spherical harmonics, and opacities: "
            f"{changes_opacity}; this version has no such network: open the run with the one that began it"
        )


def _means(values: dict[str, Any]) -> None:
    """The rate of positions had a factor of its own, and was in extents of the cameras in version 0.3."""
    if isinstance(optim := values.get("optim"), dict) and "means_in_views" not in values:
        means, factor = optim.get("means"), optim.get("means_scale")
        values["means_in_views"] = factor is None
        if isinstance(means, int | float) and isinstance(factor, int | float):
            optim["means"] = means * factor


def _masks(values: dict[str, Any]) -> None:
    """Damage to masks was a section of three numbers."""
    if isinstance(masks := values.get("masks"), dict):
        values.setdefault("damage_masks", ",".join(f"{kind}:{size}" for kind, size in masks.items() if size) or None)


CHANGES = (_looked_up, _losses, _switches, _factor, _appearance, _means, _masks)
"""What was written otherwise; each changes the values in place."""
