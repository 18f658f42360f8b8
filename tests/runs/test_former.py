"""Runs of earlier versions open with the values that they had, and are resumed as they were begun or not at all."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch

from tests import plain, tiny
from tests.runs.folders import create, edit
from warpgs.config import RenderSettings, TrainConfig, fields
from warpgs.config.presets import PRESETS
from warpgs.runs import former
from warpgs.runs.config_file import read_config, require_resumable
from warpgs.training.schedule import Protocol
from warpgs.training.train import train


def test_earlier_runs_keep_the_maximum_alpha_that_they_were_trained_with(tmp_path, capture):
    run = create(dataclasses.replace(PRESETS["paper"], out=tmp_path / "run"), capture)
    edit(run, lambda values: values.pop("max_alpha"))
    assert read_config(run).render_settings == RenderSettings(max_alpha=0.999)


@pytest.mark.parametrize("dap", [False, True])
@pytest.mark.parametrize("is_old", [False, True])
def test_earlier_runs_without_pretraining_stay_without_a_depth_loss(run, dap, is_old):
    def change(values):
        del values["omit"]
        values |= {"dap": dap, "vdp": True, "app": True, "stage2": True}
        if not is_old:
            values["loss"]["depth_gate"] = False

    depth = read_config(run).loss.depth
    assert depth > 0
    edit(run, change)
    config = read_config(run)
    assert config.loss.depth == (0 if is_old and not dap else depth)
    assert Protocol(config, has_depth=True).phase_at(0).with_depth == (config.loss.depth > 0)


@pytest.mark.parametrize("omitted", [(), ("vdp",), ("dap", "app", "stage2")])
def test_components_had_a_switch_each(run, omitted):
    def change(values):
        del values["omit"]
        values |= {name: name not in omitted for name in former.COMPONENTS}

    edit(run, change)
    assert read_config(run).omit == omitted


@pytest.mark.parametrize(
    ("geometry", "appearance", "frozen"),
    [(True, True, "nothing"), (False, True, "geometry"), (True, False, "appearance"), (False, False, "all")],
)
def test_what_stage_2_optimizes_of_static_gaussians_had_two_switches(run, geometry, appearance, frozen):
    def change(values):
        del values["frozen"]
        values |= {"static_geometry": geometry, "static_appearance": appearance}

    edit(run, change)
    assert read_config(run).frozen == frozen


@pytest.mark.parametrize(("before", "factor"), [(None, 2), (4, 4)])
@pytest.mark.parametrize("val", [["right"], ["left"]])
def test_captures_of_two_cameras_had_a_factor_of_their_own(run, tmp_path, before, factor, val):
    (tmp_path / "dataset.json").write_text(json.dumps({"train_ids": ["left"], "val_ids": val}))
    edit(run, lambda values: values.update(data=str(tmp_path), dataset="hypernerf", vrig_factor=before))
    assert read_config(run).factor == (factor if val == ["right"] else None)


@pytest.mark.parametrize(
    ("depth", "width", "size"), [(None, None, None), (4, 128, (4, 128)), (None, 9, (2, 9)), (5, None, (5, 8))]
)
def test_sizes_of_the_appearance_network_were_two_options(run, depth, width, size):
    def change(values):
        del values["model"]["appearance_size"]
        values["model"] |= {"depth": 2, "width": 8, "appearance_depth": depth, "appearance_width": width}

    edit(run, change)
    assert read_config(run).model.appearance_size == size


@pytest.mark.parametrize(
    ("degree", "opacity", "appearance"), [(0, False, "color"), (1, True, "all"), (0, True, None), (1, False, None)]
)
def test_what_the_appearance_network_changes_was_two_options(run, degree, opacity, appearance):
    def change(values):
        del values["model"]["appearance"]
        values["model"] |= {"appearance_degree": degree, "appearance_opacity": opacity}

    assert read_config(run).model.sh_degree == 1
    edit(run, change)
    if appearance is None:
        with pytest.raises(ValueError, match=rf"config\.json: its appearance network changes degrees up to {degree} "):
            read_config(run)
    else:
        assert read_config(run).model.appearance == appearance


@pytest.mark.parametrize(("factor", "means", "unit"), [(None, 2e-4, 7.0), (5.0, 1e-3, 1.0)])
def test_the_rate_of_positions_had_a_factor_of_its_own(run, factor, means, unit):
    """In version 0.3, which had no other unit than the extent."""

    def change(values):
        del values["means_in_views"]
        values["optim"] |= {"means": 2e-4, "means_scale": factor}
        values["densify"] |= {"unit": "extent"}

    edit(run, change)
    plan = read_config(run)
    assert plan.optim.means == pytest.approx(means)
    assert plan.means_unit(7.0) == unit
    assert plan.length_unit(7.0) == 1.0


@pytest.mark.parametrize(
    ("before", "damage"),
    [
        ({"erode": 0, "dilate": 0, "holes": 0.0}, None),
        ({"erode": 2, "dilate": 0, "holes": 0.25}, "erode:2,holes:0.25"),
    ],
)
def test_damage_to_masks_had_a_section(run, before, damage):
    def change(values):
        del values["damage_masks"]
        values["masks"] = before

    edit(run, change)
    assert read_config(run).damage_masks == damage


def test_runs_of_a_preset_that_is_gone_keep_their_options(run):
    before = read_config(run)
    edit(run, lambda values: values.update(preset="fast"))
    assert read_config(run) == dataclasses.replace(before, preset=None)


@pytest.mark.parametrize(("before", "now"), [(True, "yes"), (False, "no")])
def test_whether_stage_2_compares_branches_was_a_yes_or_no(run, before, now):
    def change(values):
        values["loss"]["branches_in_stage2"] = before
        del values["branches_in_stage2"]

    edit(run, change)
    plan = read_config(run)
    assert (plan.branches_in_stage2, plan.loss.branches_in_stage2) == (before, now)


def test_a_background_and_a_device_that_were_not_looked_up_are_black_and_that_of_the_machine(run, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    edit(run, lambda values: values.update(background="capture", device=None))
    assert (read_config(run).background, read_config(run).device) == ("black", "cuda")


@pytest.mark.parametrize("option", former.REMOVED)
def test_runs_with_an_option_that_is_gone_open(run, option):
    before = read_config(run)
    *section, name = option.split(".")
    edit(run, lambda values: (values.setdefault(section[0], {}) if section else values).update({name: 0}))
    assert read_config(run) == before


@pytest.mark.parametrize("option", ["gone", "loss.gone"])
def test_runs_that_need_an_option_that_is_gone_open_but_are_not_resumed(run, monkeypatch, option):
    """Training would go on as that of another run."""
    monkeypatch.setitem(former.REMOVED, option, former.Removed("it is always 1", lambda value, section: value == 1))
    before = read_config(run)
    *section, name = option.split(".")
    edit(run, lambda values: (values[section[0]] if section else values).update({name: 1}))
    require_resumable(run)
    edit(run, lambda values: (values[section[0]] if section else values).update({name: 2}))
    assert read_config(run) == before
    message = (
        rf"config\.json cannot be resumed: {option} is 2; this version has no such option any more: it is always 1; "
    )
    with pytest.raises(ValueError, match=message):
        train(TrainConfig(resume=run))


FIRST = {
    "": "antialias assume checkpoint_every graph resident_bytes seed model loss optim densify schedule",
    "densify": "every gradient max_gaussians visibility",
    "loss": "depth depth_dynamic depth_end ssim",
    "model": "depth dynamic_points half max_static_points position_bands sh_degree skip time_bands width",
    "optim": "means networks networks_end sh_dc",
    "schedule": "appearance_from deform_from densify_from densify_until noise_until pretrain prune_every "
    "reset_every sh_degree_every stage1 stage2 warmup",
}
"""Fields that version 0.1.0 wrote, those of today's names, without those that may be null."""


