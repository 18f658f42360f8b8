"""Checkpoints: atomic writes, and reading that trusts nothing in the file."""

import dataclasses
import errno
import gc
import json
import math
import os
import pickle
import resource
import struct
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from tests import tiny
from tests.export.scenes import refusal
from warpgs.model.scene import SplitScene
from warpgs.runs import checkpoint

TENSORS = {"scene.a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2])}
METADATA = checkpoint.Metadata(iteration=3, use_deformation=True, use_appearance=True, sh_degree=1)

FIELDS = json.dumps(
    {
        **{"iteration": 3, "moving": True, "relit": True, "sh_degree": 1},
        **{"train_seconds": 0.0, "peak_bytes": None, "rollbacks": 0, "views": []},
    }
)


def scene(num_static=5, num_dynamic=3, model=tiny.MODEL):
    made = SplitScene.empty(num_static, num_dynamic, model)
    for parameter in made.parameters():
        torch.nn.init.uniform_(parameter)
    return made


def tensors_of(a_scene):
    return {f"scene.{name}": tensor for name, tensor in a_scene.state_dict().items()}


@pytest.fixture
def path(tmp_path):
    path = checkpoint.path_of(tmp_path, 3)
    checkpoint.save(path, TENSORS, METADATA)
    return path


def write_raw(path, header, data=b"", length=None):
    """A safetensors file of a header, which may lie about its own length."""
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text) if length is None else length) + text + data)
    return path


def metadata(**changes):
    header = {"format": "warpgs", "version": str(checkpoint.VERSION), "facts": FIELDS, **changes}
    return {"__metadata__": {key: value for key, value in header.items() if value is not None}}


def test_a_checkpoint_round_trips_bit_for_bit(path):
    loaded = checkpoint.load(path)
    assert tiny.differences(loaded.tensors, TENSORS) == []
    assert loaded.metadata == METADATA


def test_checkpoints_have_the_permissions_of_other_files(path, tmp_path):
    (tmp_path / "plain").touch()
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_scene_round_trips_bit_for_bit(tmp_path):
    saved = scene()
    checkpoint.save(tmp_path / "a.safetensors", tensors_of(saved), METADATA)
    read = checkpoint.load_scene(checkpoint.load(tmp_path / "a.safetensors"), tiny.MODEL)
    assert tiny.differences(dict(read.state_dict()), dict(saved.state_dict())) == []


def test_offsets_of_version_0_3_are_in_scene_units(tmp_path):
    saved = {name: tensor for name, tensor in tensors_of(scene()).items() if name != "scene.deformation.units"}
    checkpoint.save(tmp_path / "a.safetensors", saved, METADATA)
    read = checkpoint.load_scene(checkpoint.load(tmp_path / "a.safetensors"), tiny.MODEL)
    assert read.deformation.units.tolist() == [1.0] * 10


@pytest.mark.parametrize("counts", [(0, 0), (1, 0), (0, 1)])
def test_an_empty_branch_round_trips(tmp_path, counts):
    checkpoint.save(tmp_path / "a.safetensors", tensors_of(scene(*counts)), METADATA)
    read = checkpoint.load_scene(checkpoint.load(tmp_path / "a.safetensors"), tiny.MODEL)
    assert (len(read.static), len(read.dynamic)) == counts


def test_checkpoints_are_listed_oldest_first(tmp_path):
    for iteration in (10_000, 20, 3):
        checkpoint.save(checkpoint.path_of(tmp_path, iteration), TENSORS, METADATA)
    assert checkpoint.list_checkpoints(tmp_path) == [checkpoint.path_of(tmp_path, k) for k in (3, 20, 10_000)]


def test_a_folder_without_checkpoints_has_none(tmp_path):
    assert checkpoint.list_checkpoints(tmp_path) == []


@pytest.mark.parametrize(("count", "left"), [(2, [4, 5]), (1, [5]), (0, [5]), (9, [1, 2, 3, 4, 5])])
def test_the_newest_checkpoints_are_kept(tmp_path, count, left):
    for iteration in range(1, 6):
        checkpoint.save(checkpoint.path_of(tmp_path, iteration), TENSORS, METADATA)
    checkpoint.keep_newest(tmp_path, count)
    assert checkpoint.list_checkpoints(tmp_path) == [checkpoint.path_of(tmp_path, k) for k in left]


