"""Ctrl-C and SIGTERM that let the current iteration finish."""

import signal
import threading
from types import FrameType
from typing import Any


class Interrupt:
    """A context in which the first Ctrl-C is only recorded; the second one raises KeyboardInterrupt as usual.

    SIGTERM is recorded, too, every time: schedulers of clusters and torchrun send it some seconds before they kill.

    Outside the main thread, where Python does not handle signals, it does nothing.

    Attributes:
        requested: Whether Ctrl-C was pressed or SIGTERM arrived.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[int, Any] = {}
        self._is_main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> "Interrupt":
        if self._is_main:
            self._previous = {number: signal.signal(number, self._record) for number in (signal.SIGINT, signal.SIGTERM)}
        return self

    def _record(self, number: int, frame: FrameType | None) -> None:
        self.requested = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def __exit__(self, *_: object) -> None:
        for signal_number, handler in self._previous.items():
            signal.signal(signal_number, signal.SIG_DFL if handler is None else handler)
