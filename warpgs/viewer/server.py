"""The server: it serves the page and has one session per browser."""

import contextlib
import io
import json
import os
import socket
import threading
import time
import warnings
from collections.abc import Callable, Collection

import viser
from viser._messages import RunJavascriptMessage

from .browser_camera import set_camera, start_camera
from .origin import Origin, refuse_foreign_pages
from .page_state import PageState
from .session import Session
from .source import Source
from .training_cameras import TrainingCameras

MAX_PORT = 65535
STOP_SECONDS = 0.5
"""Maximum time that the server may take to end [s]; what is left then are daemon threads."""

RELOAD_SECONDS = 5.0
"""Time within which a page that connects is the reload of the one that has left [s]: viser names no browser tabs."""

CUDA_WIDTH, CPU_WIDTH = 1280, 640
"""Initial width of the images [px], by device."""


class _Server(viser.ViserServer):
    """viser's server without its public tunnel, which any browser could request."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def check_address(host: str, port: int) -> None:
    """Checks that the server can listen on an address: viser would choose another port, or never return.

    Raises:
        OSError: If the port is in use or the host is another machine; the message names both.
    """
    if not 0 <= port <= MAX_PORT:  # its last 16 bits might be free, and viser would hang
        raise OSError(f"cannot listen on port {port}: choose a --port from 0 to {MAX_PORT}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.create_server(address[:2], family=family):
            pass
    except (OSError, UnicodeError) as error:
        # Python adds the address to the system's text of an error in binding, whose number is positive.
        number = getattr(error, "errno", None) or 0
        reason = os.strerror(number) if number > 0 else getattr(error, "strerror", None) or error
        raise OSError(
            f"cannot listen on {host}, port {port}: {reason}; choose another --port (0 takes a free one) or --host"
        ) from error


class Viewer:
    """Serves a source until it is stopped; a context manager.

    Args:
        source: The scene to show.
        training: The training cameras, if the capture can be read.
        host: Host to listen on.
        port: Port to listen on; 0 chooses a free one.
        allowed: Origins of pages that may connect besides the viewer's own.
        warn: Called with one line for each origin that is refused.

    Attributes:
        port: The port that the server listens on.
        sessions: Sessions of the connected browsers, by client.

    Raises:
        OSError: If the server cannot listen on the address.
    """

    def __init__(
        self,
        source: Source,
        training: TrainingCameras | None,
        host: str,
        port: int,
        allowed: Collection[Origin] = (),
        warn: Callable[[str], object] = warnings.warn,
    ) -> None:
        check_address(host, port)
        self._source, self._training = source, training
        self._rendering, self._lock = threading.Lock(), threading.Lock()
        self._stopped = False
        self._left: tuple[float, PageState] | None = None  # when the last page left, and what it showed
        self.sessions: dict[int, Session] = {}
        with contextlib.redirect_stdout(io.StringIO()):  # without viser's banner
            self._server = _Server(host, port, label=source.run.folder.resolve().name, verbose=False)
        self.port = self._server.get_port()
        if port not in (0, self.port):
            self.stop()
            raise OSError(f"cannot listen on {host}, port {port}: Address already in use; choose another --port")
        self._server.gui.configure_theme(
            control_width="small", show_logo=False, show_share_button=False, dark_mode=True
        )
        self._server.gui.main_panel.dock_right()  # beside the image, not over it
        self._name_tab()
        refuse_foreign_pages(self._server, host, allowed, warn)
        self._start = start_camera(source, training)
        self._set_initial_camera()
        self._server.on_client_connect(self._add_session)
        self._server.on_client_disconnect(self._remove_session)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Ends sessions, server and source; waits ``STOP_SECONDS`` at most for images and for slow browsers."""
        end = time.monotonic() + STOP_SECONDS
        sessions = self._remove_all()
        for session in sessions:
            session.stop()
        stop = threading.Thread(target=self._server.stop, daemon=True)  # waits seconds for connections to be closed
        with contextlib.redirect_stdout(io.StringIO()):
            stop.start()
            for join in (*(session.join for session in sessions), stop.join):
                join(max(end - time.monotonic(), 0.0))
        self._source.stop()

    def _remove_all(self) -> list[Session]:
        with self._lock:
            self._stopped = True
            sessions = list(self.sessions.values())
            self.sessions.clear()
        return sessions

    def _add_session(self, client: viser.ClientHandle) -> None:
        width = CUDA_WIDTH if self._source.device.type == "cuda" else CPU_WIDTH
        set_camera(client.camera, self._start)
        with self._lock:
            left, self._left = self._left, None
        view = left[1] if left is not None and time.monotonic() - left[0] < RELOAD_SECONDS else None
        session = Session(client, self._source, self._training, self._rendering, width, view)
        with self._lock:
            is_connected = not self._stopped and client.client_id in self._server.get_clients()
            if is_connected:
                self.sessions[client.client_id] = session
        if not is_connected:  # it disconnected, or the server stopped, while its session was created
            session.stop()

    def _remove_session(self, client: viser.ClientHandle) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
            if session is not None:
                self._left = (time.monotonic(), session.view())
        if session is not None:
            session.stop()

    def _name_tab(self) -> None:
        """Names the browser's tab after the run; viser has no other way than the one that it loads its plots by."""
        title = json.dumps(self._source.run.folder.resolve().name)
        self._server._websock_server.queue_message(RunJavascriptMessage(f"document.title = {title};"))

    def _set_initial_camera(self) -> None:
        """Sets the camera of the browser's button "reset view"."""
        self._server.scene.set_up_direction(self._start.up)
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = self._start
