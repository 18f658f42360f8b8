"""Images that are stored turned are read upright where their cameras have that size."""

import json
import shutil

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from tests.data import layouts
from tests.data.captures import edit_json, refused, write_array, write_capture, write_json, write_png
from warpgs.captures.opening import load_capture
from warpgs.data.exif import INVERSE, orientation_of, upright

QUARTER_TURNS = [5, 6, 7, 8]
UPRIGHT_AFTER = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""Orientation that undoes each."""


def write_turned(path, pixels, orientation, **options):
    """A file that shows ``pixels`` where the EXIF orientation is obeyed."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    stored = upright(pixels, UPRIGHT_AFTER[orientation])
    Image.fromarray(stored).save(path, exif=exif, **options)


def smooth(k):
    """An image that JPEG hardly changes, different in every corner."""
    row, column = np.mgrid[: layouts.SIZE[1], : layouts.SIZE[0]]
    return np.stack([6 * row + k, 5 * column, 2 * row + 2 * column], 2).astype(np.uint8)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_pixels_are_turned_as_pillow_and_opencv_do(tmp_path, orientation, suffix):
    path = tmp_path / f"a.{suffix}"
    write_turned(path, smooth(3), orientation, **({"quality": 97, "subsampling": 0} if suffix == "jpg" else {}))
    assert orientation_of(path) == orientation
    with Image.open(path) as file:
        stored, expected = np.array(file), np.array(ImageOps.exif_transpose(file))
    assert np.array_equal(upright(stored, orientation), expected)
    assert np.abs(expected.astype(int) - smooth(3)).max() < 12
    assert np.abs(cv2.imread(str(path))[..., ::-1].astype(int) - expected).max() < 12


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_inverse_of_an_orientation_undoes_it(orientation):
    image = smooth(0)
    assert np.array_equal(upright(upright(image, orientation), INVERSE.get(orientation, orientation)), image)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8",
        b"\xff\xd8\xff\xe1\x00\x10Exif\0\0MM",
        b"\xff\xd8\xff\xe1\x00\x10Exif\0\0II*\0\xff\xff\xff\xff",
        b"\x89PNG",
    ],
)
def test_damaged_headers_have_no_orientation(tmp_path, data):
    (tmp_path / "a.jpg").write_bytes(data)
    assert orientation_of(tmp_path / "a.jpg") == 1
    assert orientation_of(tmp_path / "missing.jpg") == 1


def turn_images(root, orientation):
    for k, name in enumerate(layouts.NAMES):
        path = root / f"images/{name}.png"
        path.unlink()
        write_turned(path.with_suffix(".jpg"), smooth(k), orientation, quality=97, subsampling=0)


def is_close(image, k):
    return bool(np.abs(np.asarray(image).astype(int) - smooth(k)).max() < 12)


@pytest.mark.parametrize("layout", ["nerfstudio", "colmap", "llff"])
@pytest.mark.parametrize("orientation", QUARTER_TURNS)
def test_images_are_upright_if_their_cameras_are(edited, layout, orientation):
    root = edited(layout)
    turn_images(root, orientation)
    capture = load_capture(root, layout)
    assert all(is_close(capture.frame(name).image, k) for k, name in ((2, "frame_00002"), (7, "frame_00007")))
    notes = [note for note in capture.notes if "EXIF" in note]
    assert notes == [
        "images such as frame_00000.jpg are turned as their EXIF orientation says, to the size of their cameras"
    ]


def tag_as_turned(root):
    """Writes the images of a capture as they were, but with an orientation of EXIF that turns them."""
    for k, name in enumerate(layouts.NAMES):
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(smooth(k)).save(root / f"images/{name}.png", exif=exif)


def test_images_are_read_as_stored_if_their_cameras_are(edited):
    root = edited("nerfstudio")
    tag_as_turned(root)
    capture = load_capture(root)
    assert np.array_equal(capture.frame("frame_00002").image, smooth(2))
    assert capture.notes == ()


@pytest.mark.parametrize("layout", ["nerfstudio", "colmap"])
def test_masks_and_depth_of_the_stored_pixels_are_turned_with_their_image(edited, written, layout):
    root, original = edited(layout), load_capture(written[layout])
    turn_images(root, 6)
    for k, name in enumerate(layouts.NAMES):
        mask = upright(layouts.white(layouts.static_mask(k)), 8)
        write_png(root / ("masks/" + (f"{name}.jpg.png" if layout == "colmap" else f"{name}.png")), mask)
        depth = np.linspace(2.0, 5.0, mask.size).reshape(layouts.SIZE[::-1])
        if layout == "colmap":
            write_array(root / f"depths/{name}.npy", upright(depth.astype(np.float32), 8))
        else:
            write_png(root / f"depth/{name}.png", upright((1000 * depth).astype(np.uint16), 8))
    capture = load_capture(root)
    frame = capture.frame("frame_00002")
    assert np.array_equal(frame.static_mask, layouts.static_mask(2))
    inverse = frame.inverse_depth.numpy().ravel()
    assert (np.diff(inverse) > 0).all() if layout == "colmap" else (np.diff(inverse) <= 0).all()
    assert capture.frame("frame_00002").image.shape == original.frame("frame_00002").image.shape