def test_a_run_of_the_first_version_opens_with_the_values_that_it_had(tmp_path, capture):
    """None of the remedies of later versions, whatever the defaults are."""
    written = plain.config(omit=("app",), out=tmp_path / "run", data=tmp_path)
    run = create(written, capture)

    def reduce(values):
        for section, names in FIRST.items():
            part = values[section] if section else values
            for name in set(part) - set(names.split()):
                del part[name]
        values["schedule"]["relight_from"] = values["schedule"].pop("appearance_from")
        values["densify"] |= {"dense_fraction": 0.01, "max_size": 0.1}
        values |= {"dap": True, "vdp": True, "app": False, "stage2": True}
        values |= {"static_geometry": False, "static_appearance": False}
        values["masks"] = {"erode": 0, "dilate": 0, "holes": 0.0}
        values["model"] |= {"appearance_degree": 0, "appearance_opacity": False}

    edit(run, reduce)
    densify = dataclasses.replace(written.densify, unit="extent")
    expected = plain.plan(dataclasses.replace(written, data=None, densify=densify))
    assert read_config(run) == dataclasses.replace(expected, means_in_views=True)


VERSION_0_3 = json.loads((Path(__file__).parent / "version_0_3.json").read_text())
"""config.json of a run with each preset of version 0.3.0."""


