"""Cameras for other programs: these see points where the capture's cameras see them, at the same times."""

import dataclasses
import importlib
import json
import shutil

import numpy as np
import pytest
import torch

from tests.data.captures import edit_json
from warpgs.cameras import Camera, intrinsic_matrix
from warpgs.cli import main
from warpgs.data.capture import Capture
from warpgs.data.ply import read_ply_points
from warpgs.distortion import Distortion
from warpgs.export.camera_set import CameraSet
from warpgs.export.camera_writers import CAMERA_FORMATS, write_cameras
from warpgs.runs.run import Run
from warpgs.video.given_cameras import read_cameras
from warpgs.video.orientation import AXES, upright, vertical

pytestmark = pytest.mark.usefixtures("quickly")

POINTS = torch.rand(50, 3, generator=torch.Generator().manual_seed(3)) * 2 - 1
SECONDS = 4.0
TURN = upright(AXES["z"], y_up=True)

RADIAL = (0.08, -0.02, 0.001, -0.002, 0.004)
FISHEYE = (0.03, -0.01, 0.002, -0.001)


def camera(k, coefficients=(), lens="radial", size=(640, 480)):
    """A camera on an arc, with sides, focal lengths and a principal point that all differ."""
    position = (np.sin(0.3 * k), 0.2 * k - 0.3, -4 + 0.1 * k)
    looking = Camera.looking_at(position, (0.1, 0.2, 0.0), (0.1, -1.0, 0.0), 1.0, size, k / 4)
    K = torch.tensor(intrinsic_matrix((600.0, 570.0), (310.0, 260.0)), dtype=torch.float32)
    make = Distortion.fisheye if lens == "fisheye" else Distortion.radial
    distortion = make(coefficients, K, size) if coefficients else None
    return dataclasses.replace(looking, K=K, distortion=distortion)


def capture(coefficients=(), lens="radial"):
    """Five cameras, the third for evaluation, and points."""
    cameras = {f"view {k}": camera(k, coefficients, lens) for k in range(5)}
    names = list(cameras)
    train, val = [name for name in names if name != "view 2"], ["view 2"]
    colors = (POINTS * 127 + 128).to(torch.uint8)
    return Capture("test", cameras, train, val, POINTS, colors, lambda name: None)


def written(folder, name, *lens, rotation=TURN):
    made = capture(*lens)
    write_cameras(folder, name, CameraSet.of(made, rotation, SECONDS))
    return made


def seen(camera):
    """[P, 2] where a camera sees the points [px]."""
    viewed = POINTS.double() @ camera.viewmat[:3, :3].T.double() + camera.viewmat[:3, 3].double()
    return camera.place(viewed)[0].numpy()


def turned():
    """The points in the coordinates of the file."""
    return POINTS.double().numpy() @ TURN.T


@pytest.mark.parametrize("lens", [(), (RADIAL[:2],), (RADIAL,), (FISHEYE, "fisheye")])
def test_colmap_sees_points_where_the_capture_does(tmp_path, lens):
    pycolmap = pytest.importorskip("pycolmap")
    made = written(tmp_path, "colmap", *lens)
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    by_name = {image.name: image for image in model.images.values()}
    assert {name.removesuffix(".png") for name in by_name} == set(made.cameras)
    for name, view in made.cameras.items():
        image = by_name[f"{name}.png"]
        viewed = image.cam_from_world() * turned()
        found = model.cameras[image.camera_id].img_from_cam(viewed)
        assert np.abs(found - seen(view)).max() < 0.01
        assert (model.cameras[image.camera_id].width, model.cameras[image.camera_id].height) == (640, 480)
    assert len(model.cameras) == 1
    assert [model.images[k].name for k in sorted(model.images)] == [f"view {k}.png" for k in range(5)]


