"""Run folders: the config round-trips, and a folder that is not a run is refused with a clear message."""

import dataclasses
import re
from pathlib import Path

import pytest
import torch

from tests import plain, tiny
from tests.runs.folders import create, edit
from tests.scenes import error
from warpgs.config import TrainConfig, scaled
from warpgs.config.presets import PRESETS
from warpgs.locks import lock_folder
from warpgs.runs import checkpoint
from warpgs.runs import run as runs
from warpgs.runs.config_file import read_config, read_notes, write_start
from warpgs.runs.opening import open_run
from warpgs.runs.run import Run, locked_new_folder, new_folder
from warpgs.runtime.devices import choose_device

UNUSUAL = dataclasses.replace(
    tiny.CONFIG,
    dataset="iphone",
    factor=3,
    seed=5,
    omit=("dap", "app"),
    assume="dynamic",
    damage_masks="erode:2,holes:0.25",
    lpips=Path("/weights"),
)


@pytest.mark.parametrize("config", [*PRESETS.values(), scaled(PRESETS["best"]), UNUSUAL, tiny.CONFIG])
def test_a_plan_round_trips(tmp_path, capture, config):
    config = dataclasses.replace(config, out=tmp_path / "run", data=tmp_path)
    assert read_config(create(config, capture)) == plain.plan(config)


def test_damaged_notes_are_refused_by_the_name_of_their_file(run):
    assert read_notes(run) is None
    write_start(run, tiny.CONFIG, ["a sentence"])
    assert read_notes(run) == ["a sentence"]
    (run / "start.json").write_text('{"notes": [1]}')
    with pytest.raises(ValueError, match=r"start\.json is damaged: notes cannot be \[1\]"):
        read_notes(run)


def test_a_run_prints_as_what_was_trained_on_what(tmp_path, capture):
    folder = create(dataclasses.replace(tiny.CONFIG, out=tmp_path / "own", data=tmp_path), capture)
    assert repr(Run.open(folder, "cpu")) == f"<Run {folder}: quick on {tmp_path}, 32 iterations>"
    built_in = Run.open(create(dataclasses.replace(PRESETS["best"], out=tmp_path / "other"), capture), "cpu")
    assert repr(built_in) == f"<Run {tmp_path / 'other'}: best on the built-in scene, 45,400 iterations>"


def test_a_moved_run_has_its_present_folder(run, tmp_path):
    moved = run.rename(tmp_path / "elsewhere")
    assert read_config(moved).out == moved


