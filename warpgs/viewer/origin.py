"""Refuses connections of foreign pages: any page in a browser may open a connection to a server on the same machine."""

from urllib.parse import urlsplit

import viser
from viser.infra import WebsockClientConnection

LOCAL_HOSTS = {"127.0.0.1", "::1", "localhost"}
POLICY_VIOLATION = 1008
"""Close code of the WebSocket protocol."""


def is_foreign(origin: str | None, host: str | None, listening: str) -> bool:
    """Whether a connection was opened by a page that this server did not serve.

    Args:
        origin: Header Origin, the address of the page; programs other than browsers do not send it.
        host: Header Host, the ``name:port`` that the browser connects to.
        listening: Address that the server listens on. If it is local, names of other hosts are foreign, because their
            owners can point them at any address (DNS rebinding).
    """
    if origin is None:
        return False
    if urlsplit(origin).netloc != host:
        return True
    return listening in LOCAL_HOSTS and urlsplit(origin).hostname not in LOCAL_HOSTS


def refuse_foreign_pages(server: viser.ViserServer, listening: str) -> None:
    """Closes connections of foreign pages before anything is sent to them; viser itself accepts all connections."""
    sockets = server._websock_server

    async def check(connection: WebsockClientConnection) -> None:
        socket = sockets._live_connections[connection.client_id]
        headers = {} if socket.request is None else socket.request.headers
        if is_foreign(headers.get("Origin"), headers.get("Host"), listening):
            await socket.close(POLICY_VIOLATION, "this page was not served by the viewer")

    sockets.on_client_connect(check)
