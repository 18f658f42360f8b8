"""Archives that are damaged, hostile or too large, and unpacking that ends early: nothing is left, with one message."""

import errno
import io
import shutil
import stat
import zipfile
from pathlib import Path

import pytest

from warpgs.captures.opening import load_capture
from warpgs.cli import main
from warpgs.download import unpack

from .test_download import CACHE, failing, left, run


@pytest.mark.parametrize("name", ["../x", "as/../../x", "/tmp/x", "C:/x", "as\\..\\x", "as/./x"])
def test_a_name_that_leads_out_of_the_folder_is_refused(serve, capsys, name):
    serve("nerfds", "as", {"as/dataset.json": b"{}", name: b"x"})
    line = failing(capsys, "nerfds", "as")
    assert line.endswith("is not a path below the folder that it would be unpacked into")
    assert repr(name) in line.replace("\\\\\\\\", "\\\\")
    assert left() == []


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFIFO, stat.S_IFCHR])
def test_links_and_devices_are_refused(serve, capsys, kind):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("as/dataset.json", b"{}")
        link = zipfile.ZipInfo("as/rgb")
        link.external_attr = (kind | 0o777) << 16
        archive.writestr(link, b"/etc")
    serve("nerfds", "as", data.getvalue())
    assert "'as/rgb' is a link or a device" in failing(capsys, "nerfds", "as")
    assert left() == []


@pytest.mark.parametrize(
    ("limit", "value", "message"),
    [
        ("MAX_MEMBERS", 2, "has 3 files, more than the maximum of 2"),
        ("MAX_MEMBER", 5_000, "as/zeros has 100,000 bytes, more than the maximum of 5,000"),
        ("MAX_TOTAL", 50_000, "as has 100,003 bytes, more than the maximum of 50,000"),
    ],
)
def test_an_archive_beyond_the_bounds_is_refused(serve, capsys, monkeypatch, limit, value, message):
    serve("nerfds", "as", {"as/dataset.json": b"{}", "as/a": b"x", "as/zeros": bytes(100_000)})
    monkeypatch.setattr(unpack, limit, value)
    assert message in failing(capsys, "nerfds", "as")
    assert left() == []


def test_a_zip_bomb_is_refused(serve, capsys, monkeypatch):
    serve("nerfds", "as", {"as/dataset.json": b"{}", "as/zeros": bytes(100_000)})
    monkeypatch.setattr("warpgs.data.archive.MAX_SMALL", 1_000)
    assert "as/zeros claims 100,000 bytes, too many for" in failing(capsys, "nerfds", "as")
    assert left() == []


@pytest.mark.parametrize("cut", ["page", "end", "middle"])
def test_a_damaged_archive_is_removed_so_that_the_next_call_downloads_it_again(nerfds, server, capsys, cut):
    data = server.files[nerfds]
    broken = bytearray(data)
    broken[len(data) // 2] ^= 255
    server.files[nerfds] = {"page": b"<html>", "end": data[:-100], "middle": bytes(broken)}[cut]
    line = failing(capsys, "nerfds", "as", "bell")
    assert "damaged" in line
    assert line.endswith("it was removed, so that the same command downloads it again")
    assert not list(CACHE.rglob("*.zip"))
    server.files[nerfds] = data
    run(capsys, "nerfds", "as", "bell")
    assert load_capture("nerfds/as").train


def test_an_archive_without_the_scene_is_told_its_captures(serve, capsys):
    serve("nerfds", "as", {"x/as_view/dataset.json": b"{}", "x/bell_novel_view/dataset.json": b"{}"})
    line = failing(capsys, "nerfds", "as")
    assert line.endswith("must have one capture as, but its captures are: x/as_view, x/bell_novel_view")
    assert left() == []


@pytest.fixture
def failing_write(monkeypatch):
    """Makes writing the fourth file raise an error."""

    def fail(error):
        def write(path, parts):
            if len(written) == 3:
                raise error
            written.append(path)
            return real(path, parts)

        written, real = [], unpack.write_bytes
        monkeypatch.setattr(unpack, "write_bytes", write)

    return fail


def test_ctrl_c_while_it_unpacks_leaves_nothing(nerfds, failing_write, capsys):
    failing_write(KeyboardInterrupt())
    assert main(["download", "nerfds", "as"]) == 130
    assert capsys.readouterr().err == "warpgs download: stopped\n"
    assert left() == []


def test_a_full_disk_leaves_nothing(nerfds, failing_write, capsys):
    failing_write(OSError(errno.ENOSPC, "No space left on device"))
    assert "No space left on device" in failing(capsys, "nerfds", "as")
    assert left() == []


def test_a_disk_with_too_little_space_is_noticed_first(nerfds, monkeypatch, capsys):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(100, 90, 10))
    assert "nerfds/as needs " in (line := failing(capsys, "nerfds", "as"))
    assert line.endswith(" bytes, but there are only 10 free")
    assert left() == []


@pytest.mark.parametrize("path", ["nerfds/bell/notes.txt", "nerfds/bell"])
def test_files_of_the_user_in_the_way_are_kept_and_named_before_anything_is_downloaded(nerfds, server, capsys, path):
    Path(path).parent.mkdir(parents=True)
    Path(path).write_text("mine")
    line = failing(capsys, "nerfds", "as", "bell")
    assert line.startswith("warpgs download: nerfds/bell is not a capture, and not empty: move it away")
    assert Path(path).read_text() == "mine"
    assert server.ranges == []


def test_an_empty_folder_in_the_way_is_filled(nerfds, capsys):
    Path("nerfds/as").mkdir(parents=True)
    run(capsys, "nerfds", "as")
    assert load_capture("nerfds/as").train
