"""Real photographs of a hand in front of a bookshelf; only if WARPGS_HAND names their folder."""

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.captures.opening import load_capture
from warpgs.prepare.pipeline import prepare

HAND = os.environ.get("WARPGS_HAND")

pytestmark = pytest.mark.skipif(HAND is None, reason="WARPGS_HAND does not name the folder of the photographs")


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    root = tmp_path_factory.mktemp("hand") / "capture"
    prepare(Path(HAND) / "images", root)
    return load_capture(root)


def painted(polygons: list) -> np.ndarray:
    canvas = np.zeros((384, 512), np.uint8)
    for polygon in polygons:
        cv2.fillPoly(canvas, [np.array(polygon, np.int32)], 1)
    return canvas > 0


def test_every_frame_gets_a_camera_near_its_reference_position(capture):
    truth = json.loads((Path(HAND) / "poses.json").read_text())
    names = sorted(truth)
    assert len(capture.cameras) == len(names) == 86
    found = np.array([capture.cameras[f"frame_{k:06d}"].position.numpy() for k in range(86)], np.float64)
    true = np.array([truth[name] for name in names])
    error = boards.distances(found, true) / np.linalg.norm(np.ptp(true, axis=0))
    assert np.median(error) < 0.003
    assert error.max() < 0.02


def test_hand_and_sleeve_are_masked(capture):
    outlines = json.loads((Path(__file__).parent / "hand_polygons.json").read_text())
    overlaps = {}
    for name, parts in outlines.items():
        counted = ~painted(parts["ignored"])
        true = painted(parts["moving"]) & counted
        dynamic = ~capture.frame(f"frame_{int(name[5:]) - 1:06d}").static_mask.numpy() & counted
        overlaps[name] = (true & dynamic).sum() / (true | dynamic).sum()
    assert min(overlaps.values()) > 0.6, overlaps
    assert np.mean(list(overlaps.values())) > 0.75
