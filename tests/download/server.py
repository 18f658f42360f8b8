"""A web server on this machine with archives like the released ones, which can break connections and ignore ranges."""

import io
import signal
import threading
import time
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path


class Server(ThreadingHTTPServer):
    """Serves ``files`` by path.

    Attributes:
        files: Content by path.
        ranges: The header Range of every request, None for none.
        cuts: Numbers of bytes after which the next responses end too early; further ones are complete.
        has_ranges: Whether it obeys the header Range.
        interrupts_at: File of the client; Ctrl-C reaches the main thread once it has some of a response that is cut.
    """

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.ranges: list[str | None] = []
        self.cuts: list[int] = []
        self.has_ranges = True
        self.interrupts_at: Path | None = None
        self.goes_on = threading.Event()
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def stop(self):
        self.goes_on.set()
        self.shutdown()
        self.server_close()


class Handler(BaseHTTPRequestHandler):
    server: Server

    def log_message(self, *_):
        pass

    def do_GET(self):
        data = self.server.files.get(self.path)
        if data is None:
            self.send_error(404)
            return
        asked = self.headers["Range"]
        self.server.ranges.append(asked)
        start = int(asked.removeprefix("bytes=").removesuffix("-")) if asked and self.server.has_ranges else 0
        if start >= len(data):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(data)}")
            self.end_headers()
            return
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(data) - start))
        self.end_headers()
        self.wfile.write(data[start:][: self.server.cuts.pop(0) if self.server.cuts else None])
        if partial := self.server.interrupts_at:
            while not (partial.exists() and partial.stat().st_size):
                time.sleep(0.01)
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            self.server.goes_on.wait(60)


def zipped(files: dict[str, bytes]) -> bytes:
    """A .zip file."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return data.getvalue()


def files_of(root: Path, prefix: str) -> dict[str, bytes]:
    """The files of a folder, as members of an archive."""
    return {
        f"{prefix}{path.relative_to(root)}": path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()
    }
