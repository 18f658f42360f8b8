"""Layouts of other programs: the same cameras, images and points come out of each."""

import json
import os
import shutil

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from tests.data import layouts
from tests.data.captures import edit_json, write_array, write_json, write_png
from warpgs.captures.opening import load_capture
from warpgs.config import MaskPerturbation
from warpgs.data.colmap import lens_of
from warpgs.data.images import is_transparent
from warpgs.data.lens import Lens
from warpgs.data.loaders import blender, recognize
from warpgs.data.loaders.posed import plain_names

LAYOUTS = pytest.mark.parametrize("layout", layouts.ALL)
INDEX = {name: k for k, name in enumerate(layouts.NAMES)}
SOME_POINTS = layouts.POINTS[:8]


def index_of(layout: str, name: str) -> int:
    """The index of a camera in ``layouts`` by its id in a capture."""
    if layout == "blender":
        split, _, number = name.split("_")
        return 2 * int(number) + (split == "test")
    if "cam02" in name:
        return 1
    return INDEX.get(name, int(name[-5:]))


def scene_from_world(layout, capture, points: np.ndarray) -> torch.Tensor:
    """Points in scene units, by the similarity that takes two camera centres to those of the capture."""
    names = [name for name in capture.cameras if "cam02" not in name]
    first, last = names[0], names[-1]
    scene = [capture.cameras[name].position.double().numpy() for name in (first, last)]
    world = [layouts.camera(index_of(layout, name))[0] for name in (first, last)]
    scale = np.linalg.norm(scene[1] - scene[0]) / np.linalg.norm(world[1] - world[0])
    return torch.tensor((points - world[0]) * scale + scene[0], dtype=torch.float32)


def pixels(camera, points: torch.Tensor) -> np.ndarray:
    viewed = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return ((viewed @ camera.K.T)[:, :2] / viewed[:, 2:]).numpy()


@LAYOUTS
def test_a_layout_is_recognized_from_its_files(written, layout):
    assert recognize(written[layout]) == layout.split(" ")[0]


@LAYOUTS
@pytest.mark.parametrize("factor", [1, 2])
def test_known_points_project_to_known_pixels(written, layout, factor):
    if layout == "llff" and factor == 2:
        pytest.skip("reduced images are in a folder of their own")
    capture = load_capture(written[layout], factor=factor)
    points = scene_from_world(layout, capture, SOME_POINTS)
    middle = layouts.SIZE[0] / 2, layouts.SIZE[1] / 2
    principal = middle if layout in ("blender", "llff") else layouts.CENTER
    for name, camera in capture.cameras.items():
        k = index_of(layout, name)
        expected = [layouts.pixel_of(point, k, principal) / factor for point in SOME_POINTS]
        assert np.allclose(pixels(camera, points), expected, atol=2e-3), name


@LAYOUTS
def test_images_are_those_of_their_cameras(written, layout):
    capture = load_capture(written[layout])
    for name in (*capture.train[:2], *capture.val[:1]):
        k = int(name[:5]) if "cam02" in name else index_of(layout, name)
        expected = layouts.image(k).astype(int)
        if layout == "blender":
            expected[~layouts.static_mask(k)] = 255
        difference = np.abs(capture.frame(name).image.numpy() - expected)
        assert difference.max() <= (8 if layout == "vipe" else 0)  # a video has losses


@LAYOUTS
def test_static_masks_are_false_where_something_moves(written, layout):
    capture = load_capture(written[layout])
    mask = capture.frame(capture.train[0]).static_mask
    if layout == "megasam":
        assert mask is None
    else:
        assert np.array_equal(~mask if layout == "blender" else mask, layouts.static_mask(0))  # blender: of its alpha


@pytest.mark.parametrize("layout", ["nerfstudio", "vipe", "megasam"])
def test_metric_depth_is_in_scene_units(written, layout):
    capture = load_capture(written[layout])
    scene = scene_from_world(layout, capture, np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]))
    scale = float((scene[1] - scene[0]).norm())
    inverse_depth = capture.frame(capture.train[0]).inverse_depth
    assert torch.allclose(inverse_depth, torch.tensor(1.0 / (layouts.DEPTH * scale)), rtol=2e-3)


