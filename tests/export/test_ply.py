"""PLY files: written files are read back, and all others are refused in one line before memory is allocated."""

import tracemalloc

import numpy as np
import pytest

from tests.export import scenes
from warpgs.data.ply import read_ply
from warpgs.formats import compressed, ply, standard

TABLE = np.array([(1.5, 7, 255), (-2.0, 8, 0)], [("x", "<f4"), ("word", "<u4"), ("byte", "u1")])
READERS = [read_ply, standard.read_standard, compressed.read_compressed]


def write(path, header, data=b""):
    path.write_bytes("\n".join(["ply", *header, "end_header", ""]).encode() + data)


BINARY = "format binary_little_endian 1.0"


def test_tables_are_read_back_exactly(path):
    size = ply.write_ply(path, {"vertex": TABLE, "other": TABLE[:1]})
    back = read_ply(path)
    assert list(back) == ["vertex", "other"]
    assert (back["vertex"] == TABLE).all()
    assert (back["other"] == TABLE[:1]).all()
    assert size == path.stat().st_size


def test_an_empty_table_is_read_back(path):
    ply.write_ply(path, {"vertex": TABLE[:0]})
    assert len(read_ply(path)["vertex"]) == 0


def test_comments_and_both_names_of_types_are_read(path):
    lines = ["comment any text by Åsa", "obj_info x", "element vertex 1", "property float32 x"]
    write(path, [BINARY, *lines], b"\0\0\x80?")
    assert read_ply(path)["vertex"]["x"].tolist() == [1.0]


@pytest.mark.parametrize(
    ("header", "data", "message"),
    [
        ([], b"", "is not in the format binary_little_endian"),
        (["format ascii 1.0"], b"", "is not in the format binary_little_endian"),
        (["format binary_big_endian 1.0"], b"", "is not in the format"),
        ([BINARY, "element vertex 1", "property list uchar int x"], b"", "a header line that is not supported"),
        ([BINARY, "element vertex 1", "property half x"], b"", "a header line that is not supported"),
        ([BINARY, "element vertex -1", "property float x"], b"", "a header line"),
        ([BINARY, "element vertex 1e3", "property float x"], b"", "a header line"),
        ([BINARY, "element vertex ²", "property float x"], b"", "a header line"),
        ([BINARY, "element vertex 9999999999999999999", "property float x"], b"", "a header line"),
        ([BINARY, "property float x"], b"", "a header line"),
        ([BINARY, "element vertex 5"], b"", "vertex has 0 properties"),
        ([BINARY, "element vertex 1", *(f"property float x{k}" for k in range(300))], b"", "has 300 properties"),
        ([BINARY, "element vertex 1", "property float x", "property float x"], b"", "two properties of the same name"),
        ([BINARY, "element a 1", "property float x", "element a 1"], b"", "two elements named a"),
        ([BINARY, "element vertex 2", "property float x"], bytes(7), "is truncated: 2 rows of vertex take 8 bytes"),
        ([BINARY, "element vertex 999999999999999", "property double x"], bytes(64), "is truncated"),
        ([BINARY, "element vertex 1", "property float x"], bytes(5), "1 bytes follow its last element"),
    ],
)
@pytest.mark.parametrize("read", READERS)
def test_an_invalid_file_is_refused_in_one_line(path, header, data, message, read):
    write(path, header, data)
    with pytest.raises(ValueError, match=message) as error:
        read(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("data", [b"", b"ply", b"PK\x03\x04", b"\x80\x04cposix\nsystem\n", b"plyx\n"])
def test_files_of_other_types_are_refused(path, data):
    path.write_bytes(data)
    with pytest.raises(ValueError, match=f"{path} is not a PLY file"):
        read_ply(path)


def test_a_header_without_an_end_is_refused(path):
    path.write_bytes(b"ply\n" + b"comment x\n" * 20_000)
    with pytest.raises(ValueError, match="has no PLY header"):
        read_ply(path)


def test_a_header_of_windows_lines_is_read(path):
    write(path, [BINARY, "element vertex 1", "property float x"])
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n") + b"\0\0\x80?")
    assert read_ply(path)["vertex"]["x"].tolist() == [1.0]


def test_lists_of_faces_are_left_out_where_only_vertices_are_read(path):
    faces = ["element face 3", "property list uchar int vertex_indices"]
    write(path, [BINARY, "element vertex 1", "property float x", *faces], b"\0\0\x80?" + bytes(39))
    assert read_ply(path, first_only=True)["vertex"]["x"].tolist() == [1.0]
    with pytest.raises(ValueError, match="header line that is not supported: 'property list"):
        read_ply(path)


def test_a_missing_file_is_refused(path):
    with pytest.raises(ValueError, match="is missing"):
        read_ply(path)


@pytest.mark.parametrize("count", [10**9, 10**15 - 1])
def test_a_huge_count_allocates_no_memory(path, count):
    write(path, [BINARY, f"element vertex {count}", "property double x"], bytes(64))
    tracemalloc.start()
    with pytest.raises(ValueError, match="is truncated"):
        read_ply(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


@pytest.mark.parametrize(
    ("write_cloud", "read"),
    [(standard.write_standard, standard.read_standard), (compressed.write_compressed, compressed.read_compressed)],
)
def test_a_damaged_file_is_read_or_refused_in_one_line(path, write_cloud, read):
    write_cloud(path, scenes.cloud(30))
    whole, random = path.read_bytes(), np.random.default_rng(0)
    for _ in range(400):
        data = bytearray(whole)
        match random.integers(4):
            case 0:  # truncated
                del data[random.integers(len(data)) :]
            case 1:  # changed bytes
                for index in random.integers(0, len(data), 8):
                    data[index] = random.integers(256)
            case 2:  # changed bytes in the header
                for index in random.integers(0, min(len(data), 1200), 3):
                    data[index] = random.integers(256)
            case _:  # a changed digit in the header
                digits = [k for k, byte in enumerate(data[:1200]) if chr(byte).isdigit()]
                data[digits[random.integers(len(digits))]] = ord("0") + random.integers(10)
        path.write_bytes(data)
        refusal = scenes.refusal(read, path)
        assert refusal is None or (str(path) in refusal and "\n" not in refusal)
        assert refusal is not None or read(path).finite.all()


def test_an_error_while_writing_names_the_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"a\.ply could not be written"):
        ply.write_ply(tmp_path / "file" / "a.ply", {"vertex": TABLE})


def test_a_full_disk_keeps_the_old_file(path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    path.write_bytes(b"old")
    monkeypatch.setattr("os.replace", full)
    with pytest.raises(OSError, match=f"{path} could not be written: No space left on device"):
        ply.write_ply(path, {"vertex": TABLE})
    assert list(path.parent.iterdir()) == [path]
    assert path.read_bytes() == b"old"