def test_colmap_has_the_points_with_their_colours(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    made = written(tmp_path, "colmap")
    points = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0")).points3D
    assert np.stack([points[k].xyz for k in sorted(points)]) == pytest.approx(turned())
    assert (np.stack([points[k].color for k in sorted(points)]) == made.point_colors.numpy()).all()


def test_cameras_of_several_lenses_stay_apart_in_colmap(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    made = capture()
    made.cameras["view 4"] = camera(4, RADIAL)
    write_cameras(tmp_path, "colmap", CameraSet.of(made, TURN, SECONDS))
    model = pycolmap.Reconstruction(str(tmp_path / "sparse" / "0"))
    assert sorted(camera.model.name for camera in model.cameras.values()) == ["FULL_OPENCV", "OPENCV"]


def opengl(frame):
    """[P, 3] the points in the axes of a frame of a transforms.json: x right, y up, z backward."""
    to_world = np.array(frame["transform_matrix"])
    return (turned() - to_world[:3, 3]) @ to_world[:3, :3]


@pytest.mark.parametrize("lens", [(), (RADIAL,), (FISHEYE, "fisheye")])
def test_nerfstudio_sees_points_where_the_capture_does(tmp_path, lens):
    """By OpenCV's functions, which nerfstudio undistorts images with."""
    cv2 = pytest.importorskip("cv2")
    made = written(tmp_path, "nerfstudio", *lens)
    transforms = json.loads((tmp_path / "transforms.json").read_text())
    assert transforms["camera_model"] == ("OPENCV_FISHEYE" if lens[1:] else "OPENCV")
    for (name, view), frame in zip(made.cameras.items(), transforms["frames"], strict=True):
        assert frame["file_path"] == f"images/{name}.png"
        assert frame["time"] == view.time
        assert (frame["w"], frame["h"]) == (640, 480)
        viewed = opengl(frame) * [1, -1, -1]
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        keys = ("k1", "k2", "k3", "k4") if lens[1:] else ("k1", "k2", "p1", "p2", "k3")
        k = np.array([frame.get(key, 0.0) for key in keys])
        project = cv2.fisheye.projectPoints if lens[1:] else cv2.projectPoints
        found = project(viewed.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, k)[0][:, 0]
        assert np.abs(found - seen(view)).max() < 0.01


def test_nerfstudio_has_the_split_and_the_points(tmp_path):
    made = written(tmp_path, "nerfstudio")
    transforms = json.loads((tmp_path / "transforms.json").read_text())
    assert transforms["train_filenames"] == [f"images/view {k}.png" for k in (0, 1, 3, 4)]
    assert transforms["val_filenames"] == ["images/view 2.png"]
    points, colors = read_ply_points(tmp_path / transforms["ply_file_path"])
    assert points == pytest.approx(turned(), abs=1e-6)
    assert (colors == made.point_colors.numpy()).all()


def test_blender_sees_points_where_pinholes_in_the_middle_of_the_image_do(tmp_path):
    made = written(tmp_path, "blender")
    for split, names in (("train", made.train), ("val", made.val)):
        transforms = json.loads((tmp_path / f"transforms_{split}.json").read_text())
        focal = 320 / np.tan(transforms["camera_angle_x"] / 2)
        for name, frame in zip(names, transforms["frames"], strict=True):
            assert frame["file_path"] == f"./{split}/{name}"
            assert frame["time"] == made.cameras[name].time
            x, y, z = opengl(frame).T
            K = torch.tensor([[600.0, 0, 320.0], [0, 600.0, 240.0], [0, 0, 1]])
            expected = seen(dataclasses.replace(made.cameras[name], K=K))
            assert np.abs(np.stack([320 - focal * x / z, 240 + focal * y / z], 1) - expected).max() < 0.01


def in_usd(prim, code):
    """[P, 2] where OpenUSD sees the points at a time code [px of 640 × 480]."""
    frustum = prim.GetCamera(code).frustum
    matrix = np.array(frustum.ComputeViewMatrix()) @ np.array(frustum.ComputeProjectionMatrix())
    clip = np.concatenate([turned(), np.ones((50, 1))], 1) @ matrix
    x, y = (clip[:, :2] / clip[:, 3:]).T
    return np.stack([(x + 1) * 320, (1 - y) * 240], 1)


def test_usd_sees_points_where_the_capture_does(tmp_path):
    pxr = pytest.importorskip("pxr.UsdGeom", reason="usd-core is not installed (extra 'export')")
    Usd = pytest.importorskip("pxr.Usd")
    made = written(tmp_path, "usd")
    stage = Usd.Stage.Open(str(tmp_path / "cameras.usdc"))
    for name, view in made.cameras.items():
        kind = "training" if name in made.train else "evaluation"
        prim = pxr.Camera(stage.GetPrimAtPath(f"/Cameras/{kind}"))
        assert np.abs(in_usd(prim, 3 * view.time) - seen(view)).max() < 0.01


def test_usd_moves_the_camera_over_the_duration(tmp_path):
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (extra 'export')")
    UsdGeom = pytest.importorskip("pxr.UsdGeom")
    written(tmp_path, "usd")
    stage = Usd.Stage.Open(str(tmp_path / "cameras.usdc"))
    assert (stage.GetEndTimeCode() - stage.GetStartTimeCode()) / stage.GetTimeCodesPerSecond() == SECONDS
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    prim = UsdGeom.Camera(stage.GetPrimAtPath("/Cameras/training"))
    assert prim.GetOrderedXformOps()[0].GetTimeSamples() == [0.0, 0.75, 2.25, 3.0]
    early, late, between = (np.array(prim.GetCamera(code).frustum.position) for code in (0.75, 2.25, 1.5))
    assert between == pytest.approx((early + late) / 2)


def test_usd_has_a_prim_for_each_camera(tmp_path):
    Usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed (extra 'export')")
    UsdGeom = pytest.importorskip("pxr.UsdGeom")
    made = capture()
    ids = {name: k % 2 for k, name in enumerate(made.in_time(made.train))}
    made = made.with_cameras({name: dataclasses.replace(made.cameras[name], id=i) for name, i in ids.items()})
    write_cameras(tmp_path, "usd", CameraSet.of(made, TURN, SECONDS))
    stage = Usd.Stage.Open(str(tmp_path / "cameras.usdc"))
    assert not stage.GetPrimAtPath("/Cameras/training")
    for i in (0, 1):
        prim = UsdGeom.Camera(stage.GetPrimAtPath(f"/Cameras/training_{i}"))
        times = [made.cameras[name].time for name in made.train if ids[name] == i]
        last = max([*ids.values()].count(0), [*ids.values()].count(1)) - 1
        assert prim.GetOrderedXformOps()[0].GetTimeSamples() == pytest.approx([last * time for time in sorted(times)])


@pytest.mark.parametrize("name", ["colmap", "nerfstudio"])
@pytest.mark.parametrize("lens", [(), (RADIAL,), (FISHEYE, "fisheye")])
def test_cameras_are_read_back_as_they_were(tmp_path, name, lens):
    made = written(tmp_path, name, *lens, rotation=TURN if name == "nerfstudio" else np.eye(3))
    for view, read in zip(made.cameras.values(), read_cameras(tmp_path, made), strict=True):
        assert np.abs(seen(read) - seen(view)).max() < 0.01
        assert (read.size, read.time) == (view.size, view.time)
        assert (read.distortion is None) == (view.distortion is None)


def test_cameras_of_blender_are_read_back(tmp_path):
    made = written(tmp_path, "blender")
    read = read_cameras(tmp_path / "transforms_train.json", made)
    assert [camera.time for camera in read] == [made.cameras[name].time for name in made.train]
    assert torch.cat([c.viewmat for c in read]) == pytest.approx(
        torch.cat([made.cameras[name].viewmat for name in made.train]), abs=1e-5
    )


@pytest.fixture
def pxr():
    """The module of OpenUSD."""
    pytest.importorskip("pxr.Usd", reason="usd-core is not installed (extra 'export')")
    return importlib.import_module("pxr")


def test_cameras_of_usd_are_read_back_as_they_were(tmp_path, pxr):
    made = written(tmp_path, "usd")
    read = read_cameras(tmp_path / "cameras.usdc", made)
    for view, back in zip(made.cameras.values(), read, strict=True):
        assert (back.viewmat - view.viewmat).abs().max() < 1e-6
        assert pytest.approx(view.K, rel=1e-6) == back.K
        assert back.size == view.size
        assert back.time == pytest.approx(view.time, abs=1e-12)
    only = read_cameras(tmp_path / "cameras.usdc", made, "evaluation")
    assert [camera.time for camera in only] == [made.cameras["view 2"].time]


@pytest.mark.parametrize("suffix", ["usda", "usdc", "usdz", "usd"])
def test_usd_of_all_kinds_is_read(tmp_path, pxr, suffix):
    from pxr import Sdf, UsdUtils

    made, path = written(tmp_path, "usd"), tmp_path / f"other.{suffix}"
    if suffix == "usdz":
        UsdUtils.CreateNewUsdzPackage(str(tmp_path / "cameras.usdc"), str(path))
    else:
        Sdf.Layer.FindOrOpen(str(tmp_path / "cameras.usdc")).Export(str(path))
    read, expected = read_cameras(path, made), read_cameras(tmp_path / "cameras.usdc", made)
    assert torch.equal(torch.cat([c.viewmat for c in read]), torch.cat([c.viewmat for c in expected]))


def animated(path, axis="Y", unit=1.0, still=False):
    """A file of another program: a camera in a scaled group, which moves up from time code 11 to 15."""
    from pxr import Gf, Usd, UsdGeom

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, axis)
    UsdGeom.SetStageMetersPerUnit(stage, unit)
    group = UsdGeom.Xform.Define(stage, "/rig")
    group.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))
    prim = UsdGeom.Camera.Define(stage, "/rig/main")
    prim.CreateHorizontalApertureAttr(36.0)
    prim.CreateVerticalApertureAttr(24.0)
    prim.CreateFocalLengthAttr(50.0)
    move, up = prim.AddTranslateOp(), np.array([0.0, 1.0, 0.0] if axis == "Y" else [0.0, 0.0, 1.0])
    if axis == "Z":
        prim.AddRotateXOp().Set(90.0)  # looks along y with z up
    if still:
        move.Set(Gf.Vec3d(*(up / unit)))
    else:
        stage.SetStartTimeCode(11)
        stage.SetEndTimeCode(15)
        move.Set(Gf.Vec3d(*(up / unit)), 11)
        move.Set(Gf.Vec3d(*(3 * up / unit)), 15)
    stage.Save()
    return stage


