"""A scripted browser: the protocol of viser's page, without a page."""

import random
import struct
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import msgspec
import viser
import zstandard
from websockets.sync.client import connect

SECONDS = 120.0
"""Maximum time to wait for the viewer [s], on a machine that may have other work."""


class Browser:
    """Connects to a viewer of this machine, and shows it a camera.

    Args:
        port: Port of the viewer.
        r: Chooses the cameras.
    """

    def __init__(self, port: int, r: random.Random) -> None:
        self._socket = connect(
            f"ws://127.0.0.1:{port}",
            origin=f"http://127.0.0.1:{port}",
            subprotocols=[f"viser-v{viser.__version__}"],
            compression=None,
            max_size=None,
            open_timeout=SECONDS,
        )
        self._r, self.images = r, 0
        self._controls: dict[str, str] = {}
        self._canvas = (r.randrange(80, 320), r.randrange(60, 240))
        self.move()

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if kind is None and self._r.random() < 0.5:
            self._socket.close()
        else:  # a lost connection: without a word
            self._socket.socket.close()

    def _send(self, kind: str, **fields: Any) -> None:
        self._socket.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def move(self) -> None:
        """Goes to a random camera."""
        position = [self._r.uniform(-0.3, 0.3) for _ in range(3)]
        self._send(
            "ViewerCameraMessage",
            wxyz=(1.0, 0.0, 0.0, 0.0),
            position=position,
            fov=self._r.uniform(0.5, 1.5),
            near=0.01,
            far=1000.0,
            image_width=self._canvas[0],
            image_height=self._canvas[1],
            look_at=(*position[:2], position[2] + 1.0),
            up_direction=(0.0, -1.0, 0.0),
        )

    def set(self, label: str, value: Any) -> None:
        """Changes a control, or clicks a button (True)."""
        self._receive(lambda: label in self._controls)
        self._send("GuiUpdateMessage", uuid=self._controls[label], updates={"value": value})

    def point(self, kind: str, *positions: tuple[float, float], modifier: str | None = None) -> None:
        """Clicks ("click") at a position on the screen, or drags a rectangle ("rect-select") between two."""
        ray = (0.0, 0.0, 1.0) if kind == "click" else None
        fields = {"ray_origin": ray, "ray_direction": ray, "screen_pos": positions, "modifier": modifier}
        self._send("ScenePointerMessage", event_type=kind, **fields)

    def look(self) -> None:
        """Waits for another image."""
        seen = self.images
        self._receive(lambda: self.images > seen)

    def _receive(self, until: Callable[[], bool]) -> None:
        """Reads what the viewer sends until a condition holds."""
        end = time.monotonic() + SECONDS
        while not until():
            for message in messages(self._socket.recv(timeout=end - time.monotonic())):
                if message["type"] == "BackgroundImageMessage":
                    self.images += 1
                elif "props" in message and "uuid" in message:
                    self._controls[str(message["props"].get("label"))] = message["uuid"]


def messages(data: bytes) -> list[dict[str, Any]]:
    """The messages of one packet of viser: its size and its compressed size, the messages, then arrays."""
    size, compressed = struct.unpack_from("<QQ", data)
    packed = zstandard.ZstdDecompressor().decompress(data[16 : 16 + compressed], max_output_size=size)
    return list(msgspec.msgpack.decode(packed)["messages"])
