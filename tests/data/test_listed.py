"""Files are found by the names that an index lists, as other systems write them; or what is near is named."""

import json
import shutil
import unicodedata

import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import edit_json, refused, write_capture, write_json, write_png
from warpgs.captures.opening import load_capture
from warpgs.data.loaders.listed import find_file
from warpgs.data.loaders.posed import plain_names


@pytest.fixture
def folder(tmp_path):
    """A folder scan with some images, masks and points."""
    root = tmp_path / "scan"
    names = ("images/a.png", "images/Küche 1.JPG", "images/shot.0001.png", "masks/a.png", "points.PLY", "both.png")
    for name in (*names, "both.jpg", "Case.png", "case.png", "my scan/b.png", "twice.png.png"):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


SPELLINGS = [
    ("images\\a.png", "images/a.png"),
    (".\\images\\a.png", "images/a.png"),
    ("./images/a.png", "images/a.png"),
    ("/images/a.png", "images/a.png"),
    (" images/a.png\r", "images/a.png"),
    ("IMAGES/A.PNG", "images/a.png"),
    ("images/a.jpg", "images/a.png"),
    ("images/a.png.png", "images/a.png"),
    ("images/a", "images/a.png"),
    ("twice.png", "twice.png.png"),
    ("images/shot.0001", "images/shot.0001.png"),
    ("images\\shot.0001", "images/shot.0001.png"),
    (unicodedata.normalize("NFD", "images/Küche 1.JPG"), "images/Küche 1.JPG"),
    ("images/Küche 1.jpeg", "images/Küche 1.JPG"),
    ("images/K%C3%BCche%201.JPG", "images/Küche 1.JPG"),
    ("images/Küche\u202f1.JPG", "images/Küche 1.JPG"),
    ("my%20scan\\b.png", "my scan/b.png"),
    ("/home/other/scan/images/a.png", "images/a.png"),
    ("/home/other/renamed/images/a.png", "images/a.png"),
    ("C:\\Users\\other\\Desktop\\images\\a.png", "images/a.png"),
    ("file:///C:/other/images/a.png", "images/a.png"),
    ("D:/elsewhere/twice.png.png", "twice.png.png"),
    ("data/scan/images/a.png", "images/a.png"),
]


@pytest.mark.parametrize(("listed", "expected"), SPELLINGS, ids=[repr(listed) for listed, _ in SPELLINGS])
def test_an_image_is_found_however_its_name_is_written(folder, listed, expected):
    assert find_file(folder, listed, ("", ".png", ".jpg", ".jpeg"), is_image=True) == folder / expected


def test_decomposed_names_of_files_are_found_by_composed_ones(tmp_path):
    (tmp_path / unicodedata.normalize("NFD", "Küche.png")).touch()
    found = find_file(tmp_path, "Küche.png")
    assert found is not None
    assert found.name == unicodedata.normalize("NFD", "Küche.png")


@pytest.mark.parametrize(
    "listed", ["CASE.png", "both.jpeg", "images/b.png", "../a.png", "images", "", "\0", "a" * 9999]
)
def test_no_file_is_found_if_none_or_two_fit(folder, listed):
    assert find_file(folder, listed, is_image=True) is None


@pytest.mark.parametrize("listed", ["/home/other/labels/twice.png.png", "images/a.jpg", "x/images/a.png"])
def test_a_file_that_is_no_image_needs_its_suffix_and_a_folder(folder, listed):
    assert find_file(folder, listed) is None


def test_escapes_do_not_lead_out_of_a_folder(folder):
    (folder.parent / "secret.png").touch()
    assert find_file(folder, "../secret.png") == folder / "../secret.png"  # as transforms.json may
    assert find_file(folder, "%2e%2e/secret.png", is_image=True) is None
    assert find_file(folder, "%2e%2e%5csecret.png", is_image=True) is None


def test_points_are_found_by_another_spelling(folder):
    assert find_file(folder, ".\\Points.ply") == folder / "points.PLY"


def test_an_exact_name_is_preferred(folder):
    assert find_file(folder, "Case.png") == folder / "Case.png"
    assert find_file(folder, "both.jpg", is_image=True) == folder / "both.jpg"


def rewritten(root, change):
    """transforms.json with every file name changed."""
    values = json.loads((root / "transforms.json").read_text())
    for entry in (values, *values["frames"]):
        for key in ("file_path", "mask_path", "depth_file_path", "ply_file_path"):
            if key in entry:
                entry[key] = change(entry[key])
    write_json(root / "transforms.json", values)


