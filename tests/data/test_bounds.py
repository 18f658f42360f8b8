"""What files claim is checked before memory is allocated for it, and before others' decompressors see it."""

import io
import shutil
import struct
import sys
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from tests.data import layouts
from tests.data.captures import edit_json, refused, write_array, write_png
from warpgs.data.exr import MAX_CHANNELS, exr_size, read_exr_channel
from warpgs.data.images import to_8_bits
from warpgs.data.lens import Lens
from warpgs.data.loaders.iphone import IPhoneLoader
from warpgs.data.loaders.posed import world_to_camera
from warpgs.data.npz import read_npz
from warpgs.data.ply import read_ply_points
from warpgs.data.resized import read_metric_depth
from warpgs.data.units import SceneUnits
from warpgs.files import read_array

FILE = Path("a.exr")

METHODS = {"bzip2": zipfile.ZIP_BZIP2, "lzma": zipfile.ZIP_LZMA}


def peak_of(read) -> int:
    tracemalloc.start()
    try:
        read()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def exr(num_channels: int) -> bytes:
    """An OpenEXR image of 37×48 zeros per channel, the first of which is Z."""
    stream, zeros = io.BytesIO(), np.zeros((48, 37), np.float32)
    channels = dict.fromkeys(["Z", *(f"c{k}" for k in range(1, num_channels))], zeros)
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION}, channels).write(stream)
    return stream.getvalue()


def with_size(data: bytes, width: int, height: int) -> bytes:
    """An image of 37×48 pixels that claims others."""
    return data.replace(struct.pack("<4i", 0, 0, 36, 47), struct.pack("<4i", 0, 0, width - 1, height - 1))


def test_depth_among_other_channels_is_read():
    assert np.array_equal(read_exr_channel(FILE, exr(3), "Z"), np.zeros((48, 37), np.float32))


@pytest.mark.parametrize("num_channels", [1, 60])
def test_exr_data_that_cannot_hold_their_pixels_are_refused_before_they_are_decoded(num_channels, monkeypatch):
    data, real, opened = with_size(exr(num_channels), 16_384, 6_000), OpenEXR.File, []

    def spy(*args, **options):
        opened.append(options["header_only"])
        return real(*args, **options)

    monkeypatch.setattr(OpenEXR, "File", spy)
    with pytest.raises(ValueError, match=r"^a\.exr: damaged or truncated OpenEXR data$"):
        read_exr_channel(FILE, data, "Z")
    assert opened == [True]


def test_too_many_channels_and_pixels_are_refused():
    with pytest.raises(ValueError, match=f"of {MAX_CHANNELS + 1} channels, expected at most {MAX_CHANNELS}"):
        exr_size(FILE, exr(MAX_CHANNELS + 1))
    with pytest.raises(ValueError, match="an OpenEXR image of 37×48 pixels, more than 1,000"):
        read_exr_channel(FILE, exr(1), "Z", 1_000)
    with pytest.raises(ValueError, match="an OpenEXR image of 16385×2 pixels"):
        exr_size(FILE, with_size(exr(1), 16_385, 2))


def test_without_the_package_openexr_an_error_says_how_to_install_it(monkeypatch):
    data = exr(1)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(OSError, match=r"^a\.exr needs OpenEXR: .*exr"):
        exr_size(FILE, data)


def test_depth_of_another_shape_is_refused_before_it_is_decoded(edited, monkeypatch):
    root = edited("vipe")
    with zipfile.ZipFile(root / "depth/clip.zip", "w") as archive:
        for k in range(layouts.COUNT):
            archive.writestr(f"{k:05d}.exr", exr(1))
    monkeypatch.setattr("warpgs.data.loaders.vipe.read_exr_channel", None)
    refused(root, r"00000\.exr: the depth is 37×48, but the images of its camera are 40×24")


@pytest.mark.parametrize("method", METHODS)
def test_members_of_other_methods_than_numpy_and_vipe_write_are_refused(edited, method):
    root = edited("vipe")
    masks, poses = root / "mask/clip.zip", root / "pose/clip.npz"
    for path, member in ((masks, "00000.png"), (poses, "data.npy")):
        before = path.read_bytes()
        with zipfile.ZipFile(path) as old:
            content = {name: old.read(name) for name in old.namelist()}
        with zipfile.ZipFile(path, "w", METHODS[method]) as archive:
            for name, data in content.items():
                archive.writestr(name, data)
        refused(root, rf"{path}: \w+\.\w+ is compressed by method {METHODS[method]}, expected stored or deflated")
        assert member in content
        path.write_bytes(before)


def test_damaged_members_of_every_method_are_refused_by_name(tmp_path):
    for method in (zipfile.ZIP_DEFLATED, *METHODS.values()):
        with zipfile.ZipFile(tmp_path / "a.npz", "w", method) as archive:
            archive.writestr("x.npy", np.random.default_rng(0).bytes(4000) + bytes(4000))
        data = bytearray((tmp_path / "a.npz").read_bytes())
        data[40:80] = bytes(range(40))
        (tmp_path / "a.npz").write_bytes(data)
        with pytest.raises(ValueError, match=r"a\.npz: x\.npy is"):
            read_npz(tmp_path / "a.npz", ["x"])