def test_paths_are_saved_as_absolute_paths(tmp_path, capture, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = dataclasses.replace(tiny.CONFIG, out=Path("run"), data=Path("capture"), lpips=Path("weights"))
    kept = read_config(create(config, capture))
    assert kept.data == tmp_path / "capture"
    assert kept.lpips == tmp_path / "weights"


@pytest.mark.parametrize(("preset", "suffix"), [("best", "-best"), (None, "")])
def test_a_folder_is_named_after_the_capture_and_its_preset(tmp_path, capture, monkeypatch, preset, suffix):
    monkeypatch.chdir(tmp_path)
    config = dataclasses.replace(tiny.CONFIG, preset=preset, out=None)
    assert create(config, capture) == Path("runs") / f"{capture.name}{suffix}"
    assert create(config, capture) == Path("runs") / f"{capture.name}{suffix}-2"
    assert new_folder(config, capture) == Path("runs") / f"{capture.name}{suffix}-3"


def test_what_a_kill_in_the_first_write_leaves_is_an_empty_folder(tmp_path, capture):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.json.partial").write_text("{")
    config = dataclasses.replace(tiny.CONFIG, out=folder)
    assert create(config, capture) == folder
    assert read_config(folder).out == folder
    with pytest.raises(ValueError, match="exists and is not empty"):
        new_folder(config, capture)


def fail_locked(run):
    with Run.open(run, "cpu").lock():
        raise KeyError


def test_a_run_folder_cannot_be_locked_twice_and_is_unlocked_after_an_error(run):
    for _ in range(2):
        with pytest.raises(KeyError):
            fail_locked(run)
    with Run.open(run, "cpu").lock(), pytest.raises(ValueError, match="is being trained by another process"):
        fail_locked(run)


def test_a_folder_that_another_training_has_filled_before_it_is_locked_is_refused(tmp_path, capture, monkeypatch):
    config = dataclasses.replace(tiny.CONFIG, out=tmp_path / "run")
    monkeypatch.setattr(runs, "lock_folder", lambda *args: create(config, capture) and lock_folder(*args))
    with pytest.raises(ValueError, match="exists and is not empty"):
        locked_new_folder(config, capture).__enter__()
    assert read_config(tmp_path / "run").out == tmp_path / "run"


def test_the_field_that_a_misspelt_one_may_mean_is_named(run):
    edit(run, lambda values: values.update(itrations=values.pop("iterations")))
    with pytest.raises(ValueError, match=r"another version: itrations; did you mean iterations\?$"):
        read_config(run)


def test_a_field_that_is_there_is_not_meant_by_a_misspelt_one(run):
    edit(run, lambda values: values.update(itrations=1))
    with pytest.raises(ValueError, match=r"another version: itrations$"):
        read_config(run)


@pytest.mark.parametrize("part", [None, "model", "schedule"])
def test_an_unknown_field_is_refused_by_its_name(run, part):
    edit(run, lambda values: (values if part is None else values[part]).update(future=1))
    with pytest.raises(ValueError, match=r"config\.json has fields of another version: future$"):
        read_config(run)


WRONG = {
    "seed": ["0", 1.5, True, None],
    "antialias": [1],
    "omit": ["dap", ["all"], [1]],
    "assume": ["nothing"],
    "device": ["tpu"],
}
WRONG |= {"factor": ["2"], "data": [5, ["a"]], "lpips": [{}]}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in WRONG.items() for value in values])
def test_a_field_of_another_type_is_refused_by_its_name(run, name, value):
    edit(run, lambda values: values.update({name: value}))
    with pytest.raises(ValueError, match=rf"config\.json: {name} cannot be "):
        read_config(run)


@pytest.mark.parametrize("value", ["0.5", None, True, [1.0]])
def test_a_rate_that_is_not_a_number_is_refused(run, value):
    edit(run, lambda values: values["optim"].update(means=value))
    with pytest.raises(ValueError, match=r"config\.json: optim.means cannot be "):
        read_config(run)


def test_a_rate_may_be_a_whole_number(run):
    edit(run, lambda values: values["optim"].update(means=1))
    assert read_config(run).optim.means == 1.0


@pytest.mark.parametrize("section", ["model", "loss", "optim", "densify", "schedule"])
def test_a_missing_section_is_refused_by_its_name(run, section):
    edit(run, lambda values: values.pop(section))
    with pytest.raises(ValueError, match=rf"config\.json has no section {section}, which every version writes: "):
        read_config(run)


@pytest.mark.parametrize("name", ["seed", "omit", "schedule.stage1", "optim.means", "model.width", "loss.ssim"])
def test_a_missing_field_that_every_version_writes_is_refused_by_its_name(run, name):
    *sections, field = name.split(".")
    edit(run, lambda values: (values[sections[0]] if sections else values).pop(field))
    with pytest.raises(ValueError, match=rf"config\.json has no {name}, which every version writes: "):
        read_config(run)


def test_a_section_that_is_not_an_object_is_refused(run):
    edit(run, lambda values: values.update(model=3))
    with pytest.raises(ValueError, match=r"config\.json: expected an object for ModelConfig, got 3"):
        read_config(run)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        *((content, "is not valid JSON") for content in (b"", b"{", b"nonsense", b'{"seed": 1', b"\xff\xfe\x00")),
        *((content, "must hold a JSON object") for content in (b"[]", b"3", b"null")),
    ],
)
def test_a_damaged_config_is_named(run, content, message):
    (run / "config.json").write_bytes(content)
    with pytest.raises(ValueError, match=rf"config\.json {message}"):
        read_config(run)