@pytest.mark.parametrize(
    "change",
    [
        lambda name: name.replace("/", "\\"),
        lambda name: "C:\\scans\\one\\" + name.replace("/", "\\"),
        lambda name: f"/home/other/nerfstudio/{name}",
        lambda name: name.upper(),
    ],
    ids=["backslashes", "Windows", "absolute", "capitals"],
)
def test_a_capture_of_another_system_is_read_as_before_and_says_so(edited, written, change):
    root, original = edited("nerfstudio"), load_capture(written["nerfstudio"])
    shutil.move(root / "points.ply", root / "masks/points.ply")
    edit_json(root / "transforms.json", ply_file_path="masks/points.ply")
    rewritten(root, change)
    capture = load_capture(root)
    (note,) = capture.notes
    assert note.startswith("37 file names in transforms.json differ from the files in spelling or place, such as ")
    assert len(capture.cameras) == len(original.cameras)
    assert np.array_equal(capture.points, original.points)
    frame, expected = (c.frame(c.train[2]) for c in (capture, original))
    assert all(
        np.array_equal(getattr(frame, k), getattr(expected, k)) for k in ("image", "static_mask", "inverse_depth")
    )


def spaced(name):
    """Frame 10 of a long name is "my frame 10"."""
    return name.replace("frame_", "my frame ").replace(" 0000", " ")


LISTED_AS = [
    lambda name: name.replace(" ", "%20"),
    lambda name: f"C:\\scans 2031\\one\\images\\{name}".replace(" ", "%20"),
    lambda name: name.replace("my", "MY").replace(" ", "\u202f"),
]


@pytest.mark.parametrize("listed_as", LISTED_AS, ids=["escapes", "Windows", "capitals"])
@pytest.mark.parametrize("dataset", ["nerfstudio", "colmap as text"])
def test_times_ids_and_order_are_those_of_the_files_that_were_found(edited, dataset, listed_as):
    root = edited(dataset)
    index = root / ("transforms.json" if dataset == "nerfstudio" else "sparse/0/images.txt")
    text = index.read_text()
    for k, name in enumerate(layouts.NAMES):
        file = spaced(name) if k else "my frame 20"
        (root / f"images/{name}.png").rename(root / f"images/{file}.png")
        listed = listed_as(f"{file}.png")
        if dataset == "nerfstudio":
            listed = json.dumps(listed if "\\" in listed else f"images/{listed}")[1:-1]
            text = text.replace(f"images/{name}.png", listed)
        else:
            text = text.replace(f"{name}.png", listed)
    index.write_text(text)
    capture = load_capture(root)
    times = {name: camera.time for name, camera in capture.cameras.items()}
    numbers = {name: int(name.removeprefix("my frame ")) for name in times}
    assert max(numbers.values()) == 20
    assert times == pytest.approx({name: (number - 1) / 19 for name, number in numbers.items()})
    assert [*capture.train] == sorted(capture.train, key=numbers.__getitem__)


def test_names_of_a_colmap_model_made_on_windows_are_found(edited):
    root = edited("colmap as text")
    (root / "images/cam1").mkdir()
    for name in layouts.NAMES:
        (root / f"images/{name}.png").rename(root / f"images/cam1/{name}.png")
    path = root / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("frame_", "cam1\\frame_"))
    capture = load_capture(root)
    assert capture.train[0] == "frame_00000"
    assert np.array_equal(capture.frame("frame_00003").image, layouts.image(3))


def test_names_of_a_colmap_model_may_begin_with_the_folder_of_images(edited):
    root = edited("colmap as text")
    path = root / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("frame_", "images/frame_"))
    assert np.array_equal(load_capture(root).frame("frame_00003").image, layouts.image(3))


@pytest.mark.parametrize(
    ("listed", "stored", "said"),
    [
        ("frame_ü.png", unicodedata.normalize("NFD", "frame_ü.png"), "letters with accents are stored differently"),
        ("frame_1\u202f0.png", "frame_1 0.png", "blanks or other characters are of another kind"),
        ("frame_10.png ", "frame_10.png", "without the blanks around it"),
    ],
)
def test_names_that_look_the_same_are_said_to_differ(edited, listed, stored, said):
    root = edited("nerfstudio")
    (root / "images/frame_00011.png").rename(root / "images" / stored)
    layouts.edit_transforms(root / "transforms.json", file_path=f"images/{listed}")
    (note,) = [note for note in load_capture(root).notes if "differ" in note]
    assert said in note


@pytest.mark.parametrize("dataset", ["nerfds", "hypernerf", "iphone"])
def test_ids_of_a_dataset_find_decomposed_names(tmp_path, dataset):
    root, before = (write_capture(tmp_path / name, dataset) for name in ("capture", "original"))
    before = load_capture(before)
    for path in sorted(root.rglob("*")):
        if path.is_file() and "_0" in path.name:
            path.rename(path.with_name(path.name.replace("_0", unicodedata.normalize("NFD", "ü_0"))))
    for path in (*root.glob("*.json"), *root.glob("splits/*.json")):
        path.write_text(path.read_text().replace("_0", "\u00fc_0"))
    after = load_capture(root)
    assert [name.replace("ü", "") for name in after.train] == list(before.train)
    for name in (*after.train, *after.val):
        frame, expected = after.frame(name), before.frame(name.replace("ü", ""))
        assert np.array_equal(frame.image, expected.image)
        for part in ("static_mask", "inverse_depth", "covisible"):
            assert (getattr(frame, part) is None) == (getattr(expected, part) is None)


