"""Damaged or unsupported captures of other programs are refused in one line that names the file."""

import io
import json
import os
import shutil
import struct
import zipfile
from pathlib import Path

import av
import numpy as np
import OpenEXR
import pytest

from tests.data import layouts
from tests.data.captures import edit_json, refused, write_array, write_png
from tests.data.layouts import edit_transforms
from warpgs.data.exr import read_exr_channel
from warpgs.data.npz import read_npz
from warpgs.data.ply import read_ply_points
from warpgs.data.video_frames import VideoFrames


def edit_matrix(path: Path, change) -> None:
    values = json.loads(path.read_text())
    matrix = np.array(values["frames"][0]["transform_matrix"])
    change(matrix)
    edit_transforms(path, transform_matrix=matrix.tolist())


def save_npz(path: Path, **changes) -> None:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez(path, **{name: array for name, array in {**arrays, **changes}.items() if array is not None})


def rewrite_zip(path: Path, name: str, data: bytes) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, data)


def cameras_bin(model: int, params: list[float], size=layouts.SIZE) -> bytes:
    return struct.pack(f"<QIiQQ{len(params)}d", 1, 3, model, *size, *params)


def unrotate(matrix: np.ndarray) -> None:
    matrix[0, 0] += 0.1


def shift_far(matrix: np.ndarray) -> None:
    matrix[0, 3] = np.nan


CAMERAS, SPARSE = "sparse/0/cameras.bin", "sparse/0/points3D.bin"
SMALL = np.zeros((9, 9, 3), np.uint8)
FIELD_OF_VIEW = cameras_bin(7, [*layouts.PARAMS[:4], 0.9])
BENT = [*layouts.PARAMS[:4], -50.0, 0.0, 0.0, 0.0]
ROW = np.zeros((layouts.COUNT, 17))
INDICES = np.arange(layouts.COUNT)

