"""Connections of foreign pages are refused."""

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from warpgs.viewer.origin import POLICY_VIOLATION, is_foreign
from warpgs.viewer.server import Viewer
from warpgs.viewer.source import open_source


@pytest.mark.parametrize(
    ("origin", "host", "listening", "foreign"),
    [
        (None, "127.0.0.1:8080", "127.0.0.1", False),
        ("http://127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", False),
        ("http://localhost:9000", "localhost:9000", "127.0.0.1", False),
        ("http://[::1]:8080", "[::1]:8080", "::1", False),
        ("http://machine:8080", "machine:8080", "0.0.0.0", False),
        ("http://evil.example", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://127.0.0.1:3000", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://evil.example", "machine:8080", "0.0.0.0", True),
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.1", True),
        ("null", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080", None, "127.0.0.1", True),
    ],
)
def test_a_page_is_foreign_unless_it_connects_to_its_own_server(origin, host, listening, foreign):
    assert is_foreign(origin, host, listening) is foreign


@pytest.fixture(scope="module")
def viewer(run):
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        yield viewer


def connected(viewer, origin):
    address = f"ws://127.0.0.1:{viewer.port}"
    return connect(address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"], proxy=None)


def test_a_foreign_page_is_sent_nothing(viewer):
    with connected(viewer, "http://evil.example") as socket, pytest.raises(ConnectionClosed) as closed:
        socket.recv(timeout=30)
    assert closed.value.rcvd.code == POLICY_VIOLATION


def test_the_page_of_the_viewer_is_sent_the_scene(viewer):
    with connected(viewer, f"http://127.0.0.1:{viewer.port}") as socket:
        assert socket.recv(timeout=30)