@pytest.mark.parametrize("number", ["9" * 400, "9" * 5000, "2" * 10])
def test_an_instance_with_a_huge_number_is_refused_by_name(edited, number):
    root = edited("vipe")
    (root / "mask/clip.txt").write_text(f"1: person\n{number}: sky\n")
    refused(root, rf"mask/clip\.txt: an instance has a number of {len(number)} digits, expected at most 9")


def test_depth_beyond_single_precision_is_unknown_and_warns_of_nothing(tmp_path):
    write_array(tmp_path / "a.npy", np.array([[1e300, 1e-42, 2.0, np.inf]]))
    expected = np.array([[np.nan, np.nan, 0.5, np.nan]], np.float32)
    assert np.array_equal(read_metric_depth(tmp_path / "a.npy", (4, 1), 1.0), expected, equal_nan=True)
    image = tmp_path / "a.png"
    write_png(image, np.zeros((1, 4, 3), np.uint8))
    sensor = IPhoneLoader().inverse_depth(tmp_path / "a.npy", (4, 1), SceneUnits(np.zeros(3), 1.0), image)
    assert np.array_equal(sensor, expected, equal_nan=True)


@pytest.mark.parametrize("sides", ["(4294967296, 4294967296)", "(" * 3000 + "1", "[" * 9000])
def test_a_header_of_an_array_that_cannot_be_is_refused_without_a_warning(tmp_path, sides):
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {sides}}}".encode()
    header += b" " * (-(len(header) + 11) % 64) + b"\n"
    content = b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header
    (tmp_path / "a.npy").write_bytes(content)
    with pytest.raises(ValueError, match=r"a\.npy is damaged or not a \.npy file of numbers"):
        read_array(tmp_path / "a.npy", 1 << 16)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("x.npy", content)
    with pytest.raises(ValueError, match=r"a\.npz: x\.npy is damaged or not an array of numbers"):
        read_npz(tmp_path / "a.npz", ["x"])


@pytest.mark.parametrize("value", [1e10, 1e300, np.inf])
def test_poses_and_intrinsics_beyond_the_bounds_are_refused_without_a_warning(value):
    matrix = np.eye(4)[:3]
    matrix[1, 1] = value
    with pytest.raises(ValueError, match="the pose is not finite, or its numbers are larger than"):
        world_to_camera(matrix)
    with pytest.raises(ValueError, match=r"intrinsics finite and at most 1e\+09, got"):
        Lens(40, 24, (50.0, 50.0), (20.0, 12.0), (0.0, 0.0, value)).checked()


def test_ids_of_frames_that_are_too_long_for_a_file_are_refused_by_a_short_line(root):
    edit_json(root / "dataset.json", train_ids=["left_000000", "a" * 60_000])
    refused(root, r"dataset\.json: train_ids must hold plain names, got 'a+\.\.\.a+'$")


def test_points_too_far_away_are_refused_with_their_capture(edited):
    root = edited("nerfstudio")
    data = (root / "points.ply").read_bytes()
    header = data.index(b"end_header\n") + len(b"end_header\n")
    (root / "points.ply").write_bytes(data[:header] + struct.pack("<d", 1e30) + data[header + 8 :])
    refused(root, rf"{root}.*: positions must be finite and at most 1e\+09 scene units")


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
@pytest.mark.parametrize("name", ["cameras.txt", "images.txt", "points3D.txt"])
def test_links_into_proc_are_refused_before_colmap_never_returns_from_them(edited, name):
    path = edited("colmap as text") / "sparse/0" / name
    path.unlink()
    path.symlink_to("/proc/self/mem")
    refused(path.parents[2], rf"sparse/0/{name} cannot be read")


@pytest.mark.parametrize("length", [1025, 300_000])
def test_names_that_are_too_long_are_refused_by_a_short_line(edited, length):
    root = edited("nerfstudio")
    layouts.edit_transforms(root / "transforms.json", file_path="a/" * (length // 2) + "a")
    refused(root, r"transforms\.json: file_path must name a file, got 'a/.+\.\.\..+'$")
    shutil.rmtree(root)
    root = edited("colmap as text")
    images = root / "sparse/0/images.txt"
    images.write_text(images.read_text().replace(f"{layouts.NAMES[0]}.png", "a" * length))
    refused(root, rf"sparse/0 .*the name of image 1 has {length:,} characters$")


def test_a_large_member_that_deflate_shrinks_to_almost_nothing_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.data.archive.MAX_SMALL", 100_000)
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(90_000, np.uint8), y=np.zeros(200_000, np.uint8))
    assert len(read_npz(tmp_path / "a.npz", ["x"])["x"]) == 90_000
    with pytest.raises(ValueError, match=r"y\.npy claims 200,128 bytes, too many for \d+ compressed ones"):
        read_npz(tmp_path / "a.npz", ["y"])


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_zeros_after_the_points_of_a_ply_file_take_no_memory(tmp_path, encoding):
    path = layouts.write_ply(tmp_path / "a.ply", encoding)
    with path.open("rb+") as file:
        file.truncate(1 << 30)
    assert peak_of(lambda: read_ply_points(path)) < 1 << 20
    assert len(read_ply_points(path)[0]) == len(layouts.POINTS)


def test_16_bits_become_8_without_a_copy_in_16():
    image = np.random.default_rng(0).integers(0, 1 << 16, (300, 500, 4), np.uint16)
    assert np.array_equal(to_8_bits(image), (image >> 8).astype(np.uint8))
    assert peak_of(lambda: to_8_bits(image)) < image.nbytes
