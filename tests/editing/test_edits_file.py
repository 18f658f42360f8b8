"""The file of edits: read back as written, bounded, and used by all commands."""

import base64
import dataclasses
import json
import shutil
import zlib

import numpy as np
import pytest
import torch

from tests.data.captures import edit_json
from tests.export.scenes import refusal, trained_scene
from warpgs.cli import main
from warpgs.editing.edits_file import MAX_BYTES, NAME, NONE, edits_in_use, read_edits, save_edits
from warpgs.editing.marked import Marked
from warpgs.editing.objects import write_objects
from warpgs.editing.options import Editing, Edits
from warpgs.files import write_json
from warpgs.formats.standard import read_standard
from warpgs.runs import checkpoint
from warpgs.runs.run import Run
from warpgs.runs.trained import TrainedScene
from warpgs.viewer.source import open_source

pytestmark = pytest.mark.usefixtures("quickly")

ALL = Edits(
    box=(("table", -1.0, -2.0, 0.5, 1.0, 2.0, 3.25), ("wall-2", 0.0, 0.0, 0.0, 1.0, 1.0, 1.0)),
    recolor=(("1", 0.0, 0.5, 1.0),),
    freeze=(("1", 0.25), ("2", 1.0)),
    shift=(("3", -0.5),),
    objects="1,2,table",
    remove="0",
    erased=Marked.of(np.arange(60) % 3 == 0),
    crop=(-1.0, -2.0, 0.5, 1.0, 2.0, 3.25),
    min_opacity=0.05,
    drop_floaters=True,
    max_gaussians=7,
)


BOMB = base64.b64encode(zlib.compress(bytes(1 << 20))).decode()
"""Bits that are far more than those of 9 Gaussians."""


@pytest.fixture
def run(finished_run, tmp_path):
    return shutil.copytree(finished_run, tmp_path / "run")


@pytest.fixture(scope="module")
def scene():
    return trained_scene()


def one_object(run):
    """Stores that all dynamic Gaussians of a run are object 1."""
    scene = Run.open(run, "cpu").trained_scene()
    write_objects(scene, run, np.ones(len(scene.scene.dynamic), np.int32))


def count(run):
    """The number of Gaussians in a file that is exported, with a run's edits."""
    assert main(["export", str(run), "--quiet", "--up", "scene", "--out", str(run.parent / "out")]) == 0
    return len(read_standard(run.parent / "out" / "scene.ply"))


@pytest.mark.parametrize("edits", [ALL, Edits(), Edits(min_opacity=0.5)])
def test_a_file_of_edits_is_read_back_as_it_was_written(tmp_path, scene, edits):
    assert read_edits(save_edits(tmp_path, Editing(), edits, scene))[0] == edits


def test_a_file_of_edits_holds_only_those_that_are_made(tmp_path, scene):
    path = save_edits(tmp_path, Editing(), Edits(min_opacity=0.5), scene)
    assert json.loads(path.read_text()) == {"format": "warpgs edits", "version": 1, "min_opacity": 0.5}


def test_a_run_without_a_file_of_edits_has_none(tmp_path, scene):
    assert edits_in_use(tmp_path, Editing(), scene) == Edits()


def test_an_edit_that_is_given_replaces_the_one_in_the_file(tmp_path, scene):
    save_edits(tmp_path, Editing(), Edits(min_opacity=0.5, max_gaussians=7), scene)
    expected = Edits(min_opacity=0.25, max_gaussians=7)
    assert edits_in_use(tmp_path, Editing(Edits(min_opacity=0.25)), scene) == expected


def test_another_file_can_be_named_or_none(tmp_path, scene):
    save_edits(tmp_path, Editing(), ALL, scene)
    other = save_edits(tmp_path, Editing(edits=tmp_path / "other.json"), Edits(max_gaussians=3), scene)
    assert edits_in_use(tmp_path, Editing(edits=other), scene) == Edits(max_gaussians=3)
    assert edits_in_use(tmp_path, Editing(edits=NONE), scene) == Edits()
    with pytest.raises(ValueError, match="--edits cannot be none"):
        save_edits(tmp_path, Editing(edits=NONE), ALL, scene)


def test_a_file_that_is_named_must_exist(tmp_path, scene):
    with pytest.raises(ValueError, match=r"gone\.json is missing"):
        edits_in_use(tmp_path, Editing(edits=tmp_path / "gone.json"), scene)


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
        ({"checkpoint": 7}, "checkpoint must have an iteration and a fingerprint, got 7"),
        ({"checkpoint": {"iteration": 7}}, "checkpoint must have an iteration and a fingerprint"),
        ({"checkpoint": {"iteration": "7", "fingerprint": "a"}}, "checkpoint must have an iteration"),
        ({"erased": [1]}, "erased must have a count and bits, got [1]"),
        ({"erased": {"count": 9, "bits": 3}}, "erased must have a count and bits"),
        ({"erased": {"count": 0, "bits": ""}}, "count of erased must be in [1, 268,435,456], got 0"),
        ({"erased": {"count": True, "bits": ""}}, "count of erased must be in"),
        ({"erased": {"count": 9, "bits": "?"}}, "bits of erased are damaged"),
        ({"erased": {"count": 9, "bits": "AAAA"}}, "bits of erased are damaged"),
        ({"erased": {"count": 9, "bits": "é"}}, "bits of erased are damaged"),
        ({"erased": {"count": 9, "bits": BOMB}}, "bits of erased are not those of 9 Gaussians"),
        ({"erased": {"count": 9, "bits": BOMB[:8]}}, "bits of erased are not those of 9 Gaussians"),
        ({"erased": {"count": 7, "bits": Marked.of(np.ones(8, bool)).for_json()["bits"]}}, "are not those of 7"),
        ({"max_gaussians": -1}, "--max-gaussians must be at least 1"),
    ],
)
def test_a_file_with_other_values_is_refused_by_its_name(tmp_path, scene, changes, message):
    path = save_edits(tmp_path, Editing(), ALL, scene)
    edit_json(path, **changes)
    refused = refusal(read_edits, path)
    assert refused is not None
    assert str(path) in refused
    assert message in refused


