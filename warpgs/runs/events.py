"""TensorBoard events of a run."""

import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.summary.writer.record_writer import RecordWriter

from warpgs.files import reworded

_numbers = count()
"""Numbers of the event files of this process."""


class Events:
    """A file of TensorBoard events that is written at once.

    SummaryWriter writes in a thread of its own, which ends in a traceback on a full disk, and opens the file by its
    path for every event, so that it fails in a folder that was moved.

    Args:
        folder: Folder of all event files of a run.
        first_iteration: Iterations that are done: events of earlier files after them do not count.

    Raises:
        OSError: If the file cannot be written; all methods do so, and the message names it.
    """

    def __init__(self, folder: Path, first_iteration: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        unique = f"{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}.{next(_numbers)}"
        self.path = folder / f"events.out.tfevents.{unique}"
        self._file = open(self.path, "xb")  # noqa: SIM115  closed by ``close``
        self._records = RecordWriter(self._file)
        self.add(first_iteration, file_version="brain.Event:2")
        self.add(first_iteration + 1, session_log=SessionLog(status=SessionLog.START))
        self.flush()

    def add(self, iteration: int, **content: Any) -> None:
        """Adds an event with one of the contents that its protocol buffer has."""
        event = Event(wall_time=time.time(), step=iteration, **content)
        with self._named_errors():
            self._records.write(event.SerializeToString())

    def flush(self) -> None:
        """Lets TensorBoard see what was added."""
        with self._named_errors():
            self._file.flush()

    def close(self) -> None:
        """Closes the file."""
        with self._named_errors():
            self._file.close()

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise reworded(error, f"{self.path} could not be written: {error.strerror or error}") from error