def test_masks_of_the_upright_image_are_turned_back_if_its_camera_is_that_of_the_stored_pixels(edited):
    root = edited("nerfstudio")
    tag_as_turned(root)
    for k, name in enumerate(layouts.NAMES):
        write_png(root / f"masks/{name}.png", upright(layouts.white(layouts.static_mask(k)), 6))
    assert np.array_equal(load_capture(root).frame("frame_00002").static_mask, layouts.static_mask(2))


@pytest.mark.parametrize("dataset", ["nerfds", "hypernerf", "iphone"])
def test_images_of_nerfies_layouts_are_upright_with_their_masks(tmp_path, dataset):
    root, original = (write_capture(tmp_path / name, dataset) for name in ("capture", "original"))
    expected = load_capture(original)
    for path in sorted(root.glob("rgb/*/*.png")):
        write_turned(path, np.array(Image.open(path)), 8)
    for path in (*root.glob("resized_mask/*/*.png"), *root.glob("covisible/*/*/*.png")):
        write_png(path, upright(np.array(Image.open(path)), 6))
    capture = load_capture(root)
    for name in (*capture.train, *capture.val):
        frame, other = capture.frame(name), expected.frame(name)
        for part in ("image", "static_mask", "covisible"):
            first, second = getattr(frame, part), getattr(other, part)
            assert (first is None and second is None) or np.array_equal(first, second)


def test_without_a_size_the_principal_point_tells_how_images_are_turned(edited):
    root = edited("nerfstudio")
    turn_images(root, 6)
    edit_json(root / "transforms.json", w=None, h=None)
    capture = load_capture(root)
    assert capture.cameras["frame_00002"].size == layouts.SIZE
    assert is_close(capture.frame("frame_00002").image, 2)


def test_without_a_size_and_a_principal_point_images_are_read_as_stored_and_that_is_said(edited):
    root = edited("nerfstudio")
    turn_images(root, 6)
    values = json.loads((root / "transforms.json").read_text())
    for entry in values["frames"]:
        for key in ("cx", "cy", "mask_path", "depth_file_path"):
            del entry[key]
    write_json(root / "transforms.json", {k: v for k, v in values.items() if k not in "wh"})
    capture = load_capture(root)
    assert capture.cameras["frame_00002"].size == layouts.SIZE[::-1]
    (note,) = (note for note in capture.notes if "EXIF" in note)
    assert "with the EXIF orientation 6, are read as stored" in note
    assert "mogrify -auto-orient" in note


def test_an_image_that_is_upside_down_is_read_as_stored_and_that_is_said(edited):
    root = edited("colmap")
    turn_images(root, 3)
    capture = load_capture(root)
    (note,) = (note for note in capture.notes if "EXIF" in note)
    assert "frame_00000.jpg, with the EXIF orientation 3, are read as stored" in note
    assert is_close(capture.frame("frame_00002").image.numpy()[::-1, ::-1], 2)


@pytest.mark.parametrize("layout", ["nerfstudio", "llff"])
def test_exchanged_sides_are_said_to_be_the_cause(edited, layout):
    root = edited(layout)
    for path in (root / "images").iterdir():
        write_png(path, np.ascontiguousarray(layouts.image(0).swapaxes(0, 1)))
    refused(root, "24×40, but .*; its sides are exchanged: rotate its pixels by 90°", layout)


def test_exchanged_sides_of_the_nerfies_layout_are_said_to_be_the_cause(root):
    path = root / "rgb/1x/left_000001.png"
    write_png(path, np.zeros((40, 24, 3), np.uint8))
    refused(root, "the image is 24×40, expected 40×24, .*; its sides are exchanged: rotate its pixels by 90°")


def test_another_size_is_refused_with_its_orientation(edited):
    root = edited("nerfstudio")
    exif = Image.Exif()
    exif[0x0112] = 6
    path = root / "images/frame_00003.png"
    shutil.copy(path, root / "copy.png")
    Image.fromarray(np.zeros((99, 20, 3), np.uint8)).save(path, exif=exif)
    refused(root, "the image is 20×99, but the images of its camera are 40×24; its EXIF orientation is 6$")