@pytest.mark.parametrize(
    ("name", "problem"), [("", "is not a run folder"), ("file", "is not a run folder"), ("missing", "does not exist$")]
)
def test_a_path_that_is_not_a_run_folder_is_refused(tmp_path, name, problem):
    (tmp_path / "file").write_text("{}")
    with pytest.raises(ValueError, match=f"{tmp_path / name} {problem}"):
        read_config(tmp_path / name)


def test_a_capture_is_not_a_run_folder_but_can_be_trained_on(data):
    with pytest.raises(ValueError, match=f"{data} is not a run folder: .* capture: warpgs train --data {data} trains"):
        read_config(data)


def test_checkpoints_without_their_config_and_a_part_of_a_run_are_named(tmp_path):
    (tmp_path / "checkpoints").mkdir()
    with pytest.raises(ValueError, match=f"{tmp_path} is not a run folder: .* copy the whole run folder"):
        read_config(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ValueError, match=f"checkpoints is not a run folder: .* part of one: give {tmp_path}$"):
        read_config(tmp_path / "checkpoints")


def test_a_folder_with_files_is_not_trained_into(tmp_path, capture):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=rf"{tmp_path} exists and is not empty: choose another --out"):
        create(TrainConfig(out=tmp_path), capture)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]


def test_a_run_folder_that_exists_can_be_resumed(tmp_path, capture):
    folder = create(dataclasses.replace(tiny.CONFIG, out=tmp_path / "run"), capture)
    with pytest.raises(
        ValueError, match=rf"{folder} exists and is not empty: continue it with warpgs train --resume {folder}, or"
    ):
        new_folder(TrainConfig(out=folder), capture)


def test_a_file_is_not_trained_into(tmp_path, capture):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ValueError, match="exists and is not empty"):
        create(TrainConfig(out=tmp_path / "file"), capture)


def test_an_empty_folder_is_trained_into(tmp_path, capture):
    assert create(TrainConfig(out=tmp_path), capture) == tmp_path
    assert (tmp_path / "config.json").is_file()


def test_cuda_is_refused_without_a_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="use --device cpu"):
        choose_device("cuda")


@pytest.mark.parametrize(("available", "chosen"), [(False, "cpu"), (True, "cuda")])
def test_the_default_device_is_the_gpu_if_there_is_one(monkeypatch, available, chosen):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    assert choose_device() == chosen


def test_a_misspelt_capture_of_a_run_is_told_the_similar_one(run, tmp_path):
    meant = tmp_path / "elsewhere"
    meant.mkdir()
    with pytest.raises(ValueError, match=rf"give it by --data; did you mean {re.escape(str(meant))}\?$"):
        Run.open(run, data=tmp_path / "elswhere").open_capture()


def test_a_run_without_a_checkpoint_has_no_scene(run):
    assert Run.open(run).newest_checkpoint() is None
    with pytest.raises(ValueError, match=f"{run} has no checkpoint yet"):
        open_run(run)


def test_the_scene_is_that_of_the_last_iteration(run, data):
    trainer = tiny.trainer(data, run)
    trainer.save()
    trainer.iteration = 20
    trainer.scene.static.means.data[0] = 9.0
    trainer.save()
    trained = open_run(run, "cpu")
    assert trained.metadata.iteration == 20
    assert trained.scene.static.means[0].tolist() == [9.0, 9.0, 9.0]


def test_a_scene_is_not_read_with_the_config_of_another_run(run, data):
    tiny.trainer(data, run).save()
    other = dataclasses.replace(tiny.CONFIG, model=dataclasses.replace(tiny.MODEL, width=16))
    with pytest.raises(ValueError, match="does not hold a scene of this run's config"):
        Run(run, plain.plan(other)).trained_scene()


def run_with_poses(data, folder):
    """A run whose checkpoint corrects the training cameras; nothing is trained."""
    optim = dataclasses.replace(tiny.CONFIG.optim, poses=1e-3)
    config = dataclasses.replace(tiny.CONFIG, data=data, out=folder, optim=optim)
    trainer = tiny.trainer(data, folder, config)
    for parameter in trainer.views.poses.parameters():
        parameter.data[:] = 0.01 * torch.randn(parameter.shape)
    trainer.save()
    return Run.create(folder, plain.plan(config)), trainer