@pytest.mark.parametrize(("axis", "unit"), [("Y", 1.0), ("Z", 1.0), ("Y", 0.01), ("Z", 0.01)])
def test_a_camera_of_another_program_films_at_each_time_code(tmp_path, pxr, axis, unit):
    animated(tmp_path / "shot.usda", axis, unit)
    made = capture()
    read = read_cameras(tmp_path / "shot.usda", made)
    to_file = upright(vertical(made), y_up=True)
    assert [camera.time for camera in read] == [0.0, 0.25, 0.5, 0.75, 1.0]
    for k, seen_from in enumerate(read):
        assert to_file @ seen_from.position.numpy() == pytest.approx([0.0, 2 + k, 0.0], abs=1e-5)
        assert seen_from.viewmat[:3, :3].numpy() @ to_file.T == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-6)
        assert seen_from.size == (720, 480)
        assert seen_from.K.diagonal().tolist() == pytest.approx([1000.0, 1000.0, 1.0])
        assert seen_from.K[:2, 2].tolist() == [360.0, 240.0]


def test_a_still_camera_films_the_whole_scene(tmp_path, pxr):
    animated(tmp_path / "shot.usda", still=True)
    read = read_cameras(tmp_path / "shot.usda", capture())
    assert [read[0].time, read[-1].time, len(read)] == [0.0, 1.0, 120]
    assert torch.equal(read[0].viewmat, read[-1].viewmat)