def test_half_written_files_are_not_listed_and_are_removed(path):
    partial = path.with_name("0000009.partial")
    partial.write_bytes(path.read_bytes()[:50])
    assert checkpoint.list_checkpoints(path.parent.parent) == [path]
    checkpoint.keep_newest(path.parent.parent, 2)
    assert list(path.parent.iterdir()) == [path]


WITH_SMALL_FILES = """
import pathlib, resource, sys, torch
from warpgs.runs import checkpoint
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
metadata = checkpoint.Metadata(iteration=3, use_deformation=True, use_appearance=True, sh_degree=1)
checkpoint.save(pathlib.Path(sys.argv[1]), {"b": torch.zeros(100_000)}, metadata)
"""
"""Saves while the system refuses files over 4 KiB: in a separate process, because the limit would also hold for a log
file of the tests."""


LARGE = {"b": torch.zeros(100_000)}


def full_disk(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_write_that_fails_half_way_leaves_the_old_checkpoint_alone(path):
    before = path.read_bytes()
    command = [sys.executable, "-c", WITH_SMALL_FILES, str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.stderr.splitlines()[-1].startswith(f"OSError: {path} could not be written")
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_full_disk_leaves_the_old_checkpoint_alone(path, monkeypatch, failing):
    before = path.read_bytes()
    monkeypatch.setattr(os, failing, full_disk)
    with pytest.raises(OSError, match="could not be written"):
        checkpoint.save(path, LARGE, METADATA)
    assert path.read_bytes() == before
    assert list(path.parent.iterdir()) == [path]


def test_a_checkpoint_is_synced_before_it_is_renamed(tmp_path, monkeypatch):
    done = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (done.append("written"), fsync(file)))
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("named"), replace(*paths)))
    checkpoint.save(tmp_path / "a.safetensors", TENSORS, METADATA)
    assert done == ["written", "named"]


@pytest.mark.parametrize("kept", [0, 1, 7, 8, 9, 100, -1])
def test_a_truncated_file_is_damaged(path, kept):
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=f"{path} is damaged"):
        checkpoint.load(path)


LONG = '{"iteration": 1' + 5000 * "0" + "}"


@pytest.mark.parametrize("text", [LONG, None, "", "{", "[1, 2]", "3", '"moving"', "[" * 100_000])
def test_metadata_that_is_not_an_object_is_damage(tmp_path, text):
    path = write_raw(tmp_path / "a.safetensors", metadata(facts=text))
    gc.collect()  # where the text is nested too deep, finalizers of other tests' garbage would have no stack left
    with pytest.raises(ValueError, match="is damaged"):
        checkpoint.load(path)


TOO_LARGE = {"dtype": "F32", "shape": [1_000_000_000, 3], "data_offsets": [0, 12_000_000_000]}
HEADERS = {
    **{f"header of {n} bytes": {"header": metadata(), "length": n} for n in (2**63 - 1, 2**64 - 1, 2**40, 99_000_000)},
    "tensor larger than the file": {"header": {**metadata(), "scene.static.means": TOO_LARGE}, "data": b"\0" * 12},
}
UNREADABLE = {
    "missing": (lambda path: None, "is missing"),
    "another version": (partial(write_raw, header=metadata(version="999")), "has version 999, this program reads 2$"),
    "another program": (partial(save_file, TENSORS), "is not a checkpoint of warpgs"),
    "torch.save": (partial(torch.save, TENSORS), "is damaged"),
    **{name: (partial(write_raw, **header), "is damaged") for name, header in HEADERS.items()},
}


@pytest.mark.parametrize(("write", "message"), UNREADABLE.values(), ids=UNREADABLE)
def test_a_file_that_cannot_be_a_checkpoint_is_refused_by_name(tmp_path, write, message):
    path = tmp_path / "a.safetensors"
    write(path)
    with pytest.raises(ValueError, match=f"{path} {message}"):
        checkpoint.load(path)


