"""Pages of others are kept out: any page in the browser may open a connection to a server on this machine."""

from urllib.parse import urlsplit

import viser
from viser.infra import WebsockClientConnection

THIS_MACHINE = {"127.0.0.1", "::1", "localhost"}
REFUSED = 1008
"""Of the WebSocket protocol: against the rules."""


def is_foreign(origin: str | None, host: str | None, listening: str) -> bool:
    """Whether a connection is asked for by a page that did not come from this server.

    Args:
        origin: Where the page came from; programs that are no browsers do not say.
        host: Whom the browser asks, ``name:port``.
        listening: Address that the server listens on. If it is of this machine alone, no other name may lead there:
            the owner of a name can point it anywhere.
    """
    if origin is None:
        return False
    if urlsplit(origin).netloc != host:
        return True
    return listening in THIS_MACHINE and urlsplit(origin).hostname not in THIS_MACHINE


def refuse_foreign_pages(server: viser.ViserServer, listening: str) -> None:
    """Closes connections of such pages before anything is sent to them; viser itself takes everybody."""
    sockets = server._websock_server

    async def check(connection: WebsockClientConnection) -> None:
        socket = sockets._live_connections[connection.client_id]
        headers = {} if socket.request is None else socket.request.headers
        if is_foreign(headers.get("Origin"), headers.get("Host"), listening):
            await socket.close(REFUSED, "this page is not from here")

    sockets.on_client_connect(check)
