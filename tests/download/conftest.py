"""A local server in place of the addresses of releases, an empty cache, and an empty folder to download to."""

import signal
from urllib.parse import urlsplit

import pytest

from tests.data.captures import write_capture
from tests.data.layouts import write_blender
from warpgs.data import published
from warpgs.download import fetch

from .server import Server, files_of, zipped


@pytest.fixture
def server():
    started = Server()
    # A shell lets what it starts in the background ignore Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield started
    signal.signal(signal.SIGINT, before)
    started.stop()


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, server):
    """The current folder, which is empty; every release is at the server, by the path of its address."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setattr(fetch, "CHUNK", 1_000)
    here = f"http://127.0.0.1:{server.server_port}"
    moved = [
        dataset._replace(releases=tuple(r._replace(address=here + urlsplit(r.address).path) for r in dataset.releases))
        for dataset in published.PUBLISHED
    ]
    monkeypatch.setattr(published, "PUBLISHED", tuple(moved))
    folder = tmp_path / "here"
    folder.mkdir()
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture
def nerfds(server, tmp_path):
    """The path of an archive of two scenes with a folder around them and metadata of macOS, as its address has it."""
    root = write_capture(tmp_path / "source")
    members = {"__MACOSX/as_novel_view/._dataset.json": b"", "__MACOSX/as_novel_view/dataset.json": b""}
    for scene in ("as", "bell"):
        members |= files_of(root, f"NeRF-DS dataset/{scene}_novel_view/")
    return served(server, "nerfds", "as", members)


@pytest.fixture
def hypernerf(server, tmp_path):
    """The path of an archive of one scene, whose folder has another name."""
    root = write_capture(tmp_path / "source", "hypernerf")
    return served(server, "hypernerf", "broom", files_of(root, "broom2/"))


@pytest.fixture
def dnerf(server, tmp_path):
    """The path of an archive whose scenes are in a folder."""
    root = write_blender(tmp_path / "source")
    return served(server, "dnerf", "lego", files_of(root, "data/lego/"))


def served(server, dataset, scene, members):
    """Puts an archive on the server; returns the path of its address."""
    (release,) = (r for r in published.find_dataset(dataset).releases if scene in r.scenes)
    path = urlsplit(release.address).path
    server.files[path] = zipped(members) if isinstance(members, dict) else members
    return path


@pytest.fixture
def serve(server):
    """Puts an archive of a scene on the server, from the content of its members or of itself."""
    return lambda dataset, scene, members: served(server, dataset, scene, members)