@pytest.mark.parametrize("missing", ["sh_degree", "moving", "train_seconds"])
def test_missing_metadata_is_named_with_the_file(path, missing):
    tiny.edit_metadata(path, lambda values: values.pop(missing))
    with pytest.raises(ValueError, match=f"{path} is damaged: it has no {missing}"):
        checkpoint.load(path)


WRONG = {"moving": ["yes"], "relit": [1], "sh_degree": [0.5, []], "iteration": [-1, True, 10**400]}
WRONG |= {"train_seconds": ["1", None], "rollbacks": [-1], "views": [[1]]}
WRONG |= {"times": [["0"], [1.5], [True], [math.nan]], "unit": [0, -1.0, math.nan, math.inf, True, "1"]}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in WRONG.items() for value in values])
def test_metadata_of_another_type_or_range_is_damage(path, name, value):
    tiny.edit_metadata(path, lambda values: values.update({name: value}))
    with pytest.raises(ValueError, match=f"{path} is damaged: {name} cannot be"):
        checkpoint.load(path)


def test_a_degree_that_the_config_does_not_have_is_damage(tmp_path):
    path = tmp_path / "a.safetensors"
    checkpoint.save(path, tensors_of(scene()), dataclasses.replace(METADATA, sh_degree=3))
    with pytest.raises(ValueError, match=f"{path} is damaged: sh_degree cannot be 3"):
        read_whole(path)


def test_checkpoints_without_times_are_read(path):
    tiny.edit_metadata(path, lambda values: values.pop("times"))
    assert checkpoint.load(path).metadata.times == ()


def test_the_keys_in_the_file_are_those_of_version_2(path):
    with safe_open(path, framework="pt") as file:
        values = json.loads(file.metadata()["facts"])
    assert {"moving", "relit", "iteration", "views"} <= values.keys()


def test_a_missing_tensor_is_named_with_the_file(path):
    with pytest.raises(ValueError, match=f"{path} is damaged: it has no alignments"):
        checkpoint.load(path).tensor("alignments", (3, 2))


def test_a_pickle_is_refused_and_not_executed(tmp_path):
    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    path = tmp_path / "a.safetensors"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(ValueError, match="is damaged"):
        checkpoint.load(path)
    assert not (tmp_path / "executed").exists()


def read_whole(path):
    """Reads a checkpoint and its scene."""
    loaded = checkpoint.load(path)
    checkpoint.load_scene(loaded, tiny.MODEL)


def test_a_damaged_checkpoint_is_read_or_refused_in_one_line(tmp_path):
    path = checkpoint.path_of(tmp_path, 3)
    checkpoint.save(path, tensors_of(scene()), METADATA)
    read_whole(path)
    whole, random = path.read_bytes(), np.random.default_rng(0)
    header = 8 + struct.unpack("<Q", whole[:8])[0]
    refused = 0
    for _ in range(300):
        data = bytearray(whole[: random.integers(len(whole))] if random.random() < 0.2 else whole)
        for position in random.integers(0, min(header, len(data)) if random.random() < 0.8 else len(data), 3):
            data[position] = random.choice([random.integers(256), *b'0123456789"[]{},:-'])
        path.write_bytes(data)
        message = refusal(read_whole, path)
        refused += message is not None
        assert message is None or str(path) in message
    assert refused > 200


