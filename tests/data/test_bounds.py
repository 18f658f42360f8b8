"""What files claim is checked before memory is allocated for it, and before others' decompressors see it."""

import struct
import tracemalloc
import zipfile
import zlib

import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import refused
from warpgs.data.exr import MAX_CHANNELS, exr_size, read_exr_channel
from warpgs.data.npz import read_npz

METHODS = {"bzip2": zipfile.ZIP_BZIP2, "lzma": zipfile.ZIP_LZMA}


def exr(num_channels: int, width: int, height: int, block: bytes) -> bytes:
    """An OpenEXR file of float channels, compressed by ZIP, with the same stored bytes for every 16 lines."""

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    names = ["Z", *(f"c{k}" for k in range(1, num_channels))]
    channels = b"".join(name.encode() + b"\0" + struct.pack("<iIii", 2, 0, 1, 1) for name in names) + b"\0"
    header = b"v/1\x01" + struct.pack("<I", 2) + attribute("channels", "chlist", channels)
    header += attribute("compression", "compression", b"\3")
    header += attribute("dataWindow", "box2i", struct.pack("<4i", 0, 0, width - 1, height - 1)) + b"\0"
    rows = range(0, height, 16)
    start = len(header) + 8 * len(rows)
    offsets = [start + k * (8 + len(block)) for k in range(len(rows))]
    blocks = b"".join(struct.pack("<ii", row, len(block)) + block for row in rows)
    return header + struct.pack(f"<{len(rows)}Q", *offsets) + blocks


def zeros(num_channels: int, width: int) -> bytes:
    return zlib.compress(bytes([0]) + bytes([128]) * (16 * num_channels * width * 4 - 1), 9)


def peak_of(read) -> int:
    tracemalloc.start()
    try:
        read()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_depth_among_other_channels_is_read():
    assert np.array_equal(read_exr_channel(exr(3, 37, 48, zeros(3, 37)), "Z"), np.zeros((48, 37), np.float32))


@pytest.mark.parametrize("num_channels", [1, 60])
def test_exr_data_that_cannot_hold_their_pixels_are_refused_before_memory_is_allocated(num_channels):
    data = exr(num_channels, 16_384, 6_000, b"x" * 20)

    def read() -> None:
        with pytest.raises(ValueError, match=r"^damaged or truncated OpenEXR data$"):
            read_exr_channel(data, "Z")

    assert peak_of(read) < 20 * len(data) + (1 << 20)


def test_many_rows_that_share_the_bytes_of_one_block_are_refused():
    data = bytearray(exr(1, 64, 32, zeros(1, 64)))
    first = data.index(struct.pack("<ii", 0, len(zeros(1, 64))))
    second = data.index(struct.pack("<ii", 16, len(zeros(1, 64))))
    twice = bytes(data).replace(struct.pack("<Q", second), struct.pack("<Q", first))
    with pytest.raises(ValueError, match=r"^damaged or truncated OpenEXR data$"):
        read_exr_channel(twice, "Z")


def test_a_block_takes_a_small_multiple_of_its_size():
    data = exr(MAX_CHANNELS, 4_000, 16, zeros(MAX_CHANNELS, 4_000))
    size = 16 * 4_000 * 4 * MAX_CHANNELS
    assert peak_of(lambda: read_exr_channel(data, "Z")) < 6 * size


def test_too_many_channels_and_pixels_are_refused():
    with pytest.raises(ValueError, match=f"of {MAX_CHANNELS + 1} channels, expected at most {MAX_CHANNELS}"):
        exr_size(exr(MAX_CHANNELS + 1, 4, 4, b"x"))
    with pytest.raises(ValueError, match="an OpenEXR image of 37×48 pixels, more than 1,000"):
        read_exr_channel(exr(1, 37, 48, zeros(1, 37)), "Z", 1_000)


def test_depth_of_another_shape_is_refused_before_it_is_decoded(edited, monkeypatch):
    root = edited("vipe")
    with zipfile.ZipFile(root / "depth/clip.zip", "w") as archive:
        for k in range(layouts.COUNT):
            archive.writestr(f"{k:05d}.exr", exr(1, 4_000, 16, zeros(1, 4_000)))
    monkeypatch.setattr("warpgs.data.loaders.vipe.read_exr_channel", None)
    refused(root, r"00000\.exr: the depth is 4000×16, which has not the shape of 40×24")


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