def test_a_still_camera_that_another_program_added_films_at_each_time_code(tmp_path, pxr):
    made, path = written(tmp_path, "usd"), tmp_path / "more.usda"
    stage = importlib.import_module("pxr.Usd").Stage.Open(str(tmp_path / "cameras.usdc"))
    importlib.import_module("pxr.UsdGeom").Camera.Define(stage, "/Cameras/extra")
    stage.Export(str(path))
    assert [camera.time for camera in read_cameras(path, made, "extra")] == pytest.approx([0, 1 / 3, 2 / 3, 1])


def test_one_of_several_cameras_is_chosen_by_its_name(tmp_path, pxr):
    stage, path = animated(tmp_path / "shot.usda"), tmp_path / "shot.usda"
    importlib.import_module("pxr.UsdGeom").Camera.Define(stage, "/rig/side").AddTranslateOp().Set((5.0, 0.0, 0.0))
    stage.Save()
    with pytest.raises(ValueError, match="has 2 such cameras, choose one by --view: /rig/main, /rig/side"):
        read_cameras(path, capture())
    for name in ("side", "/rig/side"):
        assert len(read_cameras(path, capture(), name)) == 5
    with pytest.raises(ValueError, match="has no camera top: give --view one of its cameras, /rig/main, /rig/side"):
        read_cameras(path, capture(), "top")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("float focalLength = 50", "float focalLength = 0", "must have a positive focal length"),
        ("float horizontalAperture = 36", "float horizontalAperture = nan", "must have a positive focal length"),
        (
            "float horizontalAperture = 36",
            "float horizontalAperture = 1e6",
            "would have an image of 7,864,320 × 480 pixels",
        ),
        ("float focalLength = 50", 'string focalLength = "x"', "/rig/main.focalLength must be a number at 11, got 'x'"),
        ("float focalLength = 50", "float focalLength.timeSamples = {11: None}", "must be a number at 11, got None"),
        ("float focalLength = 50", 'token projection = "orthographic"', "projection perspective"),
        ("float focalLength = 50", "float horizontalApertureOffset = 99", "outside of the image"),
        ("(2, 2, 2)", "(2, 2, -2)", "is more than turned, scaled and moved"),
        ("(2, 2, 2)", "(0, 0, 0)", "is more than turned, scaled and moved"),
        ("(2, 2, 2)", "(inf, 1, 1)", "is more than turned, scaled and moved"),
        ("endTimeCode = 15", "endTimeCode = 1e9", "expected time codes of at most"),
        ("endTimeCode = 15", "endTimeCode = 1", "expected time codes of at most"),
        ("metersPerUnit = 1", "metersPerUnit = 0", "metersPerUnit must be positive"),
        ("metersPerUnit = 1", "subLayers = [@./other.usda@]", "refers to other files"),
        ('def Xform "rig"', 'def Xform "rig" (references = @./other.usda@)', "refers to other files"),
        ('def Xform "rig"', 'def Xform "rig" (payload = @./other.usda@)', "refers to other files"),
        ('def Camera "main"', 'def Xform "main"', "has no cameras: export the camera of the other program, too"),
        ("metersPerUnit = 1", "customLayerData = {double warpgsRotation = 2}", "must be a rotation"),
        ('def Camera "main"', 'def Camera "main" (customData = {string warpgsSize = "big"})', "must be two integers"),
        ("#usda", "#other", "is not a file of OpenUSD"),
        ("upAxis", "up Axis {", "is not a file of OpenUSD"),
    ],
)
def test_usd_that_is_no_camera_path_is_refused(tmp_path, pxr, old, new, message):
    path = tmp_path / "shot.usda"
    animated(path)
    text = path.read_text()
    assert old in text
    changed = tmp_path / "changed.usda"
    changed.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=message) as error:
        read_cameras(changed, capture())
    assert str(changed) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_name_is_for_cameras_of_usd(tmp_path):
    made = written(tmp_path, "nerfstudio")
    with pytest.raises(ValueError, match="--view chooses a camera of a file of OpenUSD"):
        read_cameras(tmp_path, made, "view 2")


