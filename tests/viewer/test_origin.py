"""Connections of foreign pages are refused."""

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

import viser
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.errors import error_line
from tests.viewer.watched import until
from warpgs.viewer.origin import MAX_REPORTED, POLICY_VIOLATION, Refusals, allowed_origins, is_foreign
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
        ("http://localhost:9000", "LOCALHOST:9000", "127.0.0.1", False),
        ("http://127.0.0.1", "127.0.0.1:80", "127.0.0.1", False),
        ("https://gpu.example.org", "gpu.example.org:443", "0.0.0.0", False),
        ("https://gpu.example.org", "gpu.example.org:80", "0.0.0.0", True),
        ("http://[::1]:8080", "[0:0:0:0:0:0:0:1]:8080", "::1", False),
        ("https://gpu.example.org", "gpu.example.org", "127.0.0.1", True),
        ("http://evil.example:8080", "evil.example:8080", "127.0.0.2", True),
        ("http://127.0.0.1.evil.example:8080", "127.0.0.1.evil.example:8080", "127.0.0.1", True),
        ("http://127.0.0.1:8080@evil.example", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://evil.example@127.0.0.1:8080", "127.0.0.1:8080", "127.0.0.1", True),
        ("http://127.0.0.1:99999", "127.0.0.1:99999", "127.0.0.1", True),
        ("file://", "127.0.0.1:8080", "127.0.0.1", True),
        ("", "127.0.0.1:8080", "127.0.0.1", True),
    ],
)
def test_a_page_is_foreign_unless_it_connects_to_its_own_server(origin, host, listening, foreign):
    assert is_foreign(origin, host, listening) is foreign


@pytest.mark.parametrize(
    "allowed",
    [
        "https://gpu.example.org",
        "HTTPS://GPU.Example.org:443/user/me/proxy/8080/",
        "gpu.example.org",
        "gpu.example.org:443",
    ],
)
@pytest.mark.parametrize("host", ["gpu.example.org", "GPU.example.org:443", "127.0.0.1:8080", "localhost:8080", None])
def test_a_page_that_the_user_allows_may_connect_whatever_host_the_proxy_passes_on(allowed, host):
    assert not is_foreign("https://gpu.example.org", host, "127.0.0.1", allowed_origins([allowed]))


@pytest.mark.parametrize(
    "origin",
    [
        "https://evil.example",
        "http://gpu.example.org",
        "https://gpu.example.org:8443",
        "https://www.gpu.example.org",
        "https://gpu.example.org.evil.example",
        "null",
    ],
)
def test_an_allowed_page_brings_in_no_other(origin):
    allowed = allowed_origins(["https://gpu.example.org", "http://lab.example:3000"])
    assert is_foreign(origin, "gpu.example.org", "127.0.0.1", allowed)


def test_names_of_other_scripts_are_compared_as_browsers_send_them():
    assert not is_foreign("https://xn--mnchen-3ya.example", None, "127.0.0.1", allowed_origins(["münchen.example"]))


@pytest.mark.parametrize("text", ["*", "null", "", "https://", "ftp://gpu.example.org", "gpu.example.org:x", "a b"])
def test_an_origin_that_cannot_be_allowed_is_refused_in_one_line(run, capsys, text):
    error = error_line(capsys, "view", run, "--port", 0, "--allow-origin", "https://a.example", "--allow-origin", text)
    assert f"--allow-origin: expected the address of the page, such as https://gpu.example.org, got {text!r}" in error


def test_a_refusal_is_reported_once_per_origin_with_what_to_pass():
    lines = []
    refusals = Refusals(lines.append)
    for origin in ("https://gpu.example.org", "https://gpu.example.org:443", "http://evil.example:8080"):
        refusals.add(origin)
    assert lines == [
        f"refused a page of {origin}: if it is yours, as behind a proxy, start the viewer with --allow-origin {origin}"
        for origin in ("https://gpu.example.org", "http://evil.example:8080")
    ]


def test_a_refused_page_cannot_write_to_the_terminal_what_it_likes():
    lines = []
    refusals = Refusals(lines.append)
    refusals.add("http://\x1b[2Jevil" + "x" * 10_000)
    assert lines[0].isprintable()
    assert len(lines[0]) < 200
    for k in range(2 * MAX_REPORTED):
        refusals.add(f"http://evil{k}.example")
    assert len(lines) == MAX_REPORTED
    assert lines[-1].endswith("more refusals are not shown")


@pytest.fixture(scope="module")
def warned():
    return []


@pytest.fixture(scope="module")
def viewer(run, warned):
    allowed = allowed_origins(["https://gpu.example.org"])
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0, allowed, warned.append) as viewer:
        yield viewer


def connected(viewer, origin):
    address = f"ws://127.0.0.1:{viewer.port}"
    return connect(address, origin=origin, subprotocols=[f"viser-v{viser.__version__}"], proxy=None)


def test_a_foreign_page_is_sent_nothing_and_reported(viewer, warned):
    with connected(viewer, "http://evil.example") as socket, pytest.raises(ConnectionClosed) as closed:
        socket.recv(timeout=30)
    assert closed.value.rcvd.code == POLICY_VIOLATION
    until(lambda: warned)
    assert "--allow-origin http://evil.example" in warned[0]


def test_the_page_of_the_viewer_is_sent_the_scene(viewer):
    with connected(viewer, f"http://127.0.0.1:{viewer.port}") as socket:
        assert socket.recv(timeout=30)


def test_a_page_that_the_user_allows_is_sent_the_scene(viewer):
    with connected(viewer, "https://gpu.example.org") as socket:
        assert socket.recv(timeout=30)
