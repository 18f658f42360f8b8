"""``warpgs import``: the copy in the layout of warpgs is the same capture."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.data import captures, layouts
from warpgs.captures import opening
from warpgs.captures.check import check_capture
from warpgs.captures.import_capture import import_capture
from warpgs.captures.opening import load_capture
from warpgs.cli import main
from warpgs.data.capture import Capture
from warpgs.data.loaders import describe_layout, recognize
from warpgs.data.writer import plain_ids

DATASETS = {name: lambda root, name=name: captures.write_capture(root, name) for name in captures.FACTORS}
SOURCES = {**layouts.WRITERS, **DATASETS}


def assert_equal(copy: Capture, source: Capture) -> None:
    assert sorted(copy.train) == sorted(source.train)
    assert sorted(copy.val) == sorted(source.val)
    assert torch.allclose(copy.points, source.points, atol=1e-6)
    assert (copy.point_colors is None) == (source.point_colors is None)
    for name in (source.train[0], source.train[-1], *source.val[-1:]):
        a, b = copy.frame(name), source.frame(name)
        assert a.camera.time == pytest.approx(b.camera.time)
        assert torch.allclose(a.camera.viewmat, b.camera.viewmat, atol=1e-6)
        assert torch.allclose(a.camera.K, b.camera.K, rtol=1e-6)
        assert torch.equal(a.image, b.image)
        assert (a.covisible is None) == (b.covisible is None)
        if source.assumption == "masks":
            assert (a.static_mask is None) == (b.static_mask is None)
            assert b.static_mask is None or torch.equal(a.static_mask, b.static_mask)
        assert (a.inverse_depth is None) == (b.inverse_depth is None)
        if b.inverse_depth is not None:
            assert torch.allclose(a.inverse_depth, b.inverse_depth, rtol=1e-3, equal_nan=True)


@pytest.mark.parametrize("layout", SOURCES)
def test_the_copy_is_the_same_capture(tmp_path, layout):
    source = SOURCES[layout](tmp_path / "source")
    import_capture(source, tmp_path / "copy")
    assert recognize(tmp_path / "copy") == "nerfds"
    original = load_capture(source)
    if layout == "blender":  # whose times need not begin at 0 and end at 1
        names, last = [*original.train, *original.val], max(c.time for c in original.cameras.values())
        copied = load_capture(tmp_path / "copy")
        assert all(copied.cameras[n].time == pytest.approx(original.cameras[n].time / last, abs=1e-5) for n in names)
    else:
        assert_equal(load_capture(tmp_path / "copy"), original)


@pytest.mark.parametrize("size", [(1, 24), (40, 1)])
def test_images_that_are_a_line_are_refused_by_everything_that_opens_captures(root, tmp_path, size):
    for path in (root / "camera").iterdir():
        captures.edit_json(path, image_size=list(size), principal_point=[size[0] / 2, size[1] / 2])
    text = f"is {size[0]}×{size[1]}, expected at least 2 pixels per side"
    with pytest.raises(ValueError, match=text):
        import_capture(root, tmp_path / "copy")
    with pytest.raises(ValueError, match=text):
        load_capture(root)
    assert text in str(check_capture(root))
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize(
    "names",
    [
        [f".hidden_{k:05d}" for k in range(12)],
        [f"a{k:02d} " for k in range(12)],
        [f"{'.' * k}x" for k in range(12)],
        [f"line\n{k}" for k in range(12)],
        [f"{'ä' * 121}{k:02d}" for k in range(12)],
    ],
    ids=["hidden", "trailing space", "all the same without dots", "line break", "long"],
)
def test_the_check_accepts_the_names_of_frames_that_are_imported(tmp_path, names):
    source = tmp_path / "source"
    transforms = layouts.write_nerfstudio(source) / "transforms.json"
    fields = json.loads(transforms.read_text())
    for entry, name in zip(fields["frames"], names, strict=True):
        path = source / entry["file_path"]
        entry["file_path"] = f"images/{name}.png"
        path.rename(source / entry["file_path"])
    captures.write_json(transforms, fields)
    lines = []
    import_capture(source, tmp_path / "copy", log=lines.append)
    report = check_capture(tmp_path / "copy")
    assert "not fit" not in str(report)
    assert "11 frames to train on, 1 to evaluate" in str(report)
    assert any("ids that files cannot have" in line for line in lines)


@pytest.mark.parametrize(
    ("names", "ids"),
    [
        (["a", "b c"], ["a", "b c"]),
        ([".a", "a"], ["a_2", "a"]),
        (["..", "."], ["frame", "frame_2"]),
        (["a/b", "a_b", "a\\b"], ["a_b_2", "a_b", "a_b_3"]),
    ],
)
def test_ids_in_the_copy_are_plain_and_distinct(names, ids):
    assert [*plain_ids(names).values()] == ids


def test_estimated_masks_stay_estimates(root, tmp_path):
    captures.edit_json(root / "dataset.json", masks="estimated")
    import_capture(root, tmp_path / "copy")
    assert load_capture(tmp_path / "copy").estimated_masks


def test_the_command_says_what_it_read(tmp_path, capsys):
    source = layouts.write_colmap(tmp_path / "source")
    assert main(["import", str(source), str(tmp_path / "copy"), "--holdout", "6"]) == 0
    out = capsys.readouterr().out
    assert "is read as colmap: 12 frames, 12 with masks, 12 with depth, 2 for evaluation, 60 points" in out
    assert load_capture(tmp_path / "copy").val == ("frame_00003", "frame_00009")
    assert main(["import", str(source), str(tmp_path / "copy")]) == 2
    assert "is not an empty folder" in capsys.readouterr().err


def test_all_frames_are_for_training_on_request(tmp_path):
    import_capture(layouts.write_megasam(tmp_path / "source"), tmp_path / "copy", holdout=0)
    assert len(load_capture(tmp_path / "copy").train) == layouts.COUNT


def test_dnerf_says_that_everything_is_dynamic(tmp_path, capsys):
    main(["import", str(layouts.write_blender(tmp_path / "source")), str(tmp_path / "copy")])
    assert "--assume dynamic" in capsys.readouterr().out
    assert load_capture(tmp_path / "copy").frame("train_r_000").static_mask is None


@pytest.mark.parametrize("holdout", [-1, 1, 24])
def test_an_impossible_holdout_is_refused(tmp_path, holdout):
    with pytest.raises(ValueError, match=r"--holdout (must be|24 keeps none of 12)"):
        import_capture(layouts.write_megasam(tmp_path / "source"), tmp_path / "copy", holdout=holdout)


def test_a_folder_of_the_user_beside_the_target_stays(tmp_path):
    (tmp_path / "copy.partial").mkdir()
    (tmp_path / "copy.partial/mine").write_text("mine")
    import_capture(layouts.write_colmap(tmp_path / "source"), tmp_path / "copy")
    assert {path.name for path in tmp_path.iterdir()} == {"source", "copy", "copy.partial"}
    assert (tmp_path / "copy.partial/mine").read_text() == "mine"


def test_a_target_that_fills_meanwhile_is_not_replaced(tmp_path, monkeypatch):
    def write(folder, *_):
        (tmp_path / "copy").mkdir()
        (tmp_path / "copy/mine").write_text("mine")

    monkeypatch.setattr("warpgs.captures.import_capture._write_index", write)
    with pytest.raises(OSError, match="copy"):
        import_capture(layouts.write_colmap(tmp_path / "source"), tmp_path / "copy")
    assert [path.name for path in (tmp_path / "copy").iterdir()] == ["mine"]


def test_a_source_with_a_damaged_frame_leaves_nothing_behind(tmp_path):
    source = layouts.write_colmap(tmp_path / "source")
    (source / "images/frame_00007.png").write_bytes(b"x")
    with pytest.raises(ValueError, match=r"frame_00007\.png is not a PNG"):
        import_capture(source, tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["source"]


def test_point_colors_that_do_not_fit_the_points_are_refused(root):
    captures.write_array(root / "point_colors.npy", np.zeros((3, 3), np.uint8))
    with pytest.raises(ValueError, match=r"point_colors\.npy must hold bytes of shape \[10, 3\]"):
        load_capture(root)


def test_the_layout_named_in_the_index_comes_first(tmp_path):
    root = captures.write_capture(tmp_path / "toy", "iphone")
    assert recognize(root) == "iphone"
    captures.edit_json(root / "dataset.json", layout="nerfds")
    assert recognize(root) == "nerfds"
    for other in ("polaroid", 7, None):
        captures.edit_json(root / "dataset.json", layout=other)
        assert recognize(root) == "iphone"


def test_masks_in_every_size_do_not_make_a_hypernerf_capture_one_of_nerfds(tmp_path):
    root = captures.write_capture(tmp_path / "toy", "hypernerf")
    for size in ("1x", "4x", "8x"):
        (root / "rgb" / size).mkdir()
    for size in ("1x", "2x", "4x"):
        (root / "resized_mask" / size).mkdir(parents=True)
    assert recognize(root) == "hypernerf"


def write_sizes(root, images, masks):
    """A capture of the layout of Nerfies, with empty folders of more sizes, that does not name its layout."""
    captures.write_capture(root, "hypernerf")
    for part, sizes in (("rgb", images), ("resized_mask", masks)):
        for size in sizes:
            (root / part / size).mkdir(parents=True, exist_ok=True)
    return root


SEVERAL_SIZES = pytest.mark.parametrize(
    ("images", "masks"),
    [(["1x", "4x", "8x"], ["1x"]), (["1x"], ["1x", "2x"]), (["1x", "4x"], ["1x", "2x", "4x"])],
    ids=["masks in full size", "two sizes", "three sizes"],
)


def layout_of(root, dataset=None):
    return describe_layout(root, dataset or recognize(root), dataset)


@SEVERAL_SIZES
@pytest.mark.parametrize(("size", "layout"), [([480, 270], "nerfds"), ([1072, 1920], "hypernerf")])
def test_images_of_the_released_size_tell_nerfds_from_hypernerf(tmp_path, images, masks, size, layout):
    root = write_sizes(tmp_path / "toy", images, masks)
    for path in (root / "camera").iterdir():
        captures.edit_json(path, image_size=size)
    assert layout_of(root) == recognize(root) == layout


@SEVERAL_SIZES
@pytest.mark.parametrize("folder", ["train_camera", "vrig_camera"])
def test_folders_of_cameras_that_only_nerfds_has_tell_it_from_hypernerf(tmp_path, images, masks, folder):
    root = write_sizes(tmp_path / "toy", images, masks)
    (root / folder).mkdir()
    assert layout_of(root) == recognize(root) == "nerfds"


@SEVERAL_SIZES
def test_a_capture_that_prepare_wrote_before_it_named_layouts_is_not_a_guess(tmp_path, images, masks):
    root = write_sizes(tmp_path / "toy", images, masks)
    (root / "prepare.json").write_text("{}")
    assert layout_of(root) == recognize(root) == "nerfds"


@SEVERAL_SIZES
def test_a_layout_that_is_guessed_is_said_to_be_a_guess_until_it_is_named(tmp_path, images, masks):
    root = write_sizes(tmp_path / "toy", images, masks)
    name = recognize(root)
    other = "hypernerf" if name == "nerfds" else "nerfds"
    assert layout_of(root) == f"{name}, a guess that --dataset {other} overrides"
    assert layout_of(root, other) == other
    captures.edit_json(root / "dataset.json", layout=other)
    assert layout_of(root) == other


def test_a_guess_reads_well_in_the_summary_of_an_import(tmp_path, capsys):
    root = captures.write_capture(tmp_path / "toy", "nerfds")
    (root / "rgb/2x").mkdir(exist_ok=True)
    assert main(["import", str(root), str(tmp_path / "copy")]) == 0
    assert "is read as nerfds, a guess that --dataset hypernerf overrides: 6 frames, " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("images", "masks", "layout"),
    [
        (["1x", "4x"], ["1x"], "nerfds"),
        (["1x", "4x"], ["1x", "2x"], "hypernerf"),
        (["1x"], ["2x"], "hypernerf"),
        (["1x"], ["1x", "2x"], "nerfds"),
    ],
    ids=["full size only", "full size and others", "others only", "no quarter of the size"],
)
def test_the_sizes_of_masks_decide_a_layout_that_nothing_else_does(tmp_path, images, masks, layout):
    assert recognize(write_sizes(tmp_path / "toy", images, masks)) == layout


def test_a_camera_that_is_not_json_does_not_keep_a_layout_from_being_recognized(tmp_path):
    root = write_sizes(tmp_path / "toy", ["1x", "4x"], ["1x"])
    for path in (root / "camera").iterdir():
        path.write_text("{")
    assert layout_of(root) == "nerfds, a guess that --dataset hypernerf overrides"


def test_a_built_in_capture_is_imported_by_its_name(tmp_path, monkeypatch):
    root, lines = layouts.write_llff(tmp_path / "source"), []
    monkeypatch.setattr(opening, "builtin_folder", lambda *_: root)
    import_capture(Path("builtin:studio"), tmp_path / "copy", log=lines.append)
    assert lines[0].startswith("builtin:studio is read as llff: ")
    assert load_capture(tmp_path / "copy").train


def test_a_layout_without_masks_is_not_a_guess(tmp_path):
    assert layout_of(write_sizes(tmp_path / "toy", ["1x", "4x"], [])) == "hypernerf"


@pytest.mark.parametrize("size", [None, "480×270", [[480], 270]])
def test_a_damaged_size_of_images_does_not_keep_a_layout_from_being_recognized(tmp_path, size):
    root = write_sizes(tmp_path / "toy", ["1x"], ["1x", "2x"])
    for path in (root / "camera").iterdir():
        captures.edit_json(path, image_size=size)
    assert recognize(root) == "nerfds"


def test_the_index_is_complete(tmp_path):
    import_capture(layouts.write_llff(tmp_path / "source"), tmp_path / "copy")
    metadata = json.loads((tmp_path / "copy/metadata.json").read_text())
    assert metadata["00007_cam02"] == {"time_id": 7, "warp_id": 7, "appearance_id": 7, "camera_id": 2}
    assert metadata["frame_00007"]["camera_id"] == 0


@pytest.mark.parametrize(
    "fields", [{"k1": -0.2, "p1": 0.01}, {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k4": 0.01}]
)
def test_frames_stay_as_recorded_with_their_lens_and_depth(tmp_path, fields):
    source = layouts.write_nerfstudio(tmp_path / "source")
    captures.edit_json(source / "transforms.json", **fields)
    import_capture(source, tmp_path / "copy")
    before, after = load_capture(source), load_capture(tmp_path / "copy")
    name = before.train[1]
    a, b = before.frame(name), after.frame(name)
    assert torch.equal(a.image, b.image)
    assert torch.allclose(a.camera.K, b.camera.K)
    assert a.camera.distortion.lens == b.camera.distortion.lens
    assert torch.allclose(a.camera.distortion.coefficients, b.camera.distortion.coefficients)
    known = a.inverse_depth.isfinite()
    assert torch.allclose(a.inverse_depth[known], b.inverse_depth[known], rtol=2e-3)


def rig_of(tmp_path):
    """A capture of three cameras with three frames each, of which the first is for evaluation."""
    root = tmp_path / "source"
    for i in range(3):
        for k in range(3):
            captures.write_png(root / f"cam{i}/{k}.png", layouts.image(3 * i + k))
    layouts.write_llff(tmp_path / "poses", motion=False)
    rows = np.load(tmp_path / "poses/poses_bounds.npy")[:3]
    captures.write_array(root / "poses_bounds.npy", rows)
    return root


@pytest.mark.parametrize(
    ("options", "val"),
    [
        ({}, ["cam00_00000", "cam00_00001", "cam00_00002"]),
        ({"holdout_camera": (2,)}, ["cam02_00000", "cam02_00001", "cam02_00002"]),
        ({"holdout_camera": (0, 1), "holdout": 3}, [*(f"cam0{i // 3}_0000{i % 3}" for i in range(6)), "cam02_00001"]),
        ({"holdout": 3}, ["cam00_00001", "cam01_00001", "cam02_00001"]),
    ],
)  # fmt: skip
def test_cameras_are_held_out(tmp_path, options, val):
    import_capture(rig_of(tmp_path), tmp_path / "copy", **options)
    capture = load_capture(tmp_path / "copy")
    assert sorted(capture.val) == val
    assert len(capture.train) + len(capture.val) == 9


@pytest.mark.parametrize(
    ("ids", "message"),
    [((7,), "--holdout-camera 7: there are only the cameras 0, 1, 2"), ((0, 1, 2), "leaves no camera to train on")],
)
def test_a_camera_that_cannot_be_held_out_is_refused(tmp_path, ids, message):
    with pytest.raises(ValueError, match=message):
        import_capture(rig_of(tmp_path), tmp_path / "copy", holdout_camera=ids)
    assert not (tmp_path / "copy").exists()