def test_colmap_cameras_that_were_turned_like_a_file_are_refused(tmp_path):
    made = written(tmp_path, "colmap")
    with pytest.raises(ValueError, match="has the capture's cameras, turned as in an exported file: export with --up"):
        read_cameras(tmp_path, made)


def test_colmap_cameras_elsewhere_have_the_times_of_frames_of_their_names(tmp_path):
    made = capture()
    views = list(made.cameras.values())
    others = {name: dataclasses.replace(view, time=0.0) for name, view in zip(made.cameras, views[::-1], strict=True)}
    write_cameras(tmp_path, "colmap", CameraSet.of(dataclasses.replace(made, cameras=others), np.eye(3), SECONDS))
    read = read_cameras(tmp_path, made)
    assert [camera.time for camera in read] == [view.time for view in views]
    assert torch.allclose(read[0].viewmat, views[-1].viewmat, atol=1e-5)


def test_how_colmap_cameras_are_filmed_is_said_only_where_they_were_turned(tmp_path):
    hint = "render --cameras films them only if they are exported with --up scene"
    assert hint in write_cameras(tmp_path / "a", "colmap", CameraSet.of(capture(), TURN, SECONDS))
    assert hint not in write_cameras(tmp_path / "b", "colmap", CameraSet.of(capture(), np.eye(3), SECONDS))
    assert hint not in write_cameras(tmp_path / "c", "nerfstudio", CameraSet.of(capture(), TURN, SECONDS))


