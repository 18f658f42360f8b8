"""Features are where COLMAP's own are."""

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial import cKDTree

from tests.prepare import boards
from warpgs.prepare import features
from warpgs.prepare.features import add_features, extract_features


@pytest.fixture(scope="module")
def grey():
    return cv2.cvtColor(boards.record(2)[0][0], cv2.COLOR_RGB2GRAY)


def test_features_are_where_colmap_finds_them(grey, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    options = pycolmap.FeatureExtractionOptions()
    options.sift.max_num_orientations = 1
    pycolmap.extract_features(tmp_path / "theirs.db", tmp_path, extraction_options=options, device=pycolmap.Device.cpu)
    opened = pycolmap.Database.open(tmp_path / "theirs.db")
    theirs = np.asarray(opened.read_keypoints(1))[:, :2]
    opened.close()
    found = extract_features(grey).keypoints[:, :2]
    distances, nearest = cKDTree(found).query(theirs)
    same = distances < 0.5
    assert same.mean() > 0.75
    assert np.abs((found[nearest] - theirs)[same].mean(0)).max() < 0.03
    assert 0.9 < len(found) / len(theirs) < 1.3


def test_each_place_has_one_feature_and_the_largest_are_kept(grey, monkeypatch):
    everything = extract_features(grey)
    assert len(np.unique(everything.keypoints[:, :3], axis=0)) == len(everything.keypoints)
    monkeypatch.setattr(features, "MAX_FEATURES", 50)
    few = extract_features(grey).keypoints
    assert len(few) == 50
    assert np.array_equal(few[:, 2], np.sort(everything.keypoints[:, 2])[::-1][:50])


def test_descriptors_are_root_sift(grey):
    units = extract_features(grey).descriptors / features.DESCRIPTOR_UNIT
    assert np.allclose(np.linalg.norm(units, axis=1), 1.0, atol=0.05)


def test_an_image_without_texture_has_no_features():
    assert len(extract_features(np.full((64, 64), 90, np.uint8)).keypoints) == 0


def test_grey_levels_are_those_of_colmap(tmp_path):
    """Blue and red of equal OpenCV grey differ to COLMAP: an image of both has features only with its weights."""
    image = np.zeros((96, 96, 3), np.uint8)
    image[:] = (255, 0, 0)  # blue
    for row, column in ((24, 30), (60, 44), (40, 70)):
        cv2.circle(image, (column, row), 6, (0, 0, 97), -1)  # as dark in BT.601: 0.114 · 255 = 0.299 · 97
    cv2.imwrite(str(tmp_path / "a.png"), image)
    assert np.ptp(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)) <= 1
    image = np.ascontiguousarray(image)
    theirs = pycolmap.Bitmap.read(tmp_path / "a.png", False).to_array().squeeze()
    assert np.abs(cv2.transform(image, features.LUMA).astype(int) - theirs).max() <= 1


def test_features_are_added_to_the_database(grey, tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), grey)
    pycolmap.Database.open(tmp_path / "f.db").close()
    pycolmap.import_images(tmp_path / "f.db", tmp_path, pycolmap.CameraMode.SINGLE, ["a.png"])
    add_features(tmp_path / "f.db", tmp_path, ["a.png"], features.PEAK)
    opened = pycolmap.Database.open(tmp_path / "f.db")
    stored, descriptors = np.asarray(opened.read_keypoints(1)), opened.read_descriptors(1).data
    opened.close()
    assert len(stored) == len(descriptors) > 100
    assert np.allclose(stored[:, :2], extract_features(grey).keypoints[:, :2])
