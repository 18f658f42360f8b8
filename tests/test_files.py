"""Files are complete or absent, and only regular files of bounded size are read."""

import errno
import json
import math
import os
import re
import struct
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from warpgs.files import (
    complete_or_absent,
    first_file,
    kept_if_used,
    natural_order,
    partial_path,
    read_array,
    read_bounded,
    read_json,
    read_numbers,
    remove_numbered,
    require_file,
    write_array,
    write_bytes,
    write_json,
    write_png,
    write_text,
)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "folder" / "a.txt"
    path.parent.mkdir()
    path.write_bytes(b"old")
    return path


def full_disk(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def pressed_ctrl_c(*_):
    raise KeyboardInterrupt


def test_parts_are_written_one_after_the_other(path):
    assert write_bytes(path, [b"ab", b"", b"cde"]) == 5
    assert path.read_bytes() == b"abcde"
    assert list(path.parent.iterdir()) == [path]


def test_parent_folders_are_created(tmp_path):
    write_text(tmp_path / "x" / "y" / "a.txt", "Tür")
    assert (tmp_path / "x" / "y" / "a.txt").read_bytes() == "Tür".encode()


WRITERS = [(write_png, np.zeros((4, 5, 3), np.uint8)), (write_json, {"a": 1}), (write_array, np.zeros(3))]


@pytest.mark.parametrize(("write", "values"), [(write_text, "new"), *WRITERS])
def test_a_failed_write_leaves_the_old_file_and_names_it(path, monkeypatch, write, values):
    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match=rf"^{path} could not be written: No space left on device$"):
        write(path, values)
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_ctrl_c_leaves_the_old_file_and_nothing_else(path, monkeypatch):
    monkeypatch.setattr(os, "replace", pressed_ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "new")
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


