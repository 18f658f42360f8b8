"""Intrinsics as matrices and rotations with one scale are read; others are refused with what was found."""

import json
import math

import numpy as np
import pytest
import torch

from tests.data import layouts
from tests.data.captures import edit_json, refused, write_array, write_json
from warpgs.captures.opening import load_capture

FX, FY, (CX, CY) = 44.0, 46.0, layouts.CENTER
K = [[FX, 0.0, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]
FOUR = np.block([[np.array(K), np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]]).tolist()


def every_frame(root, change, name="transforms.json"):
    values = json.loads((root / name).read_text())
    for k, entry in enumerate(values["frames"]):
        change(entry, k)
    write_json(root / name, values)


def without_fields(entry, k=0):
    for key in ("fl_x", "fl_y", "cx", "cy"):
        entry.pop(key, None)


@pytest.mark.parametrize("name", ["K", "intrinsic_matrix", "intrinsics"])
@pytest.mark.parametrize("form", [K, FOUR, FOUR[:3], np.ravel(K).tolist()], ids=["3x3", "4x4", "3x4", "9"])
def test_a_matrix_of_every_frame_has_its_intrinsics(edited, name, form):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: (without_fields(entry), entry.update({name: form})))
    camera = load_capture(root).cameras["frame_00003"]
    assert np.allclose(camera.K, K)


def test_frames_may_have_different_matrices_and_one_for_all_is_read(edited):
    root = edited("nerfstudio")
    every_frame(root, without_fields)
    edit_json(root / "transforms.json", K=K)
    assert np.allclose(load_capture(root).cameras["frame_00003"].K, K)
    own = [[50.0, 0.0, CX], [0.0, 50.0, CY], [0.0, 0.0, 1.0]]
    layouts.edit_transforms(root / "transforms.json", K=own)
    capture = load_capture(root)
    assert np.allclose(capture.cameras["frame_00011"].K, own)
    assert np.allclose(capture.cameras["frame_00003"].K, K)


WRONG = [
    ([[FX, 0, CX], [0, FY, CY]], "K must be finite numbers of shape"),
    ([[FX, 3.0, CX], [0, FY, CY], [0, 0, 1]], "cameras must have no skew, got 3.0 in K"),
    ([[FX, 0, 0], [0, FY, 0], [CX, CY, 1]], r"K must be \[\[fl_x, 0, cx\], \[0, fl_y, cy\], \[0, 0, 1\]\]"),
    ([[-FX, 0, CX], [0, FY, CY], [0, 0, 1]], "K must be"),
    ([[1.1, 0, 0.5], [0, 1.8, 0.5], [0, 0, 1]], "multiply its first row by the width of the image"),
    ([[FX, 0, "wide"], [0, FY, CY], [0, 0, 1]], "K must hold numbers"),
    ([], "K must be finite numbers of shape"),
]


@pytest.mark.parametrize(("given", "message"), WRONG, ids=range(len(WRONG)))
def test_another_matrix_is_refused(edited, given, message):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: (without_fields(entry), entry.update(K=given)))
    refused(root, message)


def test_a_focal_length_of_the_frame_itself_is_preferred_to_its_matrix(edited):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: entry.update(K=K, intrinsics=[1.0, 2.0]))
    capture = load_capture(root)
    assert capture.cameras["frame_00003"].K[0, 0] == layouts.FOCAL
    assert capture.notes == ()


def test_matrices_of_frames_are_preferred_to_a_focal_length_of_the_file_and_that_is_said(edited):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: (without_fields(entry), entry.update(K=K)))
    edit_json(root / "transforms.json", fl_x=60.0)
    capture = load_capture(root)
    assert capture.cameras["frame_00003"].K[0, 0] == FX
    assert capture.notes == ("transforms.json has fl_x 60.0, but a frame 44 in its matrix: the matrices are used",)


def test_matrices_in_fractions_are_not_needed_beside_a_focal_length(edited):
    root = edited("nerfstudio")
    fractions = [[1.1, 0, 0.5], [0, 1.8, 0.5], [0, 0, 1]]
    every_frame(root, lambda entry, k: (without_fields(entry), entry.update(K=fractions)))
    edit_json(root / "transforms.json", fl_x=60.0)
    assert load_capture(root).cameras["frame_00003"].K[0, 0] == 60.0


def test_without_a_focal_length_the_message_lists_what_there_is(edited):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: (without_fields(entry), entry.update(fx=3)))
    refused(root, "no fl_x or camera_angle_x, nor a matrix K; a frame has depth_file_path, file_path, fx, mask_path")


def test_panoramas_of_equal_area_are_told_what_to_convert_to(edited):
    root = edited("nerfstudio")
    edit_json(root / "transforms.json", equirectangular=True)
    refused(root, "EQUIRECTANGULAR of equal area is not supported: it is one of 360° images, which must be equirectang")


@pytest.mark.parametrize("flag", [{"latlong": True}, {"camera_model": "EQUIRECTANGULAR"}])
def test_equirectangular_images_need_no_focal_length(edited, flag):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: without_fields(entry))
    edit_json(root / "transforms.json", **flag)
    camera = load_capture(root).cameras["frame_00003"]
    assert camera.distortion.lens == "equirectangular"
    assert camera.K.diagonal()[:2].tolist() == pytest.approx([40 / (2 * math.pi), 24 / math.pi])
    assert camera.K[:2, 2].tolist() == [20.0, 12.0]


