"""Work on many frames over the cores of one machine."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2

from warpgs.progress import progress

MAX_THREADS = 8
"""More than that are limited by memory."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(job: Callable[[Item], Result], items: Sequence[Item], label: str, quiet: bool) -> list[Result]:
    """The results of a job on every item, in their order.

    Threads suffice: OpenCV and large numpy operations release the interpreter's lock. OpenCV's own threads are turned
    off meanwhile, frames side by side use the cores better.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS))
    try:
        futures = [pool.submit(job, item) for item in items]
        return [future.result() for future in progress(futures, label, quiet)]
    finally:
        pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(before)