DAMAGES = [
    ("colmap", lambda r: (r / "images/frame_00003.png").unlink(), r"frame_00003\.png is missing: the COLMAP model"),
    ("colmap", lambda r: (r / "sparse/0/images.bin").unlink(), "is not a COLMAP model"),
    ("colmap", lambda r: (r / CAMERAS).write_bytes(FIELD_OF_VIEW), "FOV is not supported; first"),
    ("colmap", lambda r: (r / CAMERAS).write_bytes(cameras_bin(99, [])), r"cameras\.bin is damaged"),
    ("colmap", lambda r: (r / CAMERAS).write_bytes(cameras_bin(4, BENT)), "folds back inside the image"),
    ("colmap", lambda r: (r / CAMERAS).write_bytes(cameras_bin(0, [-5.0, 1, 1])), "focal lengths"),
    ("colmap", lambda r: (r / CAMERAS).write_bytes(cameras_bin(0, [np.nan, 1, 1])), "out of range"),
    ("colmap", lambda r: (r / CAMERAS).write_bytes(cameras_bin(0, [5.0, 1, 1], (10**9, 5))), "out of range"),
    ("colmap", lambda r: (r / SPARSE).write_bytes(struct.pack("<Q", 2**60)), r"points3D\.bin is damaged"),
    ("colmap", lambda r: write_png(r / "images/frame_00002.png", SMALL), "but the images of its camera are"),
    ("colmap", lambda r: write_png(r / "masks/frame_00002.png.png", SMALL[..., 0]), "the mask is 9×9"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", frames=[]), "frames must be a list of at least one"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", frames=[3]), "frames must be a list"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", camera_model="VR180_L"), "VR180_L is"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", w="wide"), "w must hold numbers"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", w=-3), "expected 1 to"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", k4=0.1), "k4 must be 0"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", depth_unit_scale_factor=0), "must be positive"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", ply_file_path="no.ply"), r"no\.ply is missing"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", train_filenames=["x.png"]), r"x\.png is missing"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", train_filenames=["points.ply"]), "which is not a frame"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", val_filenames=7), "must be a list of files"),
    ("nerfstudio", lambda r: edit_json(r / "transforms.json", val_filenames=[]), "train_filenames must list some"),
    ("nerfstudio", lambda r: edit_transforms(r / "transforms.json", file_path=None), "no file_path"),
    ("nerfstudio", lambda r: edit_transforms(r / "transforms.json", file_path=7), "must name a file, got 7"),
    ("nerfstudio", lambda r: edit_transforms(r / "transforms.json", file_path="/dev/zero"), "is missing"),
    ("nerfstudio", lambda r: edit_transforms(r / "transforms.json", mask_path="m.png"), "lists it as mask_path"),
    ("nerfstudio", lambda r: edit_transforms(r / "transforms.json", transform_matrix=None), "transform_matrix"),
    ("nerfstudio", lambda r: edit_transforms(r / "transforms.json", transform_matrix=[[1]]), "shape"),
    ("nerfstudio", lambda r: edit_matrix(r / "transforms.json", unrotate), "is not a rotation"),
    ("nerfstudio", lambda r: edit_matrix(r / "transforms.json", shift_far), "finite"),
    ("nerfstudio", lambda r: edit_transforms(r / "transforms.json", fl_x=0), "focal lengths"),
    ("blender", lambda r: edit_transforms(r / "transforms_train.json", time=1.5), r"time must be in \[0, 1\]"),
    ("blender", lambda r: edit_json(r / "transforms_test.json", camera_angle_x=4), "between 0 and π"),
    ("blender", lambda r: edit_json(r / "transforms_train.json", camera_angle_x=None), "no fl_x or camera_angle_x"),
    ("llff", lambda r: write_array(r / "poses_bounds.npy", ROW), "not a rotation"),
    ("llff", lambda r: write_array(r / "poses_bounds.npy", ROW[:, :16]), r"shape \[N, 17\]"),
    ("llff", lambda r: write_array(r / "poses_bounds.npy", np.load(r / "poses_bounds.npy")[1:]), "has 11 poses, but"),
    ("llff", lambda r: shutil.rmtree(r / "images"), "images is missing"),
    ("llff", lambda r: (r / "mv_images/00002/cam02.png").rename(r / "mv_images/00002/cam77.png"), "cam01 to cam12"),
    ("llff", lambda r: write_png(r / "images/frame_00002.png", SMALL), "9×9, but its pose is of 80×48 images"),
    ("vipe", lambda r: (r / "intrinsics/clip_camera.txt").write_text("0: MEI\n"), "camera model MEI is not supported"),
    ("vipe", lambda r: save_npz(r / "intrinsics/clip.npz", data=np.ones((12, 5))), "those of pinhole cameras"),
    ("vipe", lambda r: save_npz(r / "intrinsics/clip.npz", inds=INDICES + 1), "no intrinsics of frame 0"),
    ("vipe", lambda r: save_npz(r / "pose/clip.npz", inds=INDICES[1:]), "must belong together"),
    ("vipe", lambda r: save_npz(r / "pose/clip.npz", data=None), "has no array data"),
    ("vipe", lambda r: save_npz(r / "pose/clip.npz", inds=INDICES + 5, data=None), "has no array data"),
    ("vipe", lambda r: save_npz(r / "pose/clip.npz", data=np.array([object()] * 12)), "not an array of numbers"),
    ("vipe", lambda r: (r / "depth/clip.zip").write_bytes(b"PK"), r"clip\.zip is damaged"),
    ("vipe", lambda r: rewrite_zip(r / "depth/clip.zip", "00000.exr", b"v/1\x01\2\0\0\0"), r"00000\.exr.*OpenEXR"),
    ("vipe", lambda r: rewrite_zip(r / "mask/clip.zip", "00000.png", b"x"), r"00000\.png is not a PNG"),
    ("vipe", lambda r: shutil.copy(r / "pose/clip.npz", r / "pose/other.npz"), "of one video, .* got those of 2"),
    ("vipe", lambda r: (r / "rgb/clip.mp4").write_bytes(b"no video"), r"clip\.mp4 is damaged or not a video"),
    ("megasam", lambda r: save_npz(next(r.iterdir()), images=np.zeros((12, 24, 40))), "images must be 8-bit RGB"),
    ("megasam", lambda r: save_npz(next(r.iterdir()), depths=None), "has no array depths"),
    ("megasam", lambda r: save_npz(next(r.iterdir()), cam_c2w=np.zeros((12, 4, 4))), "not a rotation"),
    ("megasam", lambda r: save_npz(next(r.iterdir()), intrinsic=np.ones((3, 3))), "must have no skew"),
    ("megasam", lambda r: save_npz(next(r.iterdir()), intrinsic=np.diag([0.0, 1, 1])), "focal lengths"),
    ("megasam", lambda r: shutil.copy(next(r.iterdir()), r / "b_sgd_cvd_hr.npz"), "2 videos of MegaSaM"),
]


@pytest.mark.parametrize(("layout", "damage", "message"), DAMAGES, ids=[f"{d[0]}-{k}" for k, d in enumerate(DAMAGES)])
def test_a_damaged_capture_is_refused(edited, layout, damage, message):
    root = edited(layout)
    damage(root)
    refused(root, message, layout)


@pytest.mark.parametrize("layout", layouts.WRITERS)
def test_a_folder_without_anything_is_refused(tmp_path, layout):
    refused(tmp_path, str(tmp_path), layout)