def test_training_cameras_are_where_training_moved_them_and_the_others_stay(data, tmp_path, capture):
    run, trainer = run_with_poses(data, tmp_path / "run")
    corrected = run.open_corrected_capture(quiet=True)
    for name, expected in zip(capture.train, trainer.views.cameras(), strict=True):
        assert torch.equal(corrected.cameras[name].viewmat, expected.viewmat)
        assert torch.equal(corrected.frame(name).camera.viewmat, expected.viewmat)
        assert not torch.equal(corrected.cameras[name].viewmat, capture.cameras[name].viewmat)
    for name in capture.val:
        assert torch.equal(corrected.cameras[name].viewmat, capture.cameras[name].viewmat)
    first = capture.train[0]
    assert torch.equal(run.open_capture(quiet=True).frame(first).camera.viewmat, capture.cameras[first].viewmat)


def test_without_corrections_or_checkpoint_the_cameras_are_those_of_the_capture(data, tmp_path, capture):
    run, _ = run_with_poses(data, tmp_path / "run")
    for path in checkpoint.list_checkpoints(run.folder):
        path.unlink()
    first = capture.train[0]
    assert torch.equal(run.open_corrected_capture(quiet=True).cameras[first].viewmat, capture.cameras[first].viewmat)


def test_frames_that_were_not_trained_on_keep_their_cameras(data, tmp_path, capture):
    run, trainer = run_with_poses(data, tmp_path / "run")
    tiny.edit_metadata(run.newest_checkpoint(), lambda fields: fields.update(views=["gone", *fields["views"][1:]]))
    corrected = run.open_corrected_capture(quiet=True)
    first, second = capture.train[:2]
    assert torch.equal(corrected.cameras[first].viewmat, capture.cameras[first].viewmat)
    expected = trainer.views.cameras()[1].viewmat
    assert torch.equal(corrected.cameras[second].viewmat, expected)


def change_tensors(path, change):
    loaded = checkpoint.load(path)
    tensors = dict(loaded.tensors)
    change(tensors)
    checkpoint.save(path, tensors, loaded.metadata)


def test_checkpoints_without_places_have_a_correction_of_each_frame(data, tmp_path, capture):
    run, trainer = run_with_poses(data, tmp_path / "run")

    def spread(tensors):
        places = tensors.pop("poses.places")
        tensors |= {name: tensors[name][places] for name in ("poses.rotations", "poses.translations")}

    change_tensors(run.newest_checkpoint(), spread)
    corrected = run.open_corrected_capture(quiet=True)
    for name, expected in zip(capture.train, trainer.views.cameras(), strict=True):
        assert torch.equal(corrected.cameras[name].viewmat, expected.viewmat)


@pytest.mark.parametrize("change", [lambda p: p - 1, lambda p: p + len(p), lambda p: p[1:], lambda p: p.float()])
def test_damaged_places_are_refused(data, tmp_path, change):
    run, trainer = run_with_poses(data, tmp_path / "run")
    places = {"poses.places": change(trainer.views.poses.places)}
    change_tensors(run.newest_checkpoint(), lambda tensors: tensors.update(places))
    with pytest.raises(checkpoint.DamagedCheckpointError, match="expected poses"):
        run.open_corrected_capture(quiet=True)


def test_corrections_of_version_0_3_are_fractions_of_the_extent(data, tmp_path, capture):
    run, trainer = run_with_poses(data, tmp_path / "run")
    tiny.edit_metadata(run.newest_checkpoint(), lambda fields: fields.pop("unit"))
    extent = capture.extent
    assert abs(extent - trainer.unit) > 0.1
    trainer.views.poses.unit = extent
    corrected = run.open_corrected_capture(quiet=True)
    for name, expected in zip(capture.train, trainer.views.cameras(), strict=True):
        assert error(corrected.cameras[name].viewmat, expected.viewmat) < 1e-6
