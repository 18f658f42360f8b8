"""Refuses connections of foreign pages: any page in a browser may open a connection to a server on the same machine."""

import ipaddress
import re
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from typing import NamedTuple
from urllib.parse import urlsplit

import viser
from viser.infra import WebsockClientConnection

PORTS = {"http": 80, "https": 443}
"""Ports that browsers leave out, by scheme."""

POLICY_VIOLATION = 1008
"""Close code of the WebSocket protocol."""

MAX_REPORTED = 20
"""Number of origins whose refusal is reported: any page may make up more of them."""


class Origin(NamedTuple):
    """The origin of a page: browsers compare all three parts.

    Attributes:
        scheme: "http" or "https".
        host: Name in lower case and ASCII, or address in its shortest form.
        port: Port, also where browsers leave it out.
    """

    scheme: str
    host: str
    port: int

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.scheme}://{host}" + ("" if self.port == PORTS[self.scheme] else f":{self.port}")


def is_local(host: str) -> bool:
    """Whether a host is this machine, whatever a name server says."""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host.lower() == "localhost"


def parse_origin(text: str) -> Origin:
    """The origin of an address; its path, if any, is not part of it.

    Raises:
        ValueError: If it is not the address of a page that a server has sent.
    """
    try:
        parts = urlsplit(text)
        scheme, name, port = parts.scheme, parts.hostname or "", parts.port
        with suppress(ValueError):
            name = ipaddress.ip_address(name).compressed
        host = name if ":" in name else name.encode("idna").decode()
    except ValueError as error:
        raise ValueError(f"not an origin: {text!r} ({error})") from None
    if scheme not in PORTS or "@" in parts.netloc or not re.fullmatch(r"(?!null$)[a-z0-9._:-]+", host):
        raise ValueError(f"not an origin: {text!r}")
    return Origin(scheme, host, PORTS[scheme] if port is None else port)


def allowed_origins(texts: Iterable[str]) -> set[Origin]:
    """The origins that a user allows: as addresses, or as ``host`` or ``host:port``, which stand for both schemes.

    Raises:
        ValueError: If a text is neither.
    """
    allowed: set[Origin] = set()
    for text in texts:
        try:
            addresses = [text] if "://" in text else [f"{scheme}://{text}" for scheme in PORTS]
            allowed.update(map(parse_origin, addresses))
        except ValueError:
            raise ValueError(
                f"--allow-origin: expected the address of the page, such as https://gpu.example.org, got {text!r}"
            ) from None
    return allowed


def is_foreign(origin: str | None, host: str | None, listening: str, allowed: Collection[Origin] = ()) -> bool:
    """Whether a connection was opened by a page that neither this server has sent nor the user allows.

    Args:
        origin: Header Origin, the address of the page; programs other than browsers do not send it.
        host: Header Host, the ``name:port`` that the browser connects to.
        listening: Address that the server listens on. If it is local, names of other hosts are foreign, because their
            owners can point them at any address (DNS rebinding).
        allowed: Origins of other pages that may connect, as behind a proxy, which has a name of its own.
    """
    if origin is None:
        return False
    try:
        page = parse_origin(origin)
        if page in allowed:
            return False
        own = parse_origin(f"{page.scheme}://{host or ''}")  # a proxy may add the port that browsers leave out
    except ValueError:
        return True
    return page != own or (is_local(listening) and not is_local(page.host))


class Refusals:
    """Reports each origin that is refused once, with what to do."""

    def __init__(self, report: Callable[[str], object]) -> None:
        self._report = report
        self._reported: set[str] = set()

    def add(self, origin: str) -> None:
        """Reports a refusal, unless it was reported."""
        try:
            page = str(parse_origin(origin))
            remedy = f"if it is yours, as behind a proxy, start the viewer with --allow-origin {page}"
        except ValueError:
            page, remedy = ascii(origin)[:80], "open the viewer by the address that it has printed"
        if page in self._reported or len(self._reported) >= MAX_REPORTED:
            return
        self._reported.add(page)
        end = "; more refusals are not shown" if len(self._reported) == MAX_REPORTED else ""
        self._report(f"refused a page of {page}: {remedy}{end}")


def refuse_foreign_pages(
    server: viser.ViserServer, listening: str, allowed: Collection[Origin], report: Callable[[str], object]
) -> None:
    """Closes connections of foreign pages before anything is sent to them; viser itself accepts all connections.

    Args:
        server: The server.
        listening: Address that it listens on.
        allowed: Origins of other pages that may connect.
        report: Called with one line for each origin that is refused.
    """
    sockets, refusals = server._websock_server, Refusals(report)

    async def check(connection: WebsockClientConnection) -> None:
        socket = sockets._live_connections[connection.client_id]
        headers = {} if socket.request is None else socket.request.headers
        origin = headers.get("Origin")
        if is_foreign(origin, headers.get("Host"), listening, allowed):
            refusals.add(origin or "")
            await socket.close(POLICY_VIOLATION, "this page was not served by the viewer")

    sockets.on_client_connect(check)