def test_a_folder_of_blender_says_which_files_it_has(tmp_path):
    made = written(tmp_path, "blender")
    with pytest.raises(ValueError, match=r"give one of its files, transforms_train.json, transforms_val.json"):
        read_cameras(tmp_path, made)


def test_colmap_cameras_that_are_no_frames_are_evenly_spaced_in_time(tmp_path):
    made = written(tmp_path, "colmap", rotation=np.eye(3))
    others = Capture("other", {"a": camera(0)}, ["a"], [], POINTS, None, lambda name: None)
    assert [c.time for c in read_cameras(tmp_path, others)] == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert len(made.cameras) == 5


@pytest.fixture
def rig(tmp_path):
    """Cameras of two folders of frames, and a function that writes a COLMAP model of images."""
    names = [f"cam{i}_{k:04d}" for i in range(2) for k in range(3)]
    cameras = {name: dataclasses.replace(camera(k), time=(k % 3) / 2) for k, name in enumerate(names)}
    capture = Capture("rig", cameras, names, [], POINTS, None, lambda name: None)

    def write(images):
        written = {image: cameras[names[k]] for k, image in enumerate(images)}
        made = CameraSet.of(Capture("model", written, [*written], [], POINTS, None, lambda name: None), np.eye(3), 1.0)
        write_cameras(tmp_path, "colmap", made)
        return tmp_path

    return capture, write


def test_frames_of_several_cameras_are_told_apart_by_their_folders(rig):
    capture, write = rig
    read = read_cameras(write(["cam0/0000", "cam0/0001", "cam1/0002"]), capture)
    assert [c.time for c in read] == [0.0, 0.5, 1.0]


def test_images_of_which_only_some_are_frames_are_named(rig):
    capture, write = rig
    message = r"1 of 3 images are no frames of the capture, which tell the times: .*cam2/0002.*; expected .* cam0_0000"
    with pytest.raises(ValueError, match=message):
        read_cameras(write(["cam0/0000", "cam0/0001", "cam2/0002"]), capture)


def test_a_time_outside_of_the_scene_is_refused(tmp_path):
    made = written(tmp_path, "nerfstudio")
    transforms = json.loads((tmp_path / "transforms.json").read_text())
    transforms["frames"][1]["time"] = 1.5
    edit_json(tmp_path / "transforms.json", frames=transforms["frames"])
    with pytest.raises(ValueError, match=r"transforms\.json: time must be in \[0, 1\]"):
        read_cameras(tmp_path, made)


def test_a_transform_that_is_no_rotation_is_refused(tmp_path):
    made = written(tmp_path, "nerfstudio")
    edit_json(tmp_path / "transforms.json", applied_transform=(2 * np.eye(4)[:3]).tolist())
    with pytest.raises(ValueError, match="applied_transform must be a rotation"):
        read_cameras(tmp_path, made)