def test_every_flipped_bit_is_refused_or_changes_nothing(tmp_path):
    path = checkpoint.path_of(tmp_path, 3)
    checkpoint.save(path, {**tensors_of(scene()), "b": torch.arange(5)}, METADATA)
    expected, whole, random = checkpoint.load(path), path.read_bytes(), np.random.default_rng(0)
    header = 8 + struct.unpack("<Q", whole[:8])[0]
    refused = 0
    for bit in [*random.integers(0, 8 * header, 200), *random.integers(8 * header, 8 * len(whole), 200)]:
        data = bytearray(whole)
        data[bit // 8] ^= 1 << (bit % 8)
        path.write_bytes(data)
        message = refusal(checkpoint.load, path)
        refused += message is not None
        if message is None:  # the header has spaces at its end
            loaded = checkpoint.load(path)
            assert tiny.differences(loaded.tensors, expected.tensors) == []
            assert loaded.metadata == expected.metadata
        else:
            assert str(path) in message
    assert refused > 395


def test_checkpoints_without_a_hash_are_read(path):
    """Version 0.2 wrote them."""
    tiny.edit_metadata(path, lambda values: None)
    with safe_open(path, framework="pt") as file:
        assert "sha256" not in file.metadata()
    loaded = checkpoint.load(path)
    assert tiny.differences(loaded.tensors, TENSORS) == []
    assert loaded.metadata == METADATA


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("adam.exp_avg.a", torch.nan, "not finite"),
        ("adam.exp_avg_sq.a", torch.inf, "not finite"),
        ("adam.exp_avg_sq.a", -1.0, "negative"),
        ("adam.step.a", -1.0, "negative"),
        ("gradients.total", torch.nan, "not finite"),
        ("gradients.count", -1.0, "negative"),
        ("poses.a", torch.nan, "not finite"),
    ],
)
def test_a_state_that_training_cannot_have_is_refused_by_name(tmp_path, name, value, reason):
    path = tmp_path / "a.safetensors"
    checkpoint.save(path, {name: torch.tensor([0.0, value])}, METADATA)
    with pytest.raises(checkpoint.DamagedCheckpointError, match=rf"{path} is damaged: {name} holds .*{reason}"):
        checkpoint.load(path)


def test_folders_fifos_and_devices_are_refused(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "zero").symlink_to("/dev/zero")
    for path in (tmp_path, tmp_path / "fifo", tmp_path / "zero"):
        with pytest.raises(ValueError, match=f"{path} is not a file"):
            checkpoint.load(path)


def test_rows_of_zero_width_take_no_memory(tmp_path):
    """Such a tensor takes no byte of the file, whatever number of rows its header claims."""
    rows = 4_000_000  # 0.9 GB as Gaussians
    entry = {"dtype": "F32", "shape": [rows, 0], "data_offsets": [0, 0]}
    header = {**metadata(), "scene.static.means": entry, "scene.dynamic.means": entry}
    loaded = checkpoint.load(write_raw(tmp_path / "a.safetensors", header))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="does not hold a scene"):
        checkpoint.load_scene(loaded, tiny.MODEL)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB


def test_a_config_that_claims_a_huge_network_takes_no_memory(path):
    """0.8 GB that the file does not hold."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "does not hold a scene" in refused(tensors_of(scene()), dataclasses.replace(tiny.MODEL, width=4096, depth=8))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KiB


def refused(tensors, model=tiny.MODEL):
    path = checkpoint.Path("here.safetensors")
    with pytest.raises(ValueError, match=r"^here\.safetensors ") as caught:
        checkpoint.load_scene(checkpoint.Checkpoint(path, tensors, METADATA), model)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_scene_of_other_networks_is_refused():
    wider = dataclasses.replace(tiny.MODEL, width=16)
    assert "does not hold a scene of this run's config" in refused(tensors_of(scene()), wider)


MISSING = {"static.means": "'static.means'", "static.quats": 'Missing key(s) in state_dict: "static.quats"'}


@pytest.mark.parametrize("name", MISSING)
def test_a_scene_without_a_tensor_is_refused(name):
    tensors = tensors_of(scene())
    del tensors[f"scene.{name}"]
    assert f"does not hold a scene of this run's config: {MISSING[name]}" in refused(tensors)


@pytest.mark.parametrize("shape", [(), (3,), (4, 3), (5, 4), (5, 3, 1)])
def test_a_tensor_of_another_shape_is_refused(shape):
    tensors = {**tensors_of(scene()), "scene.static.means": torch.zeros(shape)}
    assert "does not hold a scene of this run's config" in refused(tensors)


def test_an_unexpected_tensor_is_refused():
    tensors = {**tensors_of(scene()), "scene.static.velocities": torch.zeros(5, 3)}
    assert 'Unexpected key(s) in state_dict: "static.velocities"' in refused(tensors)


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_scene_that_is_not_finite_is_refused(value):
    tensors = tensors_of(scene())
    tensors["scene.dynamic.log_scales"][1, 2] = value
    assert "holds values that are not finite" in refused(tensors)
