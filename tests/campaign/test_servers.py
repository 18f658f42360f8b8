"""Bad requests, slow and half-open connections do not stop the viewer, read foreign files or delay its end."""

import base64
import random
import socket
import time
import urllib.request

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

import viser

from tests.campaign.damage import CHANGES, bounded
from warpgs.viewer.server import STOP_SECONDS, Viewer
from warpgs.viewer.source import open_source

REQUESTS = (
    b"GET / HTTP/1.1\r\nHost: {host}\r\n\r\n",
    b"GET /../../../../../../etc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n",
    b"GET /%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n",
    b"GET /..%5c..%5c..%5c..%5cetc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n",
    b"GET //etc/passwd HTTP/1.1\r\nHost: {host}\r\n\r\n",
    b"GET /%00 HTTP/1.1\r\nHost: {host}\r\n\r\n",
    b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
    b"GET /" + b"a" * 5_000 + b" HTTP/1.1\r\nHost: {host}\r\n\r\n",
    b"GET / HTTP/1.1\r\nA: " + b"b" * 1_000_000 + b"\r\n\r\n",
    b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 100_000 + b"\r\n",
    b"POST / HTTP/1.1\r\nContent-Length: 99999999999\r\n\r\n",
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(200),
    b"\0" * 1000,
    b"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: {key}\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {protocol}\r\nOrigin: http://{host}\r\n\r\n"
    b"\x82\x85\x00\x00\x00\x00\xc1\xc1\xc1\xc1\xc1",
    b"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: {key}\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: {protocol}\r\nOrigin: http://evil.example\r\n\r\n",
)
"""Path traversal, headers that are too long or too many, other protocols, and WebSockets: with a message of nonsense,
and of a foreign page."""


@pytest.fixture
def viewer(finished_run):
    with Viewer(open_source(finished_run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        yield viewer


def request(k: int, port: int) -> bytes:
    """Request k of the campaign: first each of ``REQUESTS`` as it is, then damaged ones."""
    r = random.Random(k)
    template = REQUESTS[k] if k < len(REQUESTS) else r.choice(REQUESTS)
    values = {b"{host}": f"127.0.0.1:{port}".encode(), b"{key}": base64.b64encode(bytes(16))}
    for name, value in {**values, b"{protocol}": f"viser-v{viser.__version__}".encode()}.items():
        template = template.replace(name, value)
    data = bytearray(template)
    for _ in range(0 if k < len(REQUESTS) else r.choice((1, 3))):
        if data:
            r.choice(CHANGES)(data, r)
    return bytes(data)


def answer(data: bytes, port: int) -> bytes:
    """The first bytes of what is answered, if anything is."""
    with socket.create_connection(("127.0.0.1", port), timeout=30) as connection:
        connection.settimeout(0.05)
        try:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
            connection.settimeout(10)
            return connection.recv(4096)
        except OSError:  # refused while it was sent, or no answer
            return b""


def check_alive(port: int) -> None:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=30) as page:
        assert page.status == 200


def test_bad_requests_leave_the_viewer_alive(viewer, count, recwarn):
    for k in range(count):
        with bounded(f"request {k}"):
            assert b"root:" not in answer(request(k, viewer.port), viewer.port), k
        if k % 100 == 0:
            check_alive(viewer.port)
    check_alive(viewer.port)
    assert not viewer.sessions


def test_slow_and_half_open_connections_neither_block_the_viewer_nor_delay_its_end(finished_run):
    viewer = Viewer(open_source(finished_run, "cpu", False), None, "127.0.0.1", 0)
    connections = [socket.create_connection(("127.0.0.1", viewer.port), timeout=30) for _ in range(40)]
    try:
        for k, connection in enumerate(connections):
            connection.sendall(request(len(REQUESTS) - 2, viewer.port)[: 7 * k])
        check_alive(viewer.port)
    finally:
        start = time.monotonic()
        viewer.stop()
        seconds = time.monotonic() - start
        for connection in connections:
            connection.close()
    assert seconds < 2 * STOP_SECONDS
