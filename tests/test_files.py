"""Files are whole or not there, and none is read that never ends."""

import errno
import os

import pytest

from warpgs.files import partial_of, read_bounded, remove_numbered, write_text, write_whole


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
    assert write_whole(path, [b"ab", b"", b"cde"]) == 5
    assert path.read_bytes() == b"abcde"
    assert list(path.parent.iterdir()) == [path]


def test_folders_above_are_made(tmp_path):
    write_text(tmp_path / "x" / "y" / "a.txt", "Tür")
    assert (tmp_path / "x" / "y" / "a.txt").read_bytes() == "Tür".encode()


def test_a_file_that_can_not_be_written_leaves_the_old_one_and_is_named(path, monkeypatch):
    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(OSError, match=rf"^{path} could not be written: No space left on device$"):
        write_text(path, "new")
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_ctrl_c_leaves_the_old_file_and_nothing_else(path, monkeypatch):
    monkeypatch.setattr(os, "replace", pressed_ctrl_c)
    with pytest.raises(KeyboardInterrupt):
        write_text(path, "new")
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_files_of_one_stem_are_written_in_different_places(tmp_path):
    assert partial_of(tmp_path / "a.png") != partial_of(tmp_path / "a.mp4")


def test_a_file_below_a_file_is_named(path):
    with pytest.raises(OSError, match=rf"^{path / 'b'} could not be written: "):
        write_text(path / "b", "new")


def test_a_file_is_read_up_to_its_limit(path):
    assert read_bounded(path, 3) == b"old"
    with pytest.raises(ValueError, match=rf"{path} has 3 bytes, more than the 2 that"):
        read_bounded(path, 2)


@pytest.mark.parametrize("kind", ["folder", "missing", "device"])
def test_what_is_no_file_is_not_read(tmp_path, kind):
    path = {"folder": tmp_path, "missing": tmp_path / "a", "device": tmp_path / "zero"}[kind]
    (tmp_path / "zero").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=rf"{path} is no file"):
        read_bounded(path, 10)


def test_numbered_files_are_removed_up_to_the_first_gap(tmp_path):
    for name in ("0.a", "1.a", "3.a", "0.b"):
        (tmp_path / name).write_text("")
    remove_numbered(tmp_path, lambda k: f"{k}.a")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.b", "3.a"]
