"""COLMAP models are read, or refused before COLMAP reads what is damaged."""

import os
import shutil
import struct
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from warpgs.data.colmap_files import NUM_PARAMETERS, REQUIRED, read_model
from warpgs.data.points import read_points
from warpgs.data.units import SceneUnits

BINARY = ("cameras", "images", "points3D", "rigs", "frames")


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A model of two rigidly mounted cameras, as binary and as text files."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 3, 20
    model, folder = pycolmap.synthesize_dataset(options), tmp_path_factory.mktemp("model")
    (folder / "bin").mkdir()
    (folder / "txt").mkdir()
    model.write(str(folder / "bin"))
    model.write_text(str(folder / "txt"))
    return folder


@pytest.fixture
def model(written, tmp_path):
    return shutil.copytree(written / "bin", tmp_path / "model")


def overwrite(path, offset, data):
    content = bytearray(path.read_bytes())
    content[offset : offset + len(data)] = data
    path.write_bytes(content)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_binary_and_text_models_are_read_in_full(written, kind):
    model = read_model(written / kind)
    assert (len(model.cameras), len(model.images), len(model.points3D)) == (2, 6, 20)


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_a_model_is_read_where_links_need_rights(written, kind, monkeypatch):
    def refuse(link, target):
        raise PermissionError(1314, "a required privilege is not held by the client", str(link))

    monkeypatch.setattr(Path, "symlink_to", refuse)
    assert len(read_model(written / kind).images) == 6


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.parametrize("cut", [1, 70, 10**9], ids=["byte", "entry", "all"])
def test_a_truncated_file_is_refused_before_colmap_reads_it(model, name, cut, monkeypatch):
    monkeypatch.setattr(pycolmap, "Reconstruction", lambda *_: pytest.fail("COLMAP was asked"))
    data = (model / f"{name}.bin").read_bytes()
    (model / f"{name}.bin").write_bytes(data[: max(0, len(data) - cut)])
    with pytest.raises(ValueError, match=rf"{name}\.bin is damaged: "):
        read_model(model)


@pytest.mark.parametrize("name", BINARY)
@pytest.mark.parametrize("count", [0, 2**40, 2**64 - 1])
def test_a_wrong_number_of_entries_is_refused_before_colmap_reads_it(model, name, count, monkeypatch):
    monkeypatch.setattr(pycolmap, "Reconstruction", lambda *_: pytest.fail("COLMAP was asked"))
    overwrite(model / f"{name}.bin", 0, struct.pack("<Q", count))
    with pytest.raises(ValueError, match=rf"{name}\.bin is damaged"):
        read_model(model)


SIZES = [("points3D", 8 + 43, -1), ("rigs", 8 + 4, -1), ("frames", 8 + 64, -1)]
MODELS = [("cameras", 8 + 4, model_id) for model_id in (-1, 18, 2**31 - 1)]


@pytest.mark.parametrize(("name", "offset", "value"), SIZES + MODELS)
def test_an_entry_that_claims_a_huge_size_or_an_unknown_camera_model_is_refused(model, name, offset, value):
    overwrite(model / f"{name}.bin", offset, struct.pack("<i", value))
    with pytest.raises(ValueError, match=rf"{name}\.bin is damaged"):
        read_model(model)


def test_every_camera_model_of_colmap_has_its_number_of_parameters():
    kinds = [kind for kind in pycolmap.CameraModelId.__members__.values() if int(kind) >= 0]
    for kind in kinds:
        camera = pycolmap.Camera.create_from_model_id(1, kind, 40.0, 40, 20)
        assert len(camera.params) == NUM_PARAMETERS[int(kind)], kind
    assert len(kinds) <= len(NUM_PARAMETERS)


@pytest.mark.parametrize(("offset", "value"), [(8, 0), (8, 2**40), (24, np.inf), (24, 1e30), (24, np.nan)], ids=str)
def test_a_camera_out_of_range_is_refused(model, offset, value):
    overwrite(model / "cameras.bin", 8 + offset, struct.pack("<Q" if isinstance(value, int) else "<d", value))
    with pytest.raises(ValueError, match=r"camera \d is out of range"):
        read_model(model)


@pytest.mark.parametrize("name", ["../../secret.png", "/secret.png", "a/../../b.png", "..\\secret.png"])
def test_a_name_that_leads_out_of_the_folder_is_refused(written, tmp_path, name):
    folder = shutil.copytree(written / "txt", tmp_path / "model")
    text = (folder / "images.txt").read_text().replace("camera000001_frame000001.png", name)
    (folder / "images.txt").write_text(text)
    with pytest.raises(ValueError, match="leads out of the folder"):
        read_model(folder)


@pytest.mark.parametrize("name", REQUIRED)
@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_a_fifo_and_a_large_file_are_refused(written, tmp_path, name, kind):
    folder = shutil.copytree(written / kind, tmp_path / "model")
    path = folder / f"{name}.{kind}"
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(ValueError, match=rf"{name}\.{kind} is not a file"):
        read_model(folder)
    path.unlink()
    with open(path, "wb") as file:
        file.truncate(8 << 30)
    with pytest.raises(ValueError, match=rf"{name}\.{kind} has 8,589,934,592 bytes, more than the maximum"):
        read_model(folder)


def test_files_that_do_not_fit_together_are_refused(model):
    overwrite(model / "points3D.bin", 8 + 51, struct.pack("<I", 12345))
    with pytest.raises(ValueError, match="is not a COLMAP model of files that fit together") as caught:
        read_model(model)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [np.nan, 1e300])
def test_points_that_are_not_finite_or_too_far_away_are_refused(model, tmp_path, value):
    overwrite(model / "points3D.bin", 8 + 8, struct.pack("<d", value))
    shutil.copytree(model, tmp_path / "root/sparse/0")
    with pytest.raises(ValueError, match=r"sparse.0(: positions| must hold) .*finite"):
        read_points(tmp_path / "root", SceneUnits(np.zeros(3), 1.0))
