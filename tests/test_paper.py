"""The preset paper against the paper, section by section, and docs/method.md against the presets."""

import ast
import dataclasses
import re
from pathlib import Path

import pytest
import torch

from tests import tiny
from warpgs.config import DensifyConfig, fields
from warpgs.config.presets import PRESETS
from warpgs.runs import checkpoint
from warpgs.training import optimizer
from warpgs.training.density import operations

PAPER = {
    "Visual Geometry Decomposition: Eq. 6": {
        "model.position_bands": 10,
        "model.time_bands": 10,
        "model.raw_input": False,
        "model.min_period": 0.0,
    },
    "Visual Geometry Decomposition: Eq. 8 and 9, static component": {
        "model.sh_degree": 3,
        "model.appearance": "all",
        "frozen": "all",
        "loss.ssim": 0.2,
    },
    "Visual Geometry Decomposition: Eq. 10 to 12, dynamic component": {
        "model.deformation": "mlp",
        "model.segments": 1,
        "loss.mask_margin": 0.0,
        "assume": "masks",
    },
    "Depth-Aware Pretraining: Eq. 14": {
        "depth": True,
        "loss.depth_dynamic": 0.0,
        "loss.depth_tolerance": 0.0,
        "loss.object_depth": False,
    },
    "Training Protocol: Eq. 15": {
        "omit": (),
        "schedule.appearance_from": None,
        "schedule.joint_from": None,
        "loss.branches_in_stage2": "yes",
    },
    "Experimental Setup": {
        "schedule.stage1": 30_000,
        "schedule.stage2": 40_000,
        "optim.networks": 8e-4,
        "optim.networks_end": 1.6e-6,
        "schedule.warmup": 0,
        "model.appearance_size": None,
    },
    "Deformable-3DGS: network": {"model.depth": 8, "model.width": 256, "model.skip": 5},
    "Deformable-3DGS: optimization": {
        "optim.means_anneal": "trained",
        "optim.sh_dc": 2.5e-3,
        "schedule.deform_from": 3_000,
        "schedule.noise_until": 20_000,
        "schedule.sh_degree_every": 1_000,
    },
    # It densifies after iterations that are multiples of 100, more than 500 and less than 15,000.
    "3DGS: adaptive density control": {
        "densify.strategy": "3dgs",
        "densify.every": 100,
        "densify.gradient": 2e-4,
        "densify.min_pixels": 0,
        "schedule.densify_from": 600,
        "schedule.densify_until": 14_900,
        "schedule.reset_every": 3_000,
    },
    "3DGS: rasterization": {"max_alpha": 0.99, "background": "capture"},
    "Deformable-3DGS: cameras and frames as they are, factor of HyperNeRF's vrig captures": {"distortion": False},
    "3DGS: depth regularization": {"loss.depth": 1.0, "loss.depth_end": 0.01},
    "code of the authors": {"model.dynamic_points": 100_000, "model.tracks": False},
    "no such thing in the paper": {
        "optim.poses": 0.0,
        "exposure": False,
        "antialias": False,
        "densify.weakest": 0.0,
        "densify.max_elongation": 0.0,
        "model.dropout": 0.0,
        "schedule.settle": 0,
        "loss.squared": 0.0,
        "loss.acceleration": 0.0,
        "model.reflections": False,
        "loss.hidden_appearance": True,
        "densify.reseed": 0.0,
        "schedule.fit_motion": 0,
    },
    "decided here, where neither the paper nor the code that it builds upon says anything": {
        "densify.visibility": 3e-4,
        "densify.max_gaussians": 3_000_000,
        "densify.unit": "pixel",
        "optim.means": 5e-4,
        "schedule.pretrain": 2_000,
        "schedule.prune_every": 5_000,
        "model.max_static_points": 100_000,
        "model.half": True,
    },
}
"""Every option of the method, by the section of the paper, or of the code that it builds upon, that sets it."""

RUN = {"data", "dataset", "factor", "out", "resume", "preset", "iterations", "device", "seed", "graph", "lpips"}
RUN |= {"lpips_net"}
RUN |= {"readout", "readout_from", "damage_masks", "checkpoint_every", "resident_bytes"}
"""Options of a run that do not belong to the method."""

METHOD = Path(__file__).parents[1] / "docs" / "method.md"


def flat(config):
    return {name: value for name, _, value in fields(config)}


@pytest.mark.parametrize("section", PAPER)
def test_the_preset_paper_has_the_values_of_the_paper(section):
    values = flat(PRESETS["paper"])
    expected = {k: pytest.approx(value) if isinstance(value, float) else value for k, value in PAPER[section].items()}
    assert {name: values[name] for name in PAPER[section]} == expected


def test_every_option_of_the_method_is_compared_with_the_paper_once():
    compared = [name for options in PAPER.values() for name in options]
    assert len(compared) == len(set(compared))
    assert set(compared) | RUN == set(flat(PRESETS["paper"]))
    assert not set(compared) & RUN