def test_a_fifo_instead_of_a_file_does_not_hang(edited):
    root = edited("colmap")
    (root / "sparse/0/images.bin").unlink()
    os.mkfifo(root / "sparse/0/images.bin")
    refused(root, r"images\.bin is not a file")


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_ply_points_of_every_encoding_are_read_and_truncated_ones_refused(tmp_path, encoding):
    path = layouts.write_ply(tmp_path / "a.ply", encoding)
    points, colors = read_ply_points(path)
    assert np.allclose(points, layouts.POINTS)
    assert colors[:, 0].tolist() == list(range(len(points)))
    data = path.read_bytes()
    for size in range(0, len(data) - 4, 97):
        path.write_bytes(data[:size])
        with pytest.raises(ValueError, match=r"a\.ply"):
            read_ply_points(path)


@pytest.mark.parametrize(
    "changes",
    [
        ("double z", "double w"),
        ("element vertex 60", "element face 60"),
        ("element vertex 60", "element vertex 99999999999"),
        ("property uchar red", "property list uchar int red"),
        ("format binary_little_endian", "format zip"),
    ],
)
def test_a_ply_header_that_does_not_fit_is_refused(tmp_path, changes):
    path = layouts.write_ply(tmp_path / "a.ply")
    path.write_bytes(path.read_bytes().replace(*(change.encode() for change in changes)))
    with pytest.raises(ValueError, match=r"a\.ply"):
        read_ply_points(path)


@pytest.mark.parametrize("compression", ["NO", "RLE", "ZIPS", "ZIP", "PIZ"])
@pytest.mark.parametrize("size", [(1, 1), (16, 7), (37, 20)])
def test_exr_depth_is_read_and_every_truncation_refused(compression, size):
    depth = np.random.default_rng(0).uniform(0.5, 9.0, size).round(1).astype(np.float16)
    data, path = layouts.exr(depth, compression=compression), Path("a.exr")
    assert np.array_equal(read_exr_channel(path, data, "Z"), depth.astype(np.float32))
    for end in range(0, len(data), max(1, len(data) // 40)):
        with pytest.raises(ValueError, match=r"^a\.exr: damaged or truncated OpenEXR data"):
            read_exr_channel(path, data[:end], "Z")
    with pytest.raises(ValueError, match="no channel R among the OpenEXR channels Z"):
        read_exr_channel(path, data, "R")


def test_an_exr_channel_of_whole_numbers_is_refused_by_name():
    stream, numbers = io.BytesIO(), np.ones((4, 5), np.uint32)
    OpenEXR.File({}, {"Z": numbers}).write(stream)
    with pytest.raises(
        ValueError, match=r"^a\.exr: OpenEXR channel Z must hold a floating-point number for each pixel"
    ):
        read_exr_channel(Path("a.exr"), stream.getvalue(), "Z")


def test_exr_depth_of_a_layer_in_a_window_that_begins_before_0_is_read_with_its_infinities():
    stream, depth = io.BytesIO(), np.array([[np.inf, 2.0, 0.5]], np.float16)
    window = np.array([-5, -7], np.int32), np.array([-3, -7], np.int32)
    OpenEXR.File({"dataWindow": window, "displayWindow": window}, {"depth.Z": depth, "Z": depth + 1}).write(stream)
    assert np.array_equal(read_exr_channel(Path("a.exr"), stream.getvalue(), "depth.Z"), depth.astype(np.float32))


def test_deep_images_and_images_of_several_parts_are_refused(tmp_path):
    parts = [OpenEXR.Part({}, {"Z": np.ones((4, 7), np.float32)}, name) for name in ("left", "right")]
    OpenEXR.File(parts).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match="not an OpenEXR image in one part"):
        read_exr_channel(tmp_path / "a.exr", (tmp_path / "a.exr").read_bytes(), "Z")


def test_an_npz_array_that_claims_too_much_is_refused_before_it_is_read(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(1_000_000))
    assert read_npz(tmp_path / "a.npz", ["x"])["x"].shape == (1_000_000,)
    with pytest.raises(ValueError, match="its arrays have 8,000,128 bytes, more than the maximum of 1,000"):
        read_npz(tmp_path / "a.npz", ["x"], 1000)


def test_a_video_cannot_make_ffmpeg_open_addresses(written, monkeypatch):
    opened, open_video = [], av.open

    def open_and_note(path, **arguments):
        opened.append(arguments["options"]["protocol_whitelist"])
        return open_video(path, **arguments)

    monkeypatch.setattr(av, "open", open_and_note)
    assert VideoFrames(written["vipe"] / "rgb/clip.mp4").size == layouts.SIZE
    assert opened == ["file"]
