"""``warpgs download``: archives like the released ones become captures that are read, completely or not at all."""

import hashlib
from pathlib import Path

import pytest

from tests.errors import error_line
from warpgs.captures.opening import load_capture
from warpgs.cli import main
from warpgs.data import published
from warpgs.data.loaders import recognize
from warpgs.download import fetch
from warpgs.sweep.cells import find_scenes

CACHE = Path("../cache/warpgs/archives")


def run(capsys, *arguments):
    assert main(["download", *arguments]) == 0
    return capsys.readouterr().out


def failing(capsys, *arguments):
    """The last line of a failing command."""
    assert main(["download", *arguments]) == 2
    return capsys.readouterr().err.splitlines()[-1]


def left():
    """Everything in the current folder."""
    return sorted(map(str, Path().rglob("*")))


@pytest.mark.parametrize(
    ("dataset", "scene", "layout"),
    [("nerfds", "as", "nerfds"), ("hypernerf", "broom", "hypernerf"), ("dnerf", "lego", "blender")],
)
def test_a_released_archive_becomes_a_capture_that_is_read(request, capsys, tmp_path, dataset, scene, layout):
    request.getfixturevalue(dataset)
    assert f"warpgs train --data {dataset}/{scene} trains on it\n" in run(capsys, dataset, scene)
    root = Path(dataset, scene)
    assert recognize(root) == layout
    loaded, original = load_capture(root), load_capture(tmp_path / "source")
    assert (loaded.train, loaded.val) == (original.train, original.val)
    assert (loaded.frame(loaded.train[0]).image == original.frame(original.train[0]).image).all()
    assert left() == sorted([dataset, *(str(root / p) for p in ["", *paths(tmp_path / "source")])])


def paths(root):
    return [path.relative_to(root) for path in root.rglob("*")]


def test_a_dataset_as_written_in_papers_goes_to_another_folder(nerfds, capsys):
    run(capsys, "NeRF-DS", "bell", "--to", "data")
    assert (Path("data/nerfds/bell/dataset.json")).is_file()


def test_without_scenes_all_are_downloaded_and_make_a_sweep(serve, capsys):
    (release,) = published.find_dataset("nerfds").releases
    files = {f"{scene}_novel_view/{name}": b"{}" for scene in release.scenes for name in ("dataset.json", "rgb/1.png")}
    serve("nerfds", "as", files)
    assert "warpgs sweep scenes --data nerfds makes a table of them\n" in run(capsys, "nerfds")
    assert list(find_scenes(["nerfds"])) == ["as", "basin", "bell", "cup", "plate", "press", "sieve"]


def test_scenes_that_are_there_and_archives_in_the_cache_need_no_server(nerfds, server, capsys):
    run(capsys, "nerfds", "as")
    server.stop()
    server.files.clear()
    assert "nerfds/as is there already\n" in run(capsys, "nerfds", "as")
    run(capsys, "nerfds", "bell")
    assert load_capture("nerfds/bell").train


def test_an_archive_that_was_put_into_the_cache_by_hand_is_used(nerfds, server, capsys):
    data = server.files.pop(nerfds)
    line = failing(capsys, "nerfds", "as")
    assert "NeRF-DS.dataset.zip could not be downloaded: the server answers 404 Not Found; " in line
    path = Path(line.partition("put the file at ")[2])
    assert left() == []
    path.parent.mkdir(parents=True)
    path.write_bytes(data)
    assert "SHA-256" not in run(capsys, "nerfds", "as")


def test_a_broken_connection_is_continued_at_once(nerfds, server, capsys):
    server.cuts = [2_000, 2_001, 9_999]
    run(capsys, "nerfds", "as")
    assert server.ranges == [None, "bytes=2000-", "bytes=4000-", "bytes=13000-"]
    assert (CACHE / "nerfds/NeRF-DS.dataset.zip").read_bytes() == server.files[nerfds]


def test_a_connection_that_brings_nothing_more_is_an_error_and_the_next_call_continues(nerfds, server, capsys):
    server.cuts = [1_000, 0]
    assert "could not be downloaded: there is no connection, or it broke; the same" in failing(capsys, "nerfds", "as")
    assert left() == []
    assert "continuing http" in run(capsys, "nerfds", "as")
    assert server.ranges == [None, "bytes=1000-", "bytes=1000-"]
    assert load_capture("nerfds/as").train


def test_a_server_without_ranges_is_asked_for_all_of_it_again(nerfds, server, capsys):
    server.has_ranges, server.cuts = False, [5_000, 5_000]
    failing(capsys, "nerfds", "as")
    assert server.ranges == [None, "bytes=5000-"]
    run(capsys, "nerfds", "as")
    assert (CACHE / "nerfds/NeRF-DS.dataset.zip").read_bytes() == server.files[nerfds]