def test_no_file_is_taken_for_two_names(edited):
    root = edited("nerfstudio")
    names = iter(("/a/frame_00001.png", "/b/frame_00001.png"))
    shutil.copy(root / "images/frame_00001.png", root / "frame_00001.png")
    values = json.loads((root / "transforms.json").read_text())
    for entry in values["frames"][:2]:
        entry["file_path"] = next(names)
    write_json(root / "transforms.json", values)
    refused(root, r"/b/frame_00001\.png is missing: transforms\.json lists it as file_path; there is frame_00001\.png")


def test_an_image_is_not_taken_for_a_mask(edited):
    root = edited("nerfstudio")
    layouts.edit_transforms(root / "transforms.json", mask_path="/old/labels/images/frame_00011.png")
    refused(root, r"labels/images/frame_00011\.png is missing: transforms\.json lists it as mask_path; there is depth/")


NEAR = [
    ("images/frame_0003.png", r"; images has frame_00003\.png, "),
    ("rgb/frame_00003.png", r"; there is depth/frame_00003\.png, images/frame_00003\.png, masks/frame_00003\.png"),
    ("image/IMG_1.png", r"; \S*copy has images"),
    ("images/IMG_1.png", r"; images has frame_00000\.png, frame_00001\.png, frame_00002\.png and 9 more"),
]


@pytest.mark.parametrize(("listed", "near"), NEAR)
def test_a_missing_file_is_named_with_what_is_near(edited, listed, near):
    root = edited("nerfstudio")
    layouts.edit_transforms(root / "transforms.json", file_path=listed)
    refused(root, rf"{listed} is missing: transforms\.json lists it as file_path{near}")


def test_names_with_dots_and_no_suffix_are_told_apart(edited):
    root = edited("nerfstudio")
    for path in (root / "images").iterdir():
        path.rename(path.with_name(path.name.replace("frame_0", "shot.0")))
    values = json.loads((root / "transforms.json").read_text())
    for entry in values["frames"]:
        entry["file_path"] = entry["file_path"].replace("frame_0", "shot.0").removesuffix(".png")
    write_json(root / "transforms.json", values)
    capture = load_capture(root)
    assert capture.train[:2] == ("shot.00000", "shot.00001")
    assert capture.cameras["shot.00005"].time == pytest.approx(5 / 11)


def test_names_without_a_suffix_find_their_own_masks_in_colmap_captures(edited):
    root = edited("colmap as text")
    for k, name in enumerate(layouts.NAMES):
        (root / f"images/{name}.png").rename(root / f"images/shot.{k}.png")
        (root / f"masks/{name}.png.png").rename(root / f"masks/shot.{k}.png")
    path = root / "sparse/0/images.txt"
    text = path.read_text()
    for k, name in enumerate(layouts.NAMES):
        text = text.replace(f"{name}.png", f"shot.{k}")
    path.write_text(text)
    assert np.array_equal(load_capture(root).frame("shot.7").static_mask, layouts.static_mask(7))


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["images/a.png", "images/b.JPG"], ["a", "b"]),
        (["images/a.png", "images/a.jpg"], ["a.png", "a.jpg"]),
        (["x/shot.1", "x/shot.2"], ["shot.1", "shot.2"]),
        (["x\\1305031102.4000", "x\\1305031102.4333"], ["1305031102.4000", "1305031102.4333"]),
        (["cam0/a.png", "cam1/a.png"], ["cam0_a", "cam1_a"]),
    ],
)
def test_ids_are_distinct_names_without_suffixes_of_images(paths, names):
    assert plain_names(paths) == names


def test_blender_images_of_one_name_in_several_folders_are_told_apart(edited):
    root = edited("blender")
    write_png(root / "other/r_000.png", layouts.image(3))
    layouts.edit_transforms(root / "transforms_train.json", file_path="other/r_000")
    values = json.loads((root / "transforms_train.json").read_text())
    values["frames"].append({**values["frames"][1], "file_path": "./train/r_000"})
    write_json(root / "transforms_train.json", values)
    assert {"train_other_r_000", "train_train_r_000"} <= set(load_capture(root).train)


def test_llff_images_that_differ_in_their_suffix_alone_are_told_apart(tmp_path):
    root = layouts.write_llff(tmp_path / "fern", motion=False)
    (root / "images/frame_00001.png").rename(root / "images/frame_00000.jpg")
    assert load_capture(root).train[:2] == ("frame_00000.jpg", "frame_00000.png")
