"""The file of edits: read back as written, bounded, and used by all commands."""

import json
import shutil

import numpy as np
import pytest
import torch

from tests import tiny
from tests.data.captures import edit_json
from tests.export.scenes import refusal
from warpgs.cli import main
from warpgs.editing.edits_file import MAX_BYTES, NAME, NONE, edits_in_use, read_edits, save_edits
from warpgs.editing.objects import NAME as OBJECTS
from warpgs.editing.options import Editing, Edits
from warpgs.formats.standard import read_standard
from warpgs.runs import checkpoint
from warpgs.runs.run import Run
from warpgs.viewer.source import open_source

pytestmark = pytest.mark.usefixtures("quickly")

ALL = Edits(
    box=(("table", -1.0, -2.0, 0.5, 1.0, 2.0, 3.25), ("wall-2", 0.0, 0.0, 0.0, 1.0, 1.0, 1.0)),
    recolor=(("1", 0.0, 0.5, 1.0),),
    freeze=(("1", 0.25), ("2", 1.0)),
    shift=(("3", -0.5),),
    objects="1,2,table",
    remove="0",
    crop=(-1.0, -2.0, 0.5, 1.0, 2.0, 3.25),
    min_opacity=0.05,
    drop_floaters=True,
    max_gaussians=7,
)


@pytest.fixture
def run(finished_run, tmp_path):
    return shutil.copytree(finished_run, tmp_path / "run")


def count(run):
    """The number of Gaussians in a file that is exported, with a run's edits."""
    assert main(["export", str(run), "--quiet", "--up", "scene", "--out", str(run.parent / "out")]) == 0
    return len(read_standard(run.parent / "out" / "scene.ply"))


@pytest.mark.parametrize("edits", [ALL, Edits(), Edits(min_opacity=0.5)])
def test_a_file_of_edits_is_read_back_as_it_was_written(tmp_path, edits):
    assert read_edits(save_edits(tmp_path, Editing(), edits)) == edits


def test_a_file_of_edits_holds_only_those_that_are_made(tmp_path):
    path = save_edits(tmp_path, Editing(), Edits(min_opacity=0.5))
    assert json.loads(path.read_text()) == {"format": "warpgs edits", "version": 1, "min_opacity": 0.5}


def test_a_run_without_a_file_of_edits_has_none(tmp_path):
    assert edits_in_use(tmp_path, Editing()) == Edits()


def test_an_edit_that_is_given_replaces_the_one_in_the_file(tmp_path):
    save_edits(tmp_path, Editing(), Edits(min_opacity=0.5, max_gaussians=7))
    expected = Edits(min_opacity=0.25, max_gaussians=7)
    assert edits_in_use(tmp_path, Editing(Edits(min_opacity=0.25))) == expected


def test_another_file_can_be_named_or_none(tmp_path):
    save_edits(tmp_path, Editing(), ALL)
    other = save_edits(tmp_path, Editing(edits=tmp_path / "other.json"), Edits(max_gaussians=3))
    assert edits_in_use(tmp_path, Editing(edits=other)) == Edits(max_gaussians=3)
    assert edits_in_use(tmp_path, Editing(edits=NONE)) == Edits()
    with pytest.raises(ValueError, match="--edits cannot be none"):
        save_edits(tmp_path, Editing(edits=NONE), ALL)


def test_a_file_that_is_named_must_exist(tmp_path):
    with pytest.raises(ValueError, match=r"gone\.json is missing"):
        edits_in_use(tmp_path, Editing(edits=tmp_path / "gone.json"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"format": "gltf"}, "is not a file of edits of warpgs"),
        ({"version": 2}, "has version 2, this program reads 1"),
        ({"version": None}, "has version None"),
        ({"lasso": []}, "has an unknown edit 'lasso', expected some of box, "),
        ({"crop": [0, 0, 0, 1, 1]}, "crop must be finite numbers of shape"),
        ({"crop": [0, 0, 0, 1, 1, 1e10]}, "crop must be at most"),
        ({"crop": [0, 0, 0, 0, 1, 1]}, "--crop must be opposite corners"),
        ({"min_opacity": "0.5"}, "min_opacity must hold numbers"),
        ({"min_opacity": 2}, "--min-opacity must be in"),
        ({"drop_floaters": 1}, "drop_floaters cannot be 1"),
        ({"max_gaussians": 7.5}, "max_gaussians cannot be 7.5"),
        ({"max_gaussians": True}, "max_gaussians cannot be True"),
        ({"freeze": 1}, "freeze must be a list of lists"),
        ({"freeze": ["1"]}, "freeze must be a list of lists"),
        ({"freeze": [["1"]]}, "freeze must be finite numbers of shape"),
        ({"freeze": [[1, 0.5]]}, "freeze needs the name of an object, got 1"),
        ({"freeze": [["1", "0.5"]]}, "freeze must hold numbers"),
        ({"freeze": [["1", 2]]}, "--freeze 1 must be in"),
        ({"box": [["table", 0, 0, 0, 1, 1]]}, "box must be finite numbers of shape"),
        ({"objects": 2}, "objects cannot be 2"),
        ({"max_gaussians": -1}, "--max-gaussians must be at least 1"),
    ],
)
def test_a_file_with_other_values_is_refused_by_its_name(tmp_path, changes, message):
    path = save_edits(tmp_path, Editing(), ALL)
    edit_json(path, **changes)
    refused = refusal(read_edits, path)
    assert refused is not None
    assert str(path) in refused
    assert message in refused