def test_ctrl_c_leaves_nothing_and_the_same_command_continues(nerfds, server, capsys):
    server.cuts, server.interrupts_at = [20_000], CACHE / "nerfds/NeRF-DS.dataset.zip.partial"
    assert main(["download", "nerfds", "as"]) == 130
    said = "warpgs download: stopped; the same command continues the download of NeRF-DS.dataset.zip\n"
    assert capsys.readouterr().err == said
    assert left() == []
    server.interrupts_at = None
    assert "continuing http" in run(capsys, "nerfds", "as")
    assert server.ranges[0] is None
    assert 0 < int(server.ranges[1].removeprefix("bytes=").removesuffix("-")) <= 20_000
    assert load_capture("nerfds/as").train


def test_a_download_beyond_the_bound_is_refused(nerfds, monkeypatch, capsys):
    monkeypatch.setattr(fetch, "MAX_BYTES", 5_000)
    assert "it has more than the maximum of 5,000 bytes" in failing(capsys, "nerfds", "as")


def test_a_complete_file_that_was_not_yet_checked_is_not_downloaded_again(nerfds, server, capsys):
    partial = CACHE / "nerfds/NeRF-DS.dataset.zip.partial"
    partial.parent.mkdir(parents=True)
    partial.write_bytes(server.files[nerfds])
    run(capsys, "nerfds", "as")
    assert load_capture("nerfds/as").train


def test_the_beginning_of_a_longer_file_is_dropped(nerfds, server, capsys):
    partial = CACHE / "nerfds/NeRF-DS.dataset.zip.partial"
    partial.parent.mkdir(parents=True)
    partial.write_bytes(server.files[nerfds] + b"x")
    run(capsys, "nerfds", "as")
    assert (CACHE / "nerfds/NeRF-DS.dataset.zip").read_bytes() == server.files[nerfds]


@pytest.fixture
def known_hash(monkeypatch):
    """Sets the hash of every release."""

    def know(sha256):
        datasets = [d._replace(releases=tuple(r._replace(sha256=sha256) for r in d.releases)) for d in known]
        monkeypatch.setattr(published, "PUBLISHED", tuple(datasets))

    known = published.PUBLISHED
    return know


def test_a_wrong_hash_is_an_error_with_both_and_keeps_nothing(nerfds, server, known_hash, capsys):
    known_hash("0" * 64)
    line = failing(capsys, "nerfds", "as")
    assert f"expected {'0' * 64} but got {hashlib.sha256(server.files[nerfds]).hexdigest()}" in line
    assert left() == []
    assert not [path for path in CACHE.rglob("*") if path.is_file()]


def test_an_unknown_hash_is_printed_and_one_that_is_right_is_not(nerfds, server, known_hash, capsys):
    sha256 = hashlib.sha256(server.files[nerfds]).hexdigest()
    assert f"has the SHA-256 {sha256}, compared with none" in run(capsys, "nerfds", "as")
    (CACHE / "nerfds/NeRF-DS.dataset.zip").unlink()
    known_hash(sha256)
    assert "SHA-256" not in run(capsys, "nerfds", "bell")


def test_the_list_has_every_dataset_and_scene(capsys):
    printed = run(capsys)
    for dataset in published.PUBLISHED:
        (line,) = (line for line in printed.splitlines() if line.split()[0] == dataset.name)
        assert dataset.scenes or dataset.address in line
        assert all(scene in line for scene in dataset.scenes)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nerfd"], "DATASET must be one of nerfds, hypernerf, nerfies, dnerf, iphone, nvidia, nonrigidnerf, got "),
        (
            ["nerfds", "bel"],
            "SCENE must be one of as, basin, bell, cup, plate, press, sieve, got 'bel'; did you mean bell",
        ),
        (["dycheck", "spin"], "the iPhone dataset of DyCheck must be downloaded by hand from https://github.com/KAIR"),
    ],
)
def test_what_cannot_be_downloaded_is_named(arguments, message, capsys, server):
    assert error_line(capsys, "download", *arguments).startswith(f"warpgs download: {message}")
    assert server.ranges == []


def test_scenes_of_a_dataset_have_different_names_and_archives_different_files():
    for dataset in published.PUBLISHED:
        names = [release.address.rpartition("/")[2] for release in dataset.releases]
        for unique in (dataset.scenes, names):
            assert len(set(unique)) == len(unique)
