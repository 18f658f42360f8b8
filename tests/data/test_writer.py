"""What is written is read back, and what can't be written is named."""

import json

import cv2
import numpy as np
import pytest

from warpgs.data.writer import write_array, write_json, write_png
from warpgs.files import partial_of

WRITERS = [(write_png, np.zeros((4, 5, 3), np.uint8)), (write_json, {"a": 1}), (write_array, np.zeros(3))]


def test_pictures_keep_their_colours_and_depths(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    grey = np.random.default_rng(0).integers(0, 65536, (4, 5), dtype=np.uint16)
    write_png(tmp_path / "deep/rgb.png", rgb)
    write_png(tmp_path / "deep/grey.png", grey)
    assert np.array_equal(cv2.imread(str(tmp_path / "deep/rgb.png"))[..., ::-1], rgb)
    assert np.array_equal(cv2.imread(str(tmp_path / "deep/grey.png"), cv2.IMREAD_UNCHANGED), grey)


def test_arrays_and_json_are_read_back(tmp_path):
    write_array(tmp_path / "deep/a.npy", np.arange(6.0).reshape(2, 3))
    write_json(tmp_path / "deep/a.json", {"a": [1, 2.5]})
    assert np.array_equal(np.load(tmp_path / "deep/a.npy"), np.arange(6.0).reshape(2, 3))
    assert json.loads((tmp_path / "deep/a.json").read_text()) == {"a": [1, 2.5]}


@pytest.mark.parametrize(("write", "values"), WRITERS)
def test_a_full_disk_is_told_with_the_files_name(write, values, tmp_path):
    partial_of(tmp_path / "file").symlink_to("/dev/full")
    with pytest.raises(OSError, match="file could not be written: No space left on device"):
        write(tmp_path / "file", values)