@pytest.mark.parametrize("layout", ["colmap", "colmap as text", "nerfstudio"])
def test_points_and_their_colours_are_read(written, layout):
    capture = load_capture(written[layout])
    expected = scene_from_world(layout, capture, layouts.POINTS)
    assert torch.allclose(capture.points, expected, atol=1e-5)
    assert capture.point_colors.tolist() == [[j, 20, 30] for j in range(len(layouts.POINTS))]


@pytest.mark.parametrize("layout", ["vipe", "megasam"])
def test_without_points_they_are_taken_from_depth(written, layout):
    capture = load_capture(written[layout])
    camera = capture.cameras[capture.train[0]]
    row, column, depth, inside = camera.project(capture.points[:200])
    known = 1.0 / capture.frame(capture.train[0]).inverse_depth[row, column]
    assert inside.sum() > 100
    assert torch.allclose(depth[inside], known[inside], rtol=0.01)


@pytest.mark.parametrize("layout", ["colmap", "nerfstudio", "vipe", "megasam"])
def test_every_eighth_frame_is_for_evaluation_if_the_files_do_not_say(written, layout):
    capture = load_capture(written[layout])
    assert [index_of(layout, name) for name in capture.val] == [4]
    assert len(capture.train) == layouts.COUNT - 1
    times = [capture.cameras[name].time for name in capture.train]
    assert times == sorted(times)
    assert (times[0], times[-1]) == (0.0, 1.0)