KILLED = """
import os, sys
from pathlib import Path
from warpgs.files import complete_or_absent
with complete_or_absent(Path(sys.argv[1])) as partial:
    (partial / "image.png").write_bytes(b"x")
    os.kill(os.getpid(), 9)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="os.kill ends processes differently")
def test_what_a_killed_process_left_of_a_folder_is_removed_by_the_next(tmp_path):
    folder = tmp_path / "c[a]pture"
    subprocess.run([sys.executable, "-c", KILLED, folder], env=os.environ, timeout=60)
    (left,) = tmp_path.iterdir()
    assert (left / folder.name / "image.png").is_file()
    with complete_or_absent(folder) as partial:
        (partial / "image.png").write_bytes(b"y")
        assert not left.exists()
    assert list(tmp_path.iterdir()) == [folder]
    assert [path.name for path in folder.iterdir()] == ["image.png"]


def test_a_folder_that_another_process_still_writes_is_kept(tmp_path):
    with complete_or_absent(tmp_path / "capture") as first:
        (first / "image.png").write_bytes(b"x")
        with complete_or_absent(tmp_path / "capture", keep_existing=True) as second:
            assert first != second
            assert (first / "image.png").is_file()
        (tmp_path / "capture").rmdir()
        with pytest.raises(ValueError, match="capture is being written by another process: wait until it has ended"):
            complete_or_absent(tmp_path / "capture").__enter__()
    assert [path.name for path in tmp_path.rglob("*")] == ["capture", "image.png"]


def unwritable_file(folder):
    (folder / "rgb").touch()
    write_bytes(folder / "rgb/left_000000.png", [b"x"])


def unwritable_folder(folder):
    (folder / "rgb").touch()
    (folder / "rgb").mkdir()


def full_target(folder):
    target = folder.parent.parent / folder.name
    target.mkdir()
    (target / "mine").touch()


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (unwritable_file, "/rgb/left_000000.png could not be written: File exists"),
        (unwritable_folder, "/rgb"),
        (full_target, ""),
    ],
)
def test_what_cannot_be_written_names_the_folder_and_not_the_temporary_one(tmp_path, write, message):
    def make():
        with complete_or_absent(tmp_path / "capture") as partial:
            write(partial)

    with pytest.raises(OSError, match=re.escape(f"{tmp_path}/capture{message}")) as raised:
        make()
    assert ".capture-" not in str(raised.value)


def no_space_for_a_file(folder):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "replace", full_disk)
        write_bytes(folder / "rgb/left_000000.png", [b"x"])


def error_of_a_library(folder):
    raise av.error.PermissionError(errno.EACCES, "denied", str(folder / "video.mp4"))  # takes no message alone


@pytest.mark.parametrize(
    ("write", "kind", "number"),
    [
        (unwritable_file, FileExistsError, errno.EEXIST),
        (unwritable_folder, FileExistsError, errno.EEXIST),
        (full_target, OSError, errno.ENOTEMPTY),
        (no_space_for_a_file, OSError, errno.ENOSPC),
        (error_of_a_library, PermissionError, errno.EACCES),
    ],
)
def test_what_cannot_be_written_keeps_the_class_and_the_number_of_the_error(tmp_path, write, kind, number):
    folder = tmp_path / "capture"
    with pytest.raises(kind, match=re.escape(str(folder))) as raised, complete_or_absent(folder) as partial:
        write(partial)
    assert (raised.type, raised.value.errno) == (kind, number)
    assert ".capture-" not in str(raised.value)


def test_a_folder_that_cannot_be_made_keeps_the_class_and_the_number_of_the_error(tmp_path):
    (tmp_path / "file").touch()
    message = re.escape(f"capture cannot be kept in {tmp_path / 'file'}: File exists")
    with pytest.raises(FileExistsError, match=f"^{message}$") as raised, complete_or_absent(tmp_path / "file/capture"):
        pass
    assert raised.value.errno == errno.EEXIST


def test_an_error_of_another_file_is_kept(tmp_path):
    with pytest.raises(FileNotFoundError, match="source"), complete_or_absent(tmp_path / "capture"):
        (tmp_path / "source").read_bytes()


def test_hidden_folders_of_the_user_are_kept(tmp_path):
    mine = tmp_path / ".capture-mine" / "capture" / "image.png"
    mine.parent.mkdir(parents=True)
    mine.write_bytes(b"x")
    with complete_or_absent(tmp_path / "capture"):
        pass
    assert mine.is_file()


def test_a_new_folder_in_which_nothing_is_written_is_removed_with_its_new_parents(tmp_path):
    (tmp_path / "old").mkdir()
    with kept_if_used(tmp_path / "old/new/newer", ("index",)):
        (tmp_path / "old/new/newer/index").touch()
    assert list(tmp_path.rglob("*")) == [tmp_path / "old"]


@pytest.mark.parametrize("before", [True, False])
def test_a_folder_that_existed_or_is_used_is_kept(tmp_path, before):
    folder = tmp_path / "new/newer"
    if before:
        folder.mkdir(parents=True)
    with kept_if_used(folder, ("index",)):
        (folder / "index").touch()
        if not before:
            (folder / "result").touch()
    assert (folder / "index").exists()


def test_a_file_in_the_place_of_a_folder_is_refused_and_kept(path):
    path.write_text("text")
    with pytest.raises(FileExistsError), kept_if_used(path):
        pass
    assert path.read_text() == "text"


def test_files_that_differ_in_their_suffix_have_different_partial_paths(tmp_path):
    assert partial_path(tmp_path / "a.png") != partial_path(tmp_path / "a.mp4")


def test_the_error_names_a_file_whose_parent_is_a_file(path):
    with pytest.raises(OSError, match=rf"^{path / 'b'} could not be written: "):
        write_text(path / "b", "new")


def test_a_file_larger_than_the_maximum_is_refused(path):
    assert read_bounded(path, 3) == b"old"
    with pytest.raises(ValueError, match=rf"{path} has 3 bytes, more than the maximum of 2"):
        read_bounded(path, 2)


def test_headers_of_arrays_are_parsed_by_one_thread_at_a_time(tmp_path, monkeypatch):
    running, most, whole = [], [], np.load

    def load(*arguments, **options):
        running.append(1)
        time.sleep(0.01)
        most.append(len(running))
        running.pop()
        return whole(*arguments, **options)

    np.save(tmp_path / "a.npy", np.arange(6.0))
    monkeypatch.setattr(np, "load", load)
    with ThreadPoolExecutor(4) as pool:
        arrays = list(pool.map(lambda _: read_array(tmp_path / "a.npy", 6), range(8)))
    assert all(np.array_equal(array, np.arange(6.0)) for array in arrays)
    assert max(most) == 1


@pytest.mark.parametrize("read", [read_bounded, read_array])
@pytest.mark.parametrize("case", ["folder", "missing", "zero", "fifo"])
def test_only_regular_files_are_read(tmp_path, case, read):
    path = tmp_path if case == "folder" else tmp_path / case
    (tmp_path / "zero").symlink_to("/dev/zero")
    os.mkfifo(tmp_path / "fifo")
    with pytest.raises(ValueError, match=rf"{path} is (not a file|missing)"):
        read(path, 10)


@pytest.mark.parametrize("read", [read_bounded, read_array])
def test_a_large_file_without_content_is_refused_by_its_size(tmp_path, read):
    with open(tmp_path / "a", "wb") as file:
        file.truncate(8 << 30)
    with pytest.raises(ValueError, match=rf"{tmp_path / 'a'} has 8,589,934,592 bytes, more than the maximum of"):
        read(tmp_path / "a", 1 << 20)


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
@pytest.mark.parametrize("read", [read_bounded, require_file, read_array])
def test_a_file_whose_size_says_nothing_about_its_content_is_refused(read, tmp_path):
    for name, message in (("status", "is not a plain file"), ("mem", "cannot be read"), ("clear_refs", "cannot be")):
        with pytest.raises(ValueError, match=f"^/proc/self/{name} {message}"):
            read(Path("/proc/self") / name, 1 << 20)
    (tmp_path / "empty").touch()
    assert require_file(tmp_path / "empty", 1 << 20) == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": ' + "9" * 400 + "}", r"is damaged: a has more than 64 bits: 9{18}\.\.\.9+$"),
        ('{"a": {"b": [1, -' + "9" * 400 + "]}}", "is damaged: b has more than 64 bits"),
        ('{"a": ' + "9" * 5000 + "}", "is not valid JSON: an integer has thousands of digits$"),
        ('{"a":' * 64 + "1" + "}" * 64, None),
        ('{"a":' * 65 + "1" + "}" * 65, "is nested deeper than 64 levels$"),
        ('{"a":' + "[" * 64 + "]" * 64 + "}", "is nested deeper than 64 levels$"),
        ("[" * 100_000, "is not valid JSON: it is nested deeper than 64 levels$"),
        ('{"a": 1, "b": 2, "a": 3}', "is not valid JSON: one object has 'a' twice, with different values$"),
        ('{"a": [1], "b": 2, "a": [1]}', None),
        ('{"a": 18446744073709551616, "b": 1.5}', None),
        ('{"a": NaN, "b": 1e999}', None),  # readers of a number check that it is finite
        ("\ufeff{}", None),
        ("[1]", "must hold a JSON object, got list$"),
    ],
)
def test_json_that_no_reader_expects_is_refused_by_name(path, text, message):
    write_text(path, text)
    if message is None:
        assert isinstance(read_json(path), dict)
    else:
        with pytest.raises(ValueError, match=rf"^{re.escape(str(path))}:? {message}") as caught:
            read_json(path)
        assert len(str(caught.value)) < 200 + len(str(path))


def test_the_last_of_many_names_that_is_there_twice_is_found_at_once(path):
    write_text(path, "{" + ",".join(f'"{k}":0' for k in range(200_000)) + ',"199999":1}')
    start = time.process_time()
    with pytest.raises(ValueError, match="one object has '199999' twice"):
        read_json(path)
    assert time.process_time() - start < 5.0


def test_a_name_that_is_too_long_for_the_file_system_is_no_file(tmp_path):
    assert first_file([tmp_path / ("a" * 5000), tmp_path / "missing"]) is None


def test_numbers_are_read_with_their_shape():
    assert read_numbers(Path("a.json"), {"a": [[1, 2.5]]}, "a", (1, 2)).tolist() == [[1.0, 2.5]]


BAD_NUMBERS = [
    (None, "must hold numbers"),
    ("1.5", "must hold numbers"),
    ([1, "2"], "must hold numbers"),
    ([True, False], "must hold numbers"),
    ([1, [2]], "must hold numbers"),
    ([1, 10**400], "must hold numbers"),
    (json.loads("[" * 900 + "]" * 900), "must hold numbers"),
    ([1], r"must be finite numbers of shape \[2\]"),
    ([1, math.nan], "must be finite"),
    ([1, -math.inf], "must be finite"),
    ([1, -2e9], r"must be at most 1e\+09 in magnitude"),
]


@pytest.mark.parametrize(("value", "message"), BAD_NUMBERS, ids=[str(k) for k in range(len(BAD_NUMBERS))])
def test_a_field_without_valid_numbers_is_refused_by_name(value, message):
    with pytest.raises(ValueError, match=rf"^a\.json: b {message}"):
        read_numbers(Path("a.json"), {"b": value}, "b", (2,))
    with pytest.raises(ValueError, match=r"^a\.json has no b$"):
        read_numbers(Path("a.json"), {}, "b", (2,))


def test_numbered_files_are_removed_up_to_the_first_gap(tmp_path):
    for name in ("0.a", "1.a", "3.a", "0.b"):
        (tmp_path / name).write_text("")
    remove_numbered(tmp_path, lambda k: f"{k}.a")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.b", "3.a"]


def test_images_keep_their_channels_and_bit_depth(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    grey = np.random.default_rng(0).integers(0, 65536, (4, 5), dtype=np.uint16)
    write_png(tmp_path / "deep/rgb.png", rgb)
    write_png(tmp_path / "deep/grey.png", grey)
    assert np.array_equal(cv2.imread(str(tmp_path / "deep/rgb.png"))[..., ::-1], rgb)
    assert np.array_equal(cv2.imread(str(tmp_path / "deep/grey.png"), cv2.IMREAD_UNCHANGED), grey)


def test_arrays_and_json_are_read_back(tmp_path):
    write_array(tmp_path / "deep/a.npy", np.arange(6.0).reshape(2, 3))
    write_json(tmp_path / "deep/a.json", {"a": [1, 2.5]})
    assert np.array_equal(np.load(tmp_path / "deep/a.npy"), np.arange(6.0).reshape(2, 3))
    assert json.loads((tmp_path / "deep/a.json").read_text()) == {"a": [1, 2.5]}


@pytest.mark.parametrize(("write", "values"), WRITERS)
def test_a_full_disk_is_reported_with_the_name_of_the_file(write, values, tmp_path):
    partial_path(tmp_path / "file").symlink_to("/dev/full")
    with pytest.raises(OSError, match="file could not be written: No space left on device"):
        write(tmp_path / "file", values)


def test_numbers_that_are_not_finite_are_null_in_json(tmp_path):
    write_json(tmp_path / "a.json", {"a": [math.nan, 1.0], "b": math.inf, "c": -math.inf})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [None, 1.0], "b": None, "c": None}


def test_an_array_is_read_with_its_type(tmp_path):
    for dtype in (np.float16, np.float64, np.int32, np.uint8):
        write_array(tmp_path / "a.npy", np.arange(6, dtype=dtype).reshape(2, 3))
        values = read_array(tmp_path / "a.npy", 6)
        assert (values.dtype, values.tolist()) == (dtype, [[0, 1, 2], [3, 4, 5]])


def test_an_array_header_that_claims_more_than_the_file_holds_is_refused(tmp_path):
    write_array(tmp_path / "p.npy", np.zeros((4, 3), np.float32))
    data = (tmp_path / "p.npy").read_bytes().replace(b"(4, 3), }" + b" " * 9, b"(4000000000, 3), }")
    (tmp_path / "p.npy").write_bytes(data)
    with pytest.raises(ValueError, match=r"p\.npy is damaged"):
        read_array(tmp_path / "p.npy", 10**12)


def test_an_array_larger_than_the_maximum_is_refused(tmp_path):
    write_array(tmp_path / "p.npy", np.zeros((4, 3)))
    with pytest.raises(ValueError, match="has 12 numbers, more than the maximum of 11"):
        read_array(tmp_path / "p.npy", 11)


def test_an_array_of_objects_is_never_unpickled(tmp_path):
    np.save(tmp_path / "p.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    with pytest.raises(ValueError, match=r"not a \.npy file of numbers"):
        read_array(tmp_path / "p.npy", 10)


@pytest.mark.parametrize("header", [b"{", b"{'descr': '<f4', 'fortran_order': False, 'shape': (True,)}"])
def test_a_damaged_array_header_is_refused(tmp_path, header):
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", 118) + header.ljust(117) + b"\n" + b"\0" * 64
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(ValueError, match="is damaged or not"):
        read_array(tmp_path / "a.npy", 100)


def test_names_with_numbers_are_in_the_order_of_their_values():
    ordered = ["a", "shot", "shot0.png", "shot02.png", "shot2.png", "shot10.png", "shot1403636579763555584.png"]
    ordered += ["shot1403636579813555456.png", "shot" + "9" * 5000]
    found = ordered[::-1]
    found.sort(key=natural_order)
    assert found == ordered
