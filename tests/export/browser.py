"""A headless Chromium, controlled over two pipes, without any other package."""

import base64
import contextlib
import functools
import http.server
import json
import os
import select
import shutil
import subprocess
import sys
import threading
import time

import cv2
import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = [
    *("--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--hide-scrollbars", "--no-first-run"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--force-device-scale-factor=1"),
]
LAUNCH = """
import os, sys
ends = [os.dup(int(end)) for end in sys.argv[1:3]]  # copies, because 3 or 4 may be one of them
spare = [os.open(os.devnull, os.O_RDONLY) for _ in range(5)]
for target, end in zip((3, 4), [os.dup(end) for end in ends]):
    os.dup2(end, target)
os.execv(sys.argv[3], sys.argv[3:])
"""
"""The browser reads commands from file descriptor 3 and writes answers to file descriptor 4."""

TIMEOUT = 90.0
"""Maximum duration of any step [s]: test machines are busy."""


@contextlib.contextmanager
def served(folder):
    """Serves a folder; the value is its address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def executable():
    return next((path for name in NAMES if (path := shutil.which(name))), None)


class Browser:
    """One page in its own browser, with a profile in ``folder``."""

    def __init__(self, folder, width, height, scale=1, mobile=False):
        commands, self._to = os.pipe()
        self._from, answers = os.pipe()
        size = f"--window-size={width},{height}"
        ends = [str(commands), str(answers)]
        self._process = subprocess.Popen(
            [sys.executable, "-c", LAUNCH, *ends, executable(), *OPTIONS, size, f"--user-data-dir={folder}"],
            pass_fds=(commands, answers),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(commands)
        os.close(answers)
        self._received, self._last, self.events, self._session = b"", 0, [], None
        self._first = None
        self._size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": mobile}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.terminate()
        self._process.wait(TIMEOUT)
        os.close(self._to)
        os.close(self._from)

    def open(self, address):
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Network", "Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")
        self.call("Emulation.setDeviceMetricsOverride", **self._size)
        self.call("Emulation.setTouchEmulationEnabled", enabled=self._size["mobile"])
        if self._first is not None:
            self.call("Page.addScriptToEvaluateOnNewDocument", source=self._first)
        self.call("Page.navigate", url=address)

    def on_open(self, script):
        """Runs a script before those of pages that are opened from now on."""
        self._first = script

    def call(self, method, **parameters):
        self._last += 1
        message = {"id": self._last, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._last:
                assert "error" not in answer, answer
                return answer["result"]
            self.events.append(answer)

    def _next(self):
        end = time.monotonic() + TIMEOUT
        while b"\0" not in self._received:
            ready, _, _ = select.select([self._from], [], [], max(0.0, end - time.monotonic()))
            assert ready, "the browser does not answer"
            self._received += os.read(self._from, 1 << 20)
        message, _, self._received = self._received.partition(b"\0")
        return json.loads(message)

    def value(self, expression):
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def until(self, expression):
        end = time.monotonic() + TIMEOUT
        while not self.value(expression):
            assert time.monotonic() < end, (expression, self.events[-5:])
            time.sleep(0.05)

    def requests(self):
        """Addresses that the page requested."""
        return [e["params"]["request"]["url"] for e in self.events if e.get("method") == "Network.requestWillBeSent"]

    def errors(self):
        """Errors and warnings of the page, except those about the speed of the software renderer."""
        logged = [e["params"] for e in self.events if e.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded")]
        return [entry for entry in logged if "GPU stall" not in json.dumps(entry)]

    def screenshot(self):
        """[H, W, 3] 8-bit RGB."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.cvtColor(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
