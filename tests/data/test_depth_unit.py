"""Depth in another unit than that of the cameras, and inverse depth where depth is expected."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import edit_json, write_array, write_json
from tests.lens_captures import CAMERAS, recorded
from tests.prepare import boards
from warpgs.captures.check import check_capture, quick_findings
from warpgs.captures.opening import load_capture
from warpgs.data.depth_unit import fit_unit

pytestmark = pytest.mark.usefixtures("without_motion")

COUNT = 16


@pytest.fixture
def write(with_boards, tmp_path):
    """Writes the boards in nerfstudio's layout with other depth, and with the points if asked for."""

    def write_studio(convert, with_points=False, **fields):
        root, frames = tmp_path / "studio", []
        for k, view in enumerate(boards.poses(COUNT)):
            name = f"shot{k:03d}"
            depth = convert(boards.depth(view))
            if depth.dtype == np.uint16:
                (root / "depth").mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(root / f"depth/{name}.png"), depth)
            else:
                write_array(root / f"depth/{name}.npy", depth)
            (root / "images").mkdir(exist_ok=True)
            shutil.copy(with_boards / f"rgb/1x/{name}.png", root / f"images/{name}.png")
            pose = np.vstack([view, [0, 0, 0, 1]])
            matrix = np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])
            suffix = "png" if depth.dtype == np.uint16 else "npy"
            files = {"file_path": f"images/{name}.png", "depth_file_path": f"depth/{name}.{suffix}"}
            frames.append({**files, "transform_matrix": matrix.tolist(), "time": k})
        if with_points:
            points = np.load(with_boards / "points.npy")
            rows = "".join(f"{x} {y} {z}\n" for x, y, z in points)
            names = "".join(f"property float {axis}\n" for axis in "xyz")
            header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{names}end_header\n"
            (root / "points.ply").write_text(header + rows)
            fields["ply_file_path"] = "points.ply"
        lens = {"fl_x": boards.FOCAL, "fl_y": boards.FOCAL, "w": 256, "h": 192, "cx": 128, "cy": 96}
        write_json(root / "transforms.json", {**lens, **fields, "frames": frames})
        return root

    return write_studio


def of_depth(root):
    """Warnings about depth of the check, which are also those before training."""
    capture = load_capture(root).assuming("static")
    before = [f.text for f in quick_findings(capture) if f.topic == "depth"]
    found = [f.text for f in check_capture(root).findings if (f.topic, f.level) == ("depth", "warning")]
    assert before == found
    return " | ".join(found)


DISPARITIES = "it seems to be inverse depth or disparities, but must be depth"

METRES = {"depth_unit_scale_factor": 1.0}


@pytest.mark.parametrize(
    ("convert", "fields", "text"),
    [
        (lambda z: z.astype(np.float32), {}, "depth_unit_scale_factor in transforms.json (0.001), must be about 1,000"),
        (lambda z: (1000 * z).astype(np.uint16), METRES, "(1), must be about 0.001 times as large"),
        (lambda z: (5000 * z).astype(np.uint16), {}, "(0.001), must be about 0.2 times as large"),
        (lambda z: (0.25 * z).astype(np.float32), METRES, "(1), must be about 4 times as large"),
        (
            lambda z: (1 / z).astype(np.float32),
            METRES,
            DISPARITIES,
        ),
        (lambda z: (5e4 / z).astype(np.uint16), {}, DISPARITIES),
    ],
    ids=["metres", "millimetres", "TUM's unit", "another scale", "inverse", "disparities"],
)
def test_depth_that_does_not_fit_the_cameras_is_a_warning_that_names_its_unit(write, convert, fields, text):
    found = of_depth(write(convert, **fields))
    assert found.startswith("the depth of 12 of 12 frames does not fit the cameras")
    assert text in found


@pytest.mark.parametrize(
    ("convert", "fields"),
    [(lambda z: (1000 * z).astype(np.uint16), {}), (lambda z: z.astype(np.float32), METRES)],
    ids=["millimetres", "metres"],
)
def test_depth_in_the_unit_of_the_cameras_is_no_warning(write, convert, fields):
    assert of_depth(write(convert, **fields)) == ""


def test_nothing_is_said_of_the_unit_of_a_single_frame_with_depth(write):
    root = write(lambda z: z.astype(np.float32))
    frames = json.loads((root / "transforms.json").read_text())["frames"]
    for frame in frames[1:]:
        del frame["depth_file_path"]
    edit_json(root / "transforms.json", frames=frames)
    assert "unit" not in of_depth(root)


def test_any_unit_of_depth_will_do_where_there_are_points(write):
    assert of_depth(write(lambda z: (7 * z).astype(np.float32), with_points=True)) == ""


def test_disparities_where_depth_is_expected_are_called_so_where_there_are_points(write):
    found = of_depth(write(lambda z: (1 / z).astype(np.float32), with_points=True))
    assert "it shrinks with distance, as inverse depth and disparities do, but must be depth" in found


def test_depth_of_a_wall_is_not_blamed_for_points_that_are_equally_far(tmp_path, with_boards):
    root = shutil.copytree(with_boards, tmp_path / "capture")
    write_array(root / "depth/1x/shot000.npy", np.full((192, 256), 1 / 6, np.float32))
    view = boards.poses(COUNT)[0]
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 400))
    in_camera = np.stack([x, y, np.full(400, 6.0)])
    points = (view[:, :3].T @ (in_camera - view[:, 3:])).T
    write_array(root / "points.npy", points)
    dataset = {"train_ids": ["shot000"], "val_ids": [], "ids": ["shot000"], "layout": "nerfds"}
    write_json(root / "dataset.json", dataset)
    assert "points, which are all equally far from the camera" in str(check_capture(root))


def test_metric_depth_in_another_unit_is_a_warning_with_the_factor(tmp_path, with_boards):
    root = shutil.copytree(with_boards, tmp_path / "capture")
    for k, view in enumerate(boards.poses(COUNT)):
        write_array(root / f"depth/1x/shot{k:03d}.npy", (1000 * boards.depth(view)).astype(np.float32))
    report = check_capture(root, "iphone", factor=1)
    assert "depth is about 1,000 times as large as the depth of the points: it must be in metres" in str(report)


def test_inverse_depth_where_metric_depth_is_expected_is_called_so(tmp_path, with_boards):
    root = shutil.copytree(with_boards, tmp_path / "capture")
    for k, view in enumerate(boards.poses(COUNT)):
        write_array(root / f"depth/1x/shot{k:03d}.npy", (1 / boards.depth(view)).astype(np.float32))
    report = check_capture(root, "iphone", factor=1)
    assert "it shrinks with distance, as inverse depth and disparities do, but must be depth" in str(report)


@pytest.mark.parametrize("lens", CAMERAS)
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_the_unit_of_depth_is_told_through_a_lens(lens, factor):
    capture = recorded(lens, is_metric=True)
    frames = [capture.frame(name) for name in capture.train]
    found = fit_unit([dataclasses.replace(frame, inverse_depth=factor * frame.inverse_depth) for frame in frames])
    assert found.best > 0.5
    assert found.factor == pytest.approx(factor, rel=0.2)
    assert found.is_wrong == (factor != 1.0)


def test_depth_of_other_programs_fits_their_cameras(tmp_path):
    for name in ("vipe", "megasam", "nerfstudio"):
        assert "does not fit the cameras" not in str(check_capture(layouts.WRITERS[name](tmp_path / name)))