PRISM = (*RADIAL, 0.01, 0.0, 0.0, 0.002)


@pytest.mark.parametrize(("name", "lens", "advice"), [("nerfstudio", PRISM[:6], "colmap"), ("colmap", PRISM, "usd")])
def test_a_lens_that_a_format_cannot_hold_is_refused(tmp_path, name, lens, advice):
    with pytest.raises(ValueError, match=f"camera view 0: .* use --cameras {advice}"):
        written(tmp_path, name, lens)


@pytest.mark.parametrize("name", CAMERA_FORMATS)
def test_the_summary_says_axes_and_what_is_lost(tmp_path, name):
    pytest.importorskip("pxr") if name == "usd" else None
    made = capture(RADIAL)
    made.cameras["view 1"] = dataclasses.replace(made.cameras["view 1"], motion=torch.zeros(2, 3))
    summary = write_cameras(tmp_path, name, CameraSet.of(made, TURN, SECONDS))
    assert f"5 cameras in {tmp_path}, in the coordinates of the scene's file" in summary
    assert ("the distortion of the lens is not in it" in summary) == (not CAMERA_FORMATS[name].has_lens)
    assert "no format of cameras holds a rolling shutter" in summary


@pytest.fixture
def run(finished_run, tmp_path):
    return shutil.copytree(finished_run, tmp_path / "run")


@pytest.mark.parametrize("up", ["scene", "capture"])
def test_an_exported_path_is_filmed_again(run, tmp_path, up):
    """Held-out views among them have the images of --path views."""
    out = tmp_path / "out"
    assert main(["export", str(run), "--cameras", "nerfstudio", "--up", up, "--out", str(out), "--quiet"]) == 0
    assert (out / "scene.ply").is_file()
    films = {"cameras": ["--cameras", str(out / "cameras")], "views": []}
    for name, options in films.items():
        assert main(["render", str(run), *options, "--out", str(tmp_path / name), "--write", "png", "--quiet"]) == 0
    made = Run.open(run, "cpu").open_corrected_capture(True)
    place = made.in_time(made.cameras).index(made.val[0])
    images = [
        cv2_read(tmp_path / "cameras" / f"{place:05d}.png"),
        cv2_read(tmp_path / "views" / f"{made.val[0]}.png"),
    ]
    assert np.abs(images[0] - images[1]).max() <= 1


def cv2_read(path):
    import cv2

    return cv2.imread(str(path)).astype(int)


def test_cameras_lie_next_to_a_file(run, tmp_path):
    arguments = ["--out", str(tmp_path / "a.ply"), "--quiet", "--up", "scene"]
    assert main(["export", str(run), "--cameras", "colmap", *arguments]) == 0
    assert (tmp_path / "cameras" / "sparse" / "0" / "images.bin").is_file()


def test_an_unknown_format_of_cameras_is_refused(run, capsys):
    assert main(["export", str(run), "--cameras", "maya"]) == 2
    assert "--cameras must be one of colmap, nerfstudio, blender, usd, got 'maya'" in capsys.readouterr().err


def test_without_a_capture_no_cameras_and_no_scene_are_written(run, tmp_path, capsys):
    edit_json(run / "config.json", data=str(tmp_path / "gone"))
    assert main(["export", str(run), "--cameras", "colmap", "--out", str(tmp_path / "out")]) == 2
    assert "--cameras needs the cameras of the capture: the capture cannot be opened" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_one_path_is_filmed_at_a_time(run, capsys):
    assert main(["render", str(run), "--cameras", "a", "--path", "fixed"]) == 2
    assert "--cameras define the path: omit --path" in capsys.readouterr().err


def test_another_file_than_one_of_cameras_is_refused_by_what_it_should_be(run, tmp_path, capsys):
    (tmp_path / "scene.ply").write_bytes(b"ply\n\xff")
    assert main(["render", str(run), "--cameras", str(tmp_path / "scene.ply")]) == 2
    assert (
        "scene.ply is neither a transforms.json, a USD file nor a folder that has a COLMAP model"
        in capsys.readouterr().err
    )