RESTATED = {
    "paper": {"frozen": "all", "model.appearance": "all", "model.appearance_size": None},
    "best": {"frozen": "nothing", "model.appearance_size": (4, 128)},
    "patient": {"frozen": "nothing", "model.appearance_size": None},
}
RESTATED["paper"] |= {"optim.means": 8e-4, "means_in_views": False}
RESTATED["quick"] = RESTATED["patient"]
"""What options that it did not have say of the same values."""


@pytest.mark.parametrize("preset", VERSION_0_3)
def test_a_run_of_version_0_3_opens_with_its_values_and_can_be_resumed(tmp_path, preset):
    written = VERSION_0_3[preset]
    (tmp_path / "config.json").write_text(json.dumps(written))
    require_resumable(tmp_path)
    found = {name: value for name, _, value in fields(read_config(tmp_path))}
    before = {
        f"{section}.{name}": value
        for section in ("model", "loss", "optim", "densify", "schedule")
        for name, value in written[section].items()
    }
    before |= {name: value for name, value in written.items() if not isinstance(value, dict)}
    expected = {name: value for name, value in before.items() if name in found}
    expected |= {"out": tmp_path, "background": "black", "omit": (), "damage_masks": None, "densify.unit": "extent"}
    expected |= {"model.appearance": "color", "means_in_views": True} | RESTATED[preset]
    assert {name: found[name] for name in expected} == expected


def test_a_config_with_the_old_name_of_a_field_still_opens(run):
    def rename(values):
        values["schedule"]["relight_from"] = values["schedule"].pop("appearance_from") + 7

    edit(run, rename)
    assert read_config(run).schedule.appearance_from == tiny.CONFIG.schedule.appearance_from + 7


def reduce_to_version_0_3(values, dense_fraction, max_size):
    values["densify"] |= {"dense_fraction": dense_fraction, "max_size": max_size}
    del values["densify"]["unit"]


def test_sizes_of_a_run_of_version_0_3_stay_fractions_of_the_extent(run):
    edit(run, lambda values: reduce_to_version_0_3(values, 0.01, 0.1))
    densify = read_config(run).densify
    assert (densify.unit, densify.split_size, densify.max_size) == ("extent", 0.01, 0.1)
    require_resumable(run)


@pytest.mark.parametrize(("dense_fraction", "max_size"), [(0.02, 0.1), (0.01, 0.2)])
def test_a_run_of_version_0_3_with_other_sizes_is_not_resumed(run, dense_fraction, max_size):
    edit(run, lambda values: reduce_to_version_0_3(values, dense_fraction, max_size))
    with pytest.raises(ValueError, match=r"cannot be resumed: densify\.\w+ is 0\.\d+; .*--densify.unit says all sizes"):
        require_resumable(run)