def test_dnerf_is_evaluated_on_its_test_frames_at_the_times_of_the_file(written):
    capture = load_capture(written["blender"])
    assert capture.val == tuple(f"test_r_{j:03d}" for j in range(layouts.COUNT // 2))
    assert capture.cameras["test_r_002"].time == 5 / layouts.COUNT
    assert capture.assumption == capture.assuming("masks").assumption == "dynamic"
    assert capture.assuming("static").assumption == "static"


def test_dnerf_is_empty_where_it_is_transparent_and_white_there(written):
    capture = load_capture(written["blender"])
    assert capture.background == "white"
    frame = capture.frame("test_r_002")
    assert np.array_equal(frame.empty.numpy(), ~layouts.static_mask(5))
    assert (frame.image[frame.empty] == 255).all()


@pytest.mark.parametrize("factor", [1, 2])
def test_a_reduced_pixel_is_empty_if_all_of_it_is(written, factor):
    width, height = (side // factor for side in layouts.SIZE)
    parts = layouts.static_mask(5).reshape(height, factor, width, factor)
    frame = load_capture(written["blender"], factor=factor).frame("test_r_002")
    assert np.array_equal(frame.empty.numpy(), ~parts.any((1, 3)))


def test_images_without_alpha_have_a_black_background_and_no_empty_pixels(edited):
    root = edited("blender")
    for path in root.rglob("*.png"):
        write_png(path, layouts.image(0))
    capture = load_capture(root)
    assert capture.background == "black"
    assert capture.frame("train_r_000").empty is None
    assert not capture.frame("train_r_000").static_mask.any()


def test_opaque_images_with_alpha_are_decoded_once_until_they_change(edited, monkeypatch):
    root, seen = edited("blender"), []
    for path in root.rglob("*.png"):
        cv2.imwrite(str(path), np.dstack([layouts.image(0), np.full(layouts.SIZE[::-1], 255, np.uint8)]))
    monkeypatch.setattr(blender, "is_transparent", lambda path: seen.append(path) or is_transparent(path))
    assert [load_capture(root).background for _ in range(2)] == ["black", "black"]
    assert len(seen) == len(set(seen)) == len(list((root / "train").iterdir()))
    pixels = cv2.imread(str(seen[0]), cv2.IMREAD_UNCHANGED)
    pixels[0, 0, 3] = 0
    cv2.imwrite(str(seen[0]), pixels)
    os.utime(seen[0], (0, 0))
    assert load_capture(root).background == "white"


def test_over_another_colour_nothing_is_known_to_be_empty(written):
    capture = load_capture(written["blender"])
    other = capture.over("black")
    assert (capture.background, other.background) == ("white", "black")
    assert other.frame("train_r_000").empty is None
    assert not other.frame("train_r_000").static_mask.any()
    assert torch.equal(other.frame("train_r_000").image, capture.frame("train_r_000").image)
    assert capture.over("white").frame("train_r_000").empty.any()


def test_an_image_is_transparent_if_a_pixel_is(written, tmp_path):
    path = tmp_path / "image.png"
    assert is_transparent(written["blender"] / "train/r_000.png")
    image = layouts.image(0)
    write_png(path, image)
    assert not is_transparent(path)
    opaque = np.dstack([image, np.full(image.shape[:2], 255, np.uint8)])
    cv2.imwrite(str(path), opaque)
    assert not is_transparent(path)
    opaque[0, 0, 3] = 254
    cv2.imwrite(str(path), opaque)
    assert is_transparent(path)
    palette = Image.fromarray(image).convert("P")
    palette.save(path)
    assert not is_transparent(path)
    palette.save(path, transparency=palette.getpixel((0, 0)))
    assert is_transparent(path)
    with pytest.raises(ValueError, match=r"nothing\.png is missing"):
        is_transparent(tmp_path / "nothing.png")


def test_dnerf_with_masks_is_split_by_them(edited):
    root = edited("blender")
    write_png(root / "m.png", layouts.white(layouts.static_mask(0)))
    layouts.edit_transforms(root / "transforms_train.json", mask_path="m.png")
    capture = load_capture(root)
    assert capture.assumption == "masks"
    assert np.array_equal(capture.frame("train_r_000").static_mask.numpy(), layouts.static_mask(0))


def test_nvidias_other_cameras_are_for_evaluation(written):
    capture = load_capture(written["llff"])
    assert capture.train == tuple(layouts.NAMES)
    assert capture.val == tuple(f"{k:05d}_cam02" for k in range(layouts.COUNT) if k % 12 != 1)
    assert capture.cameras["00007_cam02"].time == capture.cameras["frame_00007"].time
    assert np.array_equal(capture.frame("00007_cam02").static_mask.numpy(), layouts.static_mask(7))


def test_llff_without_motion_holds_every_eighth_frame_out(tmp_path):
    capture = load_capture(layouts.write_llff(tmp_path / "fern", motion=False))
    assert capture.val == ("frame_00004",)
    assert capture.frame("frame_00000").static_mask is None


def test_llff_images_of_another_size_have_their_own_folder(edited):
    root = edited("llff")
    for k, name in enumerate(layouts.NAMES):
        write_png(root / f"images_20x12/{name}.png", cv2.resize(layouts.image(k), (20, 12)))
    capture = load_capture(root)
    assert capture.cameras["frame_00003"].size == (20, 12)
    assert capture.cameras["frame_00003"].K[0, 0] == pytest.approx(layouts.FOCAL / 2)
    assert load_capture(root, factor=1).cameras["frame_00003"].size == layouts.SIZE


def test_a_colmap_model_beside_llff_poses_is_preferred_to_them(edited):
    root = edited("colmap")
    write_array(root / "poses_bounds.npy", np.zeros((2, 17)))
    assert recognize(root) == "colmap"
    (root / "motion_masks").mkdir()
    assert recognize(root) == "llff"


def test_reduced_images_of_colmap_captures_are_used_if_they_exist(edited):
    root = edited("colmap")
    half = np.full((12, 20, 3), 7, np.uint8)
    for name in layouts.NAMES:
        write_png(root / f"images_2/{name}.png", half)
    assert (load_capture(root, factor=2).frame("frame_00000").image == 7).all()
    assert not (load_capture(root, factor=1).frame("frame_00000").image == 7).all()


def test_images_are_averaged_and_masks_keep_what_moves_where_they_are_reduced(written):
    frame = load_capture(written["colmap"], factor=4).frame("frame_00000")
    blocks = layouts.image(0).reshape(6, 4, 10, 4, 3).mean((1, 3))
    assert np.abs(frame.image.numpy() - blocks).max() <= 0.51
    dynamic = ~layouts.static_mask(0).reshape(6, 4, 10, 4).all((1, 3))
    assert np.array_equal(~frame.static_mask.numpy(), dynamic)


def test_images_of_nerfstudio_are_read_as_they_are_with_the_distortion_of_their_lens(edited):
    root = edited("nerfstudio")
    layouts.edit_transforms(root / "transforms.json", k1=0.6)
    capture = load_capture(root)
    bent = layouts.NAMES[-1]  # frames are listed in reverse
    assert Lens.of(capture.cameras[bent]).coefficients == pytest.approx((0.6,))
    assert capture.cameras[layouts.NAMES[1]].distortion is None
    assert {float(camera.K[0, 0]) for camera in capture.cameras.values()} == {layouts.FOCAL}
    assert np.array_equal(capture.frame(bent).image.numpy(), layouts.image(INDEX[bent]))


@pytest.mark.parametrize("fields", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_fisheye_images_of_nerfstudio_are_read_as_they_are(edited, fields):
    root = edited("nerfstudio")
    edit_json(root / "transforms.json", **fields, k1=0.1, k4=0.01)
    frame = load_capture(root).frame(layouts.NAMES[2])
    lens = Lens.of(frame.camera)
    assert lens.model == "fisheye"
    assert lens.coefficients == pytest.approx((0.1, 0.0, 0.0, 0.01))
    assert np.array_equal(frame.image.numpy(), layouts.image(2))


@pytest.mark.parametrize("fields", [{"k1": -0.3, "k2": 0.05}, {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}])
def test_points_of_depth_are_where_a_lens_sees_them(edited, fields):
    root = edited("nerfstudio")
    edit_json(root / "transforms.json", ply_file_path=None, **fields)
    capture = load_capture(root)
    first = capture.frame(capture.in_time(capture.cameras)[0])
    row, column, depth, inside = first.camera.project(capture.points)
    error = (first.inverse_depth[row, column] * depth - 1.0).abs()[inside]
    assert (error < 1e-5).sum() > 50  # those that were taken from its own pixels


@LAYOUTS
def test_without_distortion_cameras_look_at_the_centre_of_the_image(written, layout):
    capture, bent = load_capture(written[layout], distortion=False), load_capture(written[layout])
    name = capture.train[1]
    frame, other = capture.frame(name), bent.frame(name)
    expected = [[layouts.FOCAL, 0, layouts.SIZE[0] / 2], [0, layouts.FOCAL, layouts.SIZE[1] / 2], [0, 0, 1]]
    assert torch.allclose(frame.camera.K, torch.tensor(expected, dtype=torch.float32), atol=1e-4)
    assert torch.equal(frame.camera.viewmat, other.camera.viewmat)
    assert torch.equal(frame.image, other.image)


@pytest.mark.parametrize(
    "fields",
    [
        {"k1": 0.6, "p1": 0.02},
        {"k1": -50.0},  # folds back, as does the last one
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.1},
        {"camera_model": "OPENCV_FISHEYE", "k1": -3.0},
    ],
)
def test_without_distortion_frames_of_nerfstudio_are_those_of_the_files(edited, written, fields):
    root = edited("nerfstudio")
    edit_json(root / "transforms.json", **fields)
    capture, plain = load_capture(root, distortion=False), load_capture(written["nerfstudio"])
    for name in layouts.NAMES:
        frame, expected = capture.frame(name), plain.frame(name)
        assert np.array_equal(frame.image.numpy(), layouts.image(INDEX[name]))
        for part in ("static_mask", "inverse_depth"):
            assert torch.equal(getattr(frame, part), getattr(expected, part))
        assert frame.camera.K[0, 0] == layouts.FOCAL
        assert frame.camera.K[:2, 2].tolist() == [layouts.SIZE[0] / 2, layouts.SIZE[1] / 2]


def test_without_distortion_points_of_depth_are_those_of_pinhole_cameras(edited, tmp_path):
    plain = edited("nerfstudio")
    edit_json(plain / "transforms.json", ply_file_path=None)
    bent = shutil.copytree(plain, tmp_path / "bent")
    edit_json(bent / "transforms.json", k1=-50.0)
    points = load_capture(bent, distortion=False).points
    assert len(points) > 100
    assert torch.equal(points, load_capture(plain).points)


@pytest.mark.parametrize(
    ("layout", "path"),
    [
        ("colmap", "sparse/0/cameras.bin"),
        ("blender", "transforms_train.json"),
        ("blender", "transforms_test.json"),
        ("llff", "sparse/0/cameras.bin"),
    ],
)
def test_without_distortion_no_lens_folds_back(edited, layout, path):
    root = edited(layout)
    if path.endswith(".json"):
        edit_json(root / path, k1=-50.0)
    else:
        (root / "sparse/0").mkdir(parents=True, exist_ok=True)
        layouts.write_binary_model(root / "sparse/0", [*layouts.PARAMS[:4], -50.0, 0.0, 0.0, 0.0])
    capture = load_capture(root, layout, distortion=False)
    assert capture.cameras[capture.val[0]].K[0, 0].item() == pytest.approx(layouts.FOCAL)
    assert len(capture.frame(capture.val[0]).image)


@pytest.mark.parametrize(
    ("model", "bent"),
    [
        ("OPENCV", (0.1, 0.02, 0.003, 0.001)),
        ("FULL_OPENCV", (0.1, 0.02, 0.003, 0.001, 0.01, 0.05, 0.02, 0.01)),
        ("OPENCV_FISHEYE", (0.1, 0.02, 0.03, 0.01)),
        ("RADIAL_FISHEYE", (0.1, 0.02)),
        ("SIMPLE_RADIAL_FISHEYE", (0.1,)),
    ],
)
def test_models_of_colmap_project_as_colmap_does(model, bent):
    focals = (50.0, 52.0) if "OPENCV" in model else (50.0,)
    camera = pycolmap.Camera(model=model, width=80, height=60, params=[*focals, 41.0, 29.0, *bent])
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (30, 2))
    theirs = camera.img_from_cam(np.concatenate([points, np.ones((30, 1))], 1))
    assert np.allclose(lens_of(camera).image(*points.T).T, theirs, atol=1e-9)


def test_nerfstudio_splits_and_times_are_used(edited):
    root = edited("nerfstudio")
    values = json.loads((root / "transforms.json").read_text())
    for entry in values["frames"]:
        entry["time"] = 1e12 - 10.0 * int(entry["file_path"][-9:-4])
    files = [f"images/{name}.png" for name in layouts.NAMES]
    write_json(root / "transforms.json", {**values, "train_filenames": files[:6], "test_filenames": files[8:]})
    capture = load_capture(root)
    assert capture.train == tuple(layouts.NAMES[:6])
    assert capture.val == tuple(layouts.NAMES[8:])
    assert capture.cameras["frame_00000"].time == 1.0
    assert capture.cameras["frame_00011"].time == 0.0


def test_intrinsics_may_be_a_field_of_view_and_the_size_that_of_the_image(edited):
    root = edited("nerfstudio")
    values = json.loads((root / "transforms.json").read_text())
    for entry in values["frames"]:
        for key in ("fl_x", "fl_y", "cx", "cy"):
            del entry[key]
    fields = {key: value for key, value in values.items() if key not in ("w", "h", "camera_model")}
    write_json(root / "transforms.json", {**fields, "camera_angle_x": 2 * np.arctan(20 / 45)})
    K = load_capture(root).cameras["frame_00000"].K
    assert torch.allclose(K, torch.tensor([[45.0, 0, 20], [0, 45, 12], [0, 0, 1]]))


def test_the_sky_is_static_and_frames_without_a_pose_are_left_out(edited):
    root = edited("vipe")
    kept = np.array([0, 3, 7])
    matrices = np.stack([layouts.opencv(k) for k in kept])
    np.savez(root / "pose/clip.npz", inds=kept, data=matrices)
    capture = load_capture(root)
    assert capture.train == ("00000", "00003", "00007")
    assert [round(capture.cameras[name].time, 4) for name in capture.train] == [0.0, 0.4286, 1.0]
    assert np.abs(capture.frame("00003").image.numpy() - layouts.image(3).astype(int)).max() <= 8
    (root / "mask/clip.txt").unlink()
    assert not load_capture(root).frame("00003").static_mask[:3].any()


def test_only_training_masks_are_perturbed(written):
    capture = load_capture(written["colmap"], perturbation=MaskPerturbation(dilate=2))
    assert not np.array_equal(capture.frame("frame_00000").static_mask.numpy(), layouts.static_mask(0))
    assert np.array_equal(capture.frame("frame_00004").static_mask.numpy(), layouts.static_mask(4))


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["images/b.png", "./images/c.d.jpg"], ["b", "c.d"]),
        (["../x/cam0/1.png", "../x/cam1/1.png"], ["cam0_1", "cam1_1"]),
        (["a.png", "b/a.png"], ["a", "b_a"]),
    ],
)
def test_names_of_images_in_folders_are_plain(paths, names):
    assert plain_names(paths) == names
