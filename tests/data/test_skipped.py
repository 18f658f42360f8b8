"""Images that no frame is made of are counted in a note of the capture."""

import json
import shutil

import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import edit_json, write_capture, write_json, write_png
from warpgs.captures.check import check_capture, quick_findings
from warpgs.captures.import_capture import import_capture
from warpgs.captures.opening import load_capture

LAYOUTS = pytest.mark.parametrize("layout", layouts.ALL)


@LAYOUTS
def test_nothing_is_said_where_every_image_is_a_frame(written, layout):
    assert load_capture(written[layout]).notes == ()


def test_images_without_a_pose_in_the_model_are_counted(edited):
    root = edited("colmap")
    for name in ("blurred_1.jpg", "blurred_2.JPG", "other/frame_00001.png", ".trashed.jpg", "notes.txt"):
        path = root / "images" / name
        path.parent.mkdir(exist_ok=True)
        shutil.copy(root / "images/frame_00001.png", path)
    assert load_capture(root).notes == (
        "3 of 15 images in images are skipped, such as blurred_1.jpg: the model in sparse/0 has no pose for them",
    )


def test_images_that_transforms_json_does_not_list_are_counted(edited):
    root = edited("nerfstudio")
    values = json.loads((root / "transforms.json").read_text())
    write_json(root / "transforms.json", {**values, "frames": values["frames"][:10]})
    (note,) = load_capture(root).notes
    assert note == "2 of 12 images in images are skipped, such as frame_00000.png: not listed in transforms.json"


def test_frames_that_the_lists_of_a_split_do_not_name_are_counted(edited):
    root = edited("nerfstudio")
    edit_json(root / "transforms.json", train_filenames=[f"images/{name}.png" for name in layouts.NAMES[:9]])
    (note,) = load_capture(root).notes
    assert note.startswith("3 of 12 frames of transforms.json are skipped: its lists train_filenames, ")


def test_depth_beside_images_of_blender_is_not_counted_as_images(edited):
    root = edited("blender")
    write_png(root / "train/r_000_depth_0001.png", layouts.image(0))
    assert load_capture(root).notes == ()
    write_png(root / "train/r_777.png", layouts.image(0))
    (note,) = load_capture(root).notes
    assert "1 of 13 images in the capture are skipped, such as train/r_777.png: not listed in" in note


def test_masks_beside_the_images_are_not_counted_as_images(edited):
    root = edited("nerfstudio")
    values = json.loads((root / "transforms.json").read_text())
    for entry in values["frames"]:
        name = entry["mask_path"].replace("masks/", "images/mask_of_")
        (root / entry["mask_path"]).rename(root / name)
        entry["mask_path"] = name
    write_json(root / "transforms.json", values)
    assert load_capture(root).notes == ()


def test_frames_of_a_video_without_a_pose_are_counted(edited):
    root = edited("vipe")
    kept = np.array([0, 3, 7])
    np.savez(root / "pose/clip.npz", inds=kept, data=np.stack([layouts.opencv(k) for k in kept]))
    (note,) = load_capture(root).notes
    assert note == "9 of 12 frames of rgb/clip.mp4 are skipped: pose/clip.npz has no pose for them"


@pytest.mark.parametrize("dataset", ["nerfds", "hypernerf", "iphone"])
def test_images_outside_of_the_split_are_counted(tmp_path, dataset):
    root = write_capture(tmp_path / "capture", dataset)
    assert load_capture(root).notes == ()
    folder = next((root / "rgb").iterdir())
    shutil.copy(next(folder.iterdir()), folder / "another.png")
    (note,) = load_capture(root).notes
    assert note.startswith(f"1 of 7 images in rgb/{folder.name} are skipped, such as another.png: the split of ")


def test_check_training_and_import_say_what_is_left_out(edited, tmp_path):
    root, lines = edited("colmap"), []
    shutil.copy(root / "images/frame_00001.png", root / "images/unposed.png")
    (note,) = load_capture(root).notes
    assert f"note: {note}" in map(str, check_capture(root).findings)
    assert f"note: {note}" in map(str, quick_findings(load_capture(root)))
    import_capture(root, tmp_path / "imported", log=lines.append)
    assert f"note: {note}" in lines
