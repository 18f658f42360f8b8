"""Processes many frames on the cores of one machine."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import cv2

from warpgs.command_line.progress import progress

MAX_THREADS = 8
"""Maximum number of threads; more are limited by memory bandwidth."""

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_frames(job: Callable[[Item], Result], frames: Sequence[Item], label: str, quiet: bool) -> list[Result]:
    """The results of a job on every frame, in order.

    Threads suffice: OpenCV and large numpy operations release the interpreter's lock. OpenCV's own threads are turned
    off meanwhile, because frames in parallel use the cores better.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pool = ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS))
    try:
        futures = [pool.submit(job, frame) for frame in frames]
        return [future.result() for future in progress(futures, label, quiet)]
    finally:
        pool.shutdown(cancel_futures=True)
        cv2.setNumThreads(before)