def refused_use(folder, editing, scene):
    """Why the edits of a run folder are refused for a scene."""
    return str(refusal(lambda path: edits_in_use(path, editing, scene), folder))


def retrained(scene, iteration):
    """The scene with the Gaussians of another training."""
    other = trained_scene(seed=1)
    return TrainedScene(other.scene, other.config, dataclasses.replace(scene.metadata, iteration=iteration))


@pytest.mark.parametrize(
    ("edits", "further", "reason"),
    [
        (Edits(remove="0,2"), 5, "has numbers of objects or Gaussians at iteration {}, but the run is at {}"),
        (Edits(freeze=(("1", 0.5),)), 0, "has numbers of objects or Gaussians of another training up to iteration {}"),
        (
            Edits(erased=Marked.of(np.arange(60) < 9)),
            0,
            "has numbers of objects or Gaussians of another training up to iteration {}",
        ),
    ],
)
def test_saved_numbers_of_objects_are_refused_for_other_gaussians(tmp_path, scene, edits, further, reason):
    path, iteration = save_edits(tmp_path, Editing(), edits, scene), scene.metadata.iteration
    assert edits_in_use(tmp_path, Editing(), scene) == edits
    refused = refused_use(tmp_path, Editing(), retrained(scene, iteration + further))
    assert refused.startswith(f"{path} {reason.format(iteration, iteration + further)}: ")
    assert "delete the file or give --edits none, and choose them anew" in refused


def test_numbers_of_objects_without_their_checkpoint_are_refused(tmp_path, scene):
    write_json(tmp_path / NAME, {"format": "warpgs edits", "version": 1, "remove": "2"})
    assert "does not say which checkpoint" in refused_use(tmp_path, Editing(), scene)


@pytest.mark.parametrize("saved", [Edits(objects="0,table", min_opacity=0.5), Edits(remove="0"), Edits(crop=ALL.crop)])
def test_saved_edits_without_numbers_are_for_all_checkpoints(tmp_path, scene, saved):
    save_edits(tmp_path, Editing(), saved, scene)
    assert edits_in_use(tmp_path, Editing(), retrained(scene, 99)) == saved


def test_a_given_list_of_objects_replaces_a_saved_one_of_another_checkpoint(tmp_path, scene):
    save_edits(tmp_path, Editing(), Edits(remove="2", min_opacity=0.5), scene)
    expected = Edits(remove="1", min_opacity=0.5)
    assert edits_in_use(tmp_path, Editing(Edits(remove="1")), retrained(scene, 99)) == expected


@pytest.mark.parametrize(
    ("given", "saved", "message"),
    [
        (Edits(objects="1", recolor=(("2", 1.0, 0.0, 0.0),)), Edits(), "--recolor 2 would change nothing"),
        (Edits(freeze=(("2", 0.5),)), Edits(objects="0, 1"), "because --objects 0, 1 removes it: add 2 to --objects"),
        (Edits(shift=(("2", 0.5),)), Edits(remove="1,2"), "because --remove 1,2 removes it: omit 2 there"),
    ],
)
def test_a_change_of_an_object_that_is_removed_is_refused(tmp_path, scene, given, saved, message):
    save_edits(tmp_path, Editing(), saved, scene)
    assert message in refused_use(tmp_path, Editing(given), scene)


def test_objects_with_saved_changes_can_be_left_out(tmp_path, scene):
    saved = Edits(recolor=(("1", 1.0, 0.0, 0.0), ("2", 0.0, 1.0, 0.0)))
    save_edits(tmp_path, Editing(), saved, scene)
    edits = edits_in_use(tmp_path, Editing(Edits(objects="1")), scene)
    assert edits == dataclasses.replace(saved, objects="1")


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
    assert f"edits keep 9 of {whole} Gaussians, with those of {run / NAME}\n" in capsys.readouterr().out
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
    assert read_edits(run / NAME)[0] == expected
    assert "edits keep 30 of " in capsys.readouterr().out


def test_a_switch_that_is_given_as_off_replaces_the_one_in_the_file(run, capsys):
    save_edits(run, Editing(), Edits(drop_floaters=True, max_gaussians=9), trained_scene())
    assert main(["export", str(run), "--quiet", "--no-drop-floaters", "--save-edits"]) == 0
    assert read_edits(run / NAME)[0] == Edits(max_gaussians=9)
    assert main(["export", str(run), "--quiet", "--drop-floaters", "--save-edits"]) == 0
    assert read_edits(run / NAME)[0] == Edits(drop_floaters=True, max_gaussians=9)


def test_files_at_all_times_have_a_frozen_object_as_it_was(run, tmp_path):
    one_object(run)
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
