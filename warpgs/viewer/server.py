"""The server: the page, and a session for each browser."""

import contextlib
import io
import socket
import threading

import viser

from .looks import aim, first_look
from .origin import refuse_foreign_pages
from .session import Session
from .source import Source
from .training_cameras import TrainingCameras

LABEL = "warpgs"


class _Server(viser.ViserServer):
    """viser's server without its tunnel: any browser could ask for a public address."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


MAX_PORT = 65535


def check_address(host: str, port: int) -> None:
    """Refuses an address that can't be listened on: viser would look for another port, or never return.

    Raises:
        OSError: If the port is in use or the host is not of this machine; the message names both.
    """
    if not 0 <= port <= MAX_PORT:  # else only its last 16 bits would be tried here, and viser would hang
        raise OSError(f"can't listen on port {port}: choose a --port from 0 to {MAX_PORT}")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.create_server(address[:2], family=family):
            pass
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OSError(f"can't listen on {host}, port {port}: {reason}; choose another --port or --host") from error


class Viewer:
    """Serves a source until it is stopped; used as a context.

    Args:
        source: What is shown.
        training: Training cameras, if the capture is there.
        host, port: Address to listen on; port 0 is any that is free.

    Raises:
        OSError: If the address can't be listened on.
    """

    def __init__(self, source: Source, training: TrainingCameras | None, host: str, port: int) -> None:
        check_address(host, port)
        self._source, self._training = source, training
        self._rendering, self._changing = threading.Lock(), threading.Lock()
        self._stopped = False
        self.sessions: dict[int, Session] = {}
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own banner
            self._server = _Server(host, port, label=LABEL, verbose=False)
        self.port = self._server.get_port()
        if port not in (0, self.port):
            self.stop()
            raise OSError(f"can't listen on {host}, port {port}: Address already in use; choose another --port")
        self._server.gui.configure_theme(show_logo=False, show_share_button=False, dark_mode=True)
        refuse_foreign_pages(self._server, host)
        self._start = first_look(source, training)
        self._place_camera()
        self._server.on_client_connect(self._begin)
        self._server.on_client_disconnect(self._end)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Ends all sessions and the server."""
        for session in self._take_all():
            session.stop()
            session.join()
        with contextlib.redirect_stdout(io.StringIO()):
            self._server.stop()

    def _take_all(self) -> list[Session]:
        with self._changing:
            self._stopped = True
            sessions = list(self.sessions.values())
            self.sessions.clear()
        return sessions

    def _begin(self, client: viser.ClientHandle) -> None:
        width = 1280 if self._source.device.type == "cuda" else 640
        aim(client.camera, self._start)
        session = Session(client, self._source, self._training, self._rendering, width)
        with self._changing:
            stays = not self._stopped and client.client_id in self._server.get_clients()
            if stays:
                self.sessions[client.client_id] = session
        if not stays:  # it left while its session was made, and ``_end`` was there before us
            session.stop()

    def _end(self, client: viser.ClientHandle) -> None:
        with self._changing:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.stop()

    def _place_camera(self) -> None:
        """Where the browser's own "reset view" leads."""
        self._server.scene.set_up_direction(self._start.up)
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.up, camera.fov = self._start