def test_a_large_file_is_refused(tmp_path):
    (tmp_path / NAME).write_text(" " * MAX_BYTES + "{}")
    assert "more than the maximum" in str(refusal(read_edits, tmp_path / NAME))


def test_saved_edits_apply_to_exports_renders_and_the_viewer(run, capsys):
    whole = count(run)
    before = {path.name: path.read_bytes() for path in checkpoint.list_checkpoints(run)}
    render = ["render", str(run), "--frames", "1", "--path", "fixed", "--write", "png", "--quiet"]
    assert main([*render, "--out", str(run.parent / "first"), "--max-gaussians", "9", "--save-edits"]) == 0
    assert f"edits keep 9 of {whole} Gaussians\nedits saved as {run / NAME}" in capsys.readouterr().out
    assert count(run) == 9
    assert f"edits keep 9 of {whole} Gaussians" in capsys.readouterr().out
    assert main([*render, "--out", str(run.parent / "second")]) == 0
    assert (run.parent / "second" / "00000.png").read_bytes() == (run.parent / "first" / "00000.png").read_bytes()
    source = open_source(run, "cpu", False)
    assert source.edit(Editing(), Run.open(run, "cpu").open_corrected_capture(True)) != []
    shown = source.edited(source.edits)
    assert len(shown.scene.static) + len(shown.scene.dynamic) == 9
    assert {path.name: path.read_bytes() for path in checkpoint.list_checkpoints(run)} == before


def test_without_edits_a_run_is_the_same_bit_for_bit(run):
    whole = count(run)
    main(["export", str(run), "--quiet", "--max-gaussians", "9", "--save-edits"])
    source = open_source(run, "cpu", False)
    unedited = source.current().splats(0.3)
    source.edit(Editing(edits=NONE), None)
    shown = source.current().splats(0.3)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(shown, name), getattr(unedited, name))
    (run / NAME).unlink()
    assert count(run) == whole


def test_a_training_that_is_followed_has_no_edits(run, capsys):
    assert main(["view", str(run), "--while-training", "--min-opacity", "0.1"]) == 2
    assert "--while-training shows the scene as it is trained, without edits" in capsys.readouterr().err


def test_all_edits_can_be_given_on_the_command_line(run, capsys):
    box = ["--crop", "-9", "-9", "-9", "9", "9", "9"]
    edits = [*box, "--min-opacity", "0.01", "--drop-floaters", "--max-gaussians", "30", "--save-edits"]
    objects = ["--box", "all", *box[1:], "--objects", "0,all", "--recolor", "all", "1", "0.5", "0"]
    assert main(["export", str(run), "--quiet", *objects, *edits]) == 0
    expected = Edits(
        box=(("all", -9.0, -9.0, -9.0, 9.0, 9.0, 9.0),),
        recolor=(("all", 1.0, 0.5, 0.0),),
        objects="0,all",
        crop=(-9.0, -9.0, -9.0, 9.0, 9.0, 9.0),
        min_opacity=0.01,
        drop_floaters=True,
        max_gaussians=30,
    )
    assert read_edits(run / NAME) == expected
    assert "edits keep 30 of " in capsys.readouterr().out


def test_a_switch_that_is_given_as_off_replaces_the_one_in_the_file(run, capsys):
    save_edits(run, Editing(), Edits(drop_floaters=True, max_gaussians=9))
    assert main(["export", str(run), "--quiet", "--no-drop-floaters", "--save-edits"]) == 0
    assert read_edits(run / NAME) == Edits(max_gaussians=9)
    assert main(["export", str(run), "--quiet", "--drop-floaters", "--save-edits"]) == 0
    assert read_edits(run / NAME) == Edits(drop_floaters=True, max_gaussians=9)


def test_files_at_all_times_have_a_frozen_object_as_it_was(run, tmp_path):
    count = len(Run.open(run, "cpu").trained_scene().scene.dynamic)
    np.savez(run / OBJECTS, iteration=tiny.LENGTH, ids=np.ones(count, np.int32))
    means = []
    for name, *freeze in (("moves",), ("frozen", "--freeze", "1", "0.0")):
        out = tmp_path / name
        options = ["--frames", "2", "--layers", "dynamic", "--up", "scene", "--out", str(out), "--quiet"]
        assert main(["export", str(run), *options, *freeze]) == 0
        means.append([read_standard(path).means for path in sorted(out.glob("*.ply"))])
    (start, end), frozen = means
    assert not np.array_equal(start, end)
    assert all(np.array_equal(at, start) for at in frozen)


def test_floaters_need_the_capture(run, tmp_path, capsys):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    assert main(["export", str(run), "--quiet", "--drop-floaters"]) == 2
    assert "--drop-floaters needs the training cameras" in capsys.readouterr().err