def test_focal_lengths_of_a_panorama_are_pixels_per_180_degrees(edited):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: (without_fields(entry), entry.update(fl_x=30.0, fl_y=26.0)))
    edit_json(root / "transforms.json", camera_model="EQUIRECTANGULAR")
    camera = load_capture(root).cameras["frame_00003"]
    assert camera.K.diagonal()[:2].tolist() == pytest.approx([30 / math.pi, 26 / math.pi])


@pytest.mark.parametrize("model", ["VR180_L", "OMNIDIRECTIONALSTEREO_L", "SPHERICAL"])
def test_panoramas_are_not_told_to_be_undistorted(edited, model):
    root = edited("nerfstudio")
    edit_json(root / "transforms.json", camera_model=model)
    refused(root, f"^(?!.*undistort).*camera model {model} is not supported.*perspective views")


def test_orthographic_cameras_are_refused(edited):
    root = edited("nerfstudio")
    edit_json(root / "transforms.json", orthographic=True)
    refused(root, "the camera model ORTHOGRAPHIC is not supported; expected one of OPENCV, ")


def scale_rotations(root, layout, factors):
    """Multiplies the rotation of every frame of a capture by a factor."""
    if layout in ("nerfstudio", "blender"):

        def scale(entry, k):
            matrix = np.array(entry["transform_matrix"])
            matrix[:3, :3] *= factors(k)
            entry["transform_matrix"] = matrix.tolist()

        for path in root.glob("transforms*.json"):
            every_frame(root, scale, path.name)
        return
    if layout == "llff":
        rows = np.load(root / "poses_bounds.npy")
        for k, row in enumerate(rows):
            row[:15].reshape(3, 5)[:, :3] *= factors(k)
        write_array(root / "poses_bounds.npy", rows)
        return
    path, name = (root / "pose/clip.npz", "data") if layout == "vipe" else (root / "clip_sgd_cvd_hr.npz", "cam_c2w")
    with np.load(path) as file:
        arrays = {key: file[key] for key in file.files}
    arrays[name] = np.array(arrays[name])
    for k, matrix in enumerate(arrays[name]):
        matrix[:3, :3] *= factors(k)
    np.savez(path, **arrays)


SCALED = pytest.mark.parametrize("layout", ["nerfstudio", "blender", "llff", "vipe", "megasam"])


@SCALED
@pytest.mark.parametrize("factor", [0.02, 1.7, 40.0])
def test_one_scale_of_all_rotations_is_left_out_and_noted(edited, written, layout, factor):
    root = edited(layout)
    scale_rotations(root, layout, lambda k: factor)
    capture, expected = load_capture(root), load_capture(written[layout])
    for name, camera in expected.cameras.items():
        assert np.allclose(capture.cameras[name].viewmat, camera.viewmat, atol=1e-5)
        assert np.allclose(capture.cameras[name].K, camera.K)
    assert f" are scaled by {factor:.6g}, divided out" in capture.notes[0]
    assert capture.notes[0].startswith("the rotations in ")


@SCALED
def test_different_scales_are_refused_by_length(edited, layout):
    root = edited(layout)
    scale_rotations(root, layout, lambda k: 1.0 + 0.1 * k)
    refused(root, r"not a rotation and a translation: the axes of the camera have lengths (\d\.\d), \1, \1, expected 1")


@pytest.mark.parametrize(
    ("change", "flaw"),
    [
        (np.diag([1.0, 1.0, -1.0]), "mirrored"),
        (np.array([[1, 0.5, 0], [0, 0.75**0.5, 0], [0, 0, 1]]), "not at right angles"),
    ],
)
def test_what_is_wrong_with_a_rotation_is_said(edited, change, flaw):
    root = edited("nerfstudio")

    def spoil(entry, k):
        matrix = np.array(entry["transform_matrix"])
        matrix[:3, :3] = matrix[:3, :3] @ change
        entry["transform_matrix"] = matrix.tolist()

    every_frame(root, spoil)
    refused(root, f"is not a rotation and a translation: its axes are {flaw}")


def test_a_transposed_pose_is_refused(edited):
    root = edited("nerfstudio")
    every_frame(root, lambda e, k: e.update(transform_matrix=np.array(e["transform_matrix"]).T.tolist()))
    refused(root, r"must end with the row 0 0 0 1, got \[.*\]; positions belong into its last column")


def test_the_last_row_of_a_pose_may_be_rounded(edited, written):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: entry["transform_matrix"][3].__setitem__(0, -1e-17))
    cameras = [load_capture(folder).cameras["frame_00003"] for folder in (root, written["nerfstudio"])]
    assert torch.equal(cameras[0].viewmat, cameras[1].viewmat)


def test_the_first_frame_without_a_matrix_that_others_have_is_named(edited):
    root = edited("nerfstudio")
    every_frame(root, lambda entry, k: (without_fields(entry), entry.update(K=K)))
    layouts.edit_transforms(root / "transforms.json", K=None)
    refused(root, r"images/frame_00011\.png has no fl_x .* matrix K, which 11 of 12 frames have: give every frame one")
