"""COLMAP models that COLMAP does not read are read where it is clear, or refused in words of our own."""

import re
import shutil

import numpy as np
import pycolmap
import pytest

from tests.data import layouts
from tests.data.captures import refused
from warpgs.captures.opening import load_capture


@pytest.fixture
def text(edited):
    """A capture whose model is text, and a function that replaces a part of one of its files."""
    root = edited("colmap as text")

    def replace(name, old, new):
        path = root / f"sparse/0/{name}.txt"
        content = path.read_text()
        changed = old(content) if callable(old) else content.replace(old, new, 1)
        assert changed != content
        path.write_text(changed)

    return root, replace


def with_decimals(content):
    return re.sub(r" (\d+) 20 30 0.5", r" \1.0 20.0 30.0 0.5", content)


def test_colours_with_decimals_are_read_and_noted(text, written):
    root, replace = text
    replace("points3D", with_decimals, "")
    capture, expected = load_capture(root), load_capture(written["colmap"])
    assert np.array_equal(capture.point_colors, expected.point_colors)
    assert np.allclose(capture.points, expected.points, atol=1e-6)
    assert all((capture.cameras[n].viewmat - c.viewmat).abs().max() < 1e-6 for n, c in expected.cameras.items())
    (note,) = capture.notes
    assert note.endswith("points3D.txt has colours with decimals, read as whole numbers")


def test_tracks_without_features_are_left_out(text):
    root, replace = text
    replace("images", lambda content: content.replace("1.5 2.5 -1", ""), "")
    replace("points3D", lambda content: content.replace(" 0.5\n", " 0.5 1 0 2 0\n"), "")
    capture = load_capture(root)
    assert len(capture.points) == len(layouts.POINTS)
    assert "tracks of features that images.txt does not have" in capture.notes[0]


def test_images_with_one_line_each_are_read(text):
    root, replace = text
    replace("images", lambda content: content.replace("1.5 2.5 -1", "").replace("\n\n", "\n"), "")
    capture = load_capture(root)
    assert list(capture.cameras) == layouts.NAMES
    assert "images.txt has one line per image" in capture.notes[0]


@pytest.mark.parametrize("decimals", [False, True])
def test_names_with_spaces_are_read_in_full(text, decimals):
    root, replace = text
    for k, name in enumerate(layouts.NAMES):
        (root / f"images/{name}.png").rename(root / f"images/photo of me {k:02d} (1).png")
        replace("images", f"{name}.png", f"photo of me {k:02d} (1).png")
    if decimals:
        replace("points3D", with_decimals, "")
    capture = load_capture(root)
    assert capture.train[:2] == ("photo of me 00 (1)", "photo of me 01 (1)")
    assert np.array_equal(capture.frame("photo of me 07 (1)").image, layouts.image(7))


TEXT = [
    (
        "points3D",
        " 0 20 30 0.5",
        " 0.1 0.2 0.3 0.5",
        r"points3D\.txt, line 2: colours must be whole numbers from 0 to 255",
    ),
    (
        "points3D",
        " 0 20 30 0.5",
        " 0 20",
        r"points3D\.txt, line 2: expected POINT3D_ID X Y Z R G B ERROR TRACK, got '0 ",
    ),
    (
        "points3D",
        " 0 20 30 0.5",
        " 0 20 30 0.5 77 0",
        r"line 2: the track refers to feature 0 of image 77, which is missing",
    ),
    ("points3D", " 0 20 30 0.5", " 0 20 30 0.5 2 9", r"feature 9 of image 2, which has 1 features in images\.txt"),
    ("images", " 3 frame_00000", " 7 frame_00000", r"images\.txt, line 2: cameras\.txt has no camera 7"),
    ("images", " 3 frame_00000.png", "", r"images\.txt, line 2: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
    ("cameras", "OPENCV", "BROWN", r"cameras\.txt, line 2: .* BROWN is not supported; COLMAP has no such model"),
    ("cameras", "OPENCV", "SPHERE", r"cameras\.txt, line 2: .*SPHERE is not supported: it is one of 360° images"),
    ("cameras", "OPENCV", "PINHOLE", r"cameras\.txt, line 2: PINHOLE has 4 parameters, got 8"),
    ("cameras", "3 OPENCV 40", "3 OPENCV wide", r"cameras\.txt, line 2: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS"),
]


@pytest.mark.parametrize(("name", "old", "new", "message"), TEXT, ids=[f"{t[0]}-{k}" for k, t in enumerate(TEXT)])
def test_a_line_that_does_not_fit_is_named(text, name, old, new, message):
    root, replace = text
    replace(name, old, new)
    refused(root, message)


def four_files(root):
    """Rewrites the model as COLMAP does now, with rigs and frames."""
    folder = root / "sparse/0"
    pycolmap.Reconstruction(str(folder)).write_binary(str(folder))
    return folder


@pytest.mark.parametrize(("removed", "kept"), [("frames", "rigs"), ("rigs", "frames")])
def test_rigs_or_frames_alone_are_not_needed(edited, written, removed, kept):
    root = edited("colmap")
    (four_files(root) / f"{removed}.bin").unlink()
    capture, expected = load_capture(root), load_capture(written["colmap"])
    assert f"has {kept}.bin but not {removed}.bin: poses are read from images.bin" in capture.notes[0]
    assert all((capture.cameras[n].viewmat - c.viewmat).abs().max() < 1e-6 for n, c in expected.cameras.items())


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_missing_file_of_a_model_is_named(edited, name):
    root = edited("colmap")
    (root / f"sparse/0/{name}.bin").unlink()
    refused(root, rf"sparse/0 is not a COLMAP model: {name}\.bin must lie with its other files; copy all files")


def test_files_of_two_models_are_refused_without_the_words_of_colmap(edited, tmp_path):
    root = edited("colmap")
    other = layouts.write_colmap(tmp_path / "other")
    folder = four_files(other)
    for name in ("rigs", "frames"):
        shutil.copy(folder / f"{name}.bin", root / f"sparse/0/{name}.bin")
    path = root / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    data[8] = 9
    path.write_bytes(data)
    refused(root, r"files that fit together: one refers to a camera, image or point that another lacks; copy all files")


def test_names_in_another_encoding_are_refused_by_number(text):
    root, _ = text
    path = root / "sparse/0/images.txt"
    path.write_bytes(path.read_bytes().replace(b"frame_00003", "Küche".encode("latin-1")))
    refused(root, r"the name of image 4 is not in UTF-8: b'K\\xfcche\.png'")


def test_equirectangular_images_of_colmap_are_read(edited):
    root = edited("colmap")
    camera = pycolmap.Camera(model="EQUIRECTANGULAR", width=40, height=24, params=[40.0, 24.0])
    model = pycolmap.Reconstruction(str(root / "sparse/0"))
    camera.camera_id = 3
    model.cameras[3].model, model.cameras[3].params = camera.model, camera.params
    model.write_binary(str(root / "sparse/0"))
    assert load_capture(root).cameras["frame_00003"].distortion.lens == "equirectangular"