def test_adam_has_the_betas_of_the_paper():
    """Experimental Setup; no preset has others."""
    assert optimizer.BETAS == (0.9, 0.999)


def test_the_rates_that_are_no_options_are_those_of_deformable_3dgs():
    rates = {"quats": 1e-3, "log_scales": 5e-3, "logit_opacities": 0.05, "sh_rest": 2.5e-3 / 20}
    assert rates == pytest.approx(optimizer.FIXED_RATES)
    assert operations.MIN_OPACITY == 0.005


def table():
    """Switch → (value in ``paper``, value in ``best``), from the rows of the tables of docs/method.md."""
    rows = {}
    for line in METHOD.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        for switch in re.findall(r"`([\w.]+)`", cells[2]) if line.startswith("|") and len(cells) == 6 else []:
            assert switch not in rows, f"{switch} has two rows"
            rows[switch] = (cells[3].strip("`"), cells[4].strip("`"))
    return rows


def written(value):
    """A value as the documentation writes it."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:,}" if isinstance(value, int) else f"{value:g}" if isinstance(value, float) else str(value)


@pytest.mark.parametrize(("column", "preset"), [(0, "paper"), (1, "best")])
def test_the_documentation_has_the_values_of_the_presets(column, preset):
    values = flat(PRESETS[preset])
    documented = {name: cells[column] for name, cells in table().items()}
    assert documented == {name: written(values[name]) for name in documented}


def test_the_documentation_has_every_option_in_which_best_differs_from_the_paper():
    paper, best = flat(PRESETS["paper"]), flat(PRESETS["best"])
    assert {name for name in paper if paper[name] != best[name]} - RUN <= set(table())


def test_the_documentation_names_files_that_exist():
    root = METHOD.parents[1]
    cells = [line.split("|") for line in METHOD.read_text().splitlines() if line.startswith("| ")]
    named = {path for row in cells if len(row) == 8 for path in re.findall(r"`([\w/]+\.py)`", row[2])}
    assert len(named) > 8
    assert not [path for path in named if not (root / path).is_file()]


def names_read(source):
    """The variables and attributes that code reads: none from comments, docstrings and other text."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name | ast.Attribute)]
    return {node.id if isinstance(node, ast.Name) else node.attr for node in nodes if isinstance(node.ctx, ast.Load)}


def test_names_in_comments_docstrings_and_definitions_are_not_read():
    source = '"""Says a."""\n# See b.\nc = "d"\ndef f(x: int = 0, *, g=1):\n    "As h."\n    x.i = j.k\n'
    assert names_read(source) == {"int", "x", "j", "k"}


def test_a_file_beside_each_switch_reads_it():
    root, checked = METHOD.parents[1], 0
    for line in METHOD.read_text().splitlines():
        cells = line.split("|")
        for switch in re.findall(r"`([\w.]+)`", cells[3]) if line.startswith("| ") and len(cells) == 8 else []:
            files = [(root / path).read_text() for path in re.findall(r"`([\w/]+\.py)`", cells[2])]
            assert any(switch.rpartition(".")[2] in names_read(text) for text in files), switch
            checked += 1
    assert checked > 50


def test_training_with_the_preset_runs_through_all_stages(tmp_path, monkeypatch):
    """Small networks and few iterations; every switch of the method as in the preset."""
    monkeypatch.setattr(DensifyConfig, "max_size", 1.0)  # of few points, each is large
    paper = PRESETS["paper"]
    sizes = ("position_bands", "time_bands", "width", "max_static_points", "dynamic_points")
    model = dataclasses.replace(paper.model, **{name: getattr(tiny.MODEL, name) for name in sizes})
    schedule = dataclasses.replace(tiny.SCHEDULE, appearance_from=paper.schedule.appearance_from, warmup=0)
    # Gaussians above 20 pixels are removed: nearly all in images of 32.
    densify = dataclasses.replace(paper.densify, every=4, gradient=1e-5, max_gaussians=120, unit="extent")
    small = {"device": "cpu", "model": model, "schedule": schedule, "densify": densify}
    config = dataclasses.replace(paper, **small, checkpoint_every=22)  # 22: before stage II
    trainer = tiny.trainer(tiny.write(tmp_path), tmp_path / "run", config)
    with tiny.in_haste():
        assert tiny.train(trainer)
    assert trainer.protocol.stage2.start == 22
    before, after = (checkpoint.load(checkpoint.path_of(tmp_path / "run", at)).tensors for at in (22, tiny.LENGTH))
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh_dc", "sh_rest"):
        assert torch.equal(before[f"scene.static.{name}"], after[f"scene.static.{name}"])
        assert not torch.equal(before[f"scene.dynamic.{name}"], after[f"scene.dynamic.{name}"])
    assert not torch.equal(before["scene.appearance.trunk.values"], after["scene.appearance.trunk.values"])
    assert all(value.isfinite().all() for value in after.values())
