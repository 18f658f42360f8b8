"""Locks of folders."""

import errno
import fcntl

import pytest

from warpgs.locks import lock_folder


def test_a_folder_is_locked_once_and_nothing_of_an_empty_one_is_left(tmp_path):
    folder = tmp_path / "new/newer"
    with lock_folder(folder, "filled"):
        with pytest.raises(ValueError, match=f"^{folder} is being filled by another process: wait "):
            lock_folder(folder, "filled").__enter__()
        assert (folder / ".lock").is_file()
    assert list(tmp_path.iterdir()) == []


def test_the_lock_of_a_process_that_was_killed_is_free_and_its_file_is_removed(tmp_path):
    (tmp_path / "result").touch()
    (tmp_path / ".lock").touch()
    with lock_folder(tmp_path, "filled"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_a_folder_that_is_moved_while_it_is_locked_is_unlocked(tmp_path):
    with lock_folder(tmp_path / "old", "filled"):
        (tmp_path / "old").rename(tmp_path / "new")
    with lock_folder(tmp_path / "new", "filled"):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_on_a_file_system_without_locks_nothing_is_locked(tmp_path, monkeypatch, number):
    def refuse(*_):
        raise OSError(number, "flock failed")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with lock_folder(tmp_path, "filled"), lock_folder(tmp_path, "filled"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_fails_for_another_reason_is_an_error(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EIO, "flock failed")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(OSError, match="flock failed"):
        lock_folder(tmp_path, "filled").__enter__()
