"""Damaged files are read or refused in one line that names them, in bounded time and memory."""

import random
import shutil

import pycolmap
import pytest

from tests.campaign.damage import damage, refusal
from tests.data.captures import read_all, write_capture
from warpgs.data.colmap_files import read_model
from warpgs.runs import checkpoint
from warpgs.runs.config_file import read_config


def campaign(original, work, read, count):
    """Damages one file of a copy of a folder ``count`` times; returns how many were refused."""
    names = sorted(path.relative_to(original) for path in original.rglob("*") if path.is_file())
    refused = 0
    for seed in range(count):
        r = random.Random(seed)
        name = r.choice(names)
        shutil.copytree(original, work)
        damage(work / name, r)
        message = refusal(lambda: read(work))
        if message is not None:
            assert str(work) in message, (seed, name, message)
            refused += 1
        shutil.rmtree(work)
    return refused


def test_damaged_captures(tmp_path, count):
    original = write_capture(tmp_path / "original")
    assert campaign(original, tmp_path / "damaged", read_all, count) > 0.5 * count


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_damaged_colmap_models(tmp_path, count, kind):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 3, 20
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "original").mkdir()
    (model.write if kind == "binary" else model.write_text)(str(tmp_path / "original"))
    assert campaign(tmp_path / "original", tmp_path / "damaged", read_model, count) > 0.5 * count


def test_damaged_checkpoints_and_configs(tmp_path, count, finished_run):
    original = tmp_path / "original"
    (original / checkpoint.FOLDER).mkdir(parents=True)
    newest = checkpoint.list_checkpoints(finished_run)[-1]
    shutil.copy(newest, original / checkpoint.FOLDER)
    shutil.copy(finished_run / "config.json", original)

    def read(run):
        config = read_config(run)
        for path in (run / checkpoint.FOLDER).iterdir():
            checkpoint.load_scene(checkpoint.load(path), config.model)

    assert campaign(original, tmp_path / "damaged", read, count) > 0.3 * count
