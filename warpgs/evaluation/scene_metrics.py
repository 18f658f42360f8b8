"""Metrics of a whole scene: flicker of the static region, and frames per second."""

import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch

from warpgs.cameras import Camera
from warpgs.command_line.progress import progress
from warpgs.rendering import Rendering

from . import image_quality
from .metric import Renderer

STATIC_ALPHA = 0.05
"""A pixel counts as static for the flicker score where the dynamic image's alpha is lower than this in both frames."""

FLICKER_FRAMES = 30
TIMED_FRAMES = 30
TIMED_SECONDS = 0.5
"""Frames are timed in rounds of ``TIMED_FRAMES``, for at least ``TIMED_SECONDS`` [s]."""


def flicker(scene: Renderer, cameras: Sequence[Camera], quiet: bool) -> float | None:
    """Mean absolute change between consecutive renderings of the static region through the middle camera, held fixed.

    None with fewer than two times. There is no ground truth of a fixed camera in a capture of a moving one, so changes
    that are real (shadows) count too.
    """
    middle, times = cameras[len(cameras) // 2], sorted({camera.time for camera in cameras})
    changes = []
    before: Rendering | None = None
    for at in progress(times[:FLICKER_FRAMES], "flicker", quiet):
        after = scene.render(replace(middle, time=at), branches=True)
        if before is not None:
            assert before.dynamic is not None
            assert after.dynamic is not None
            static = (before.dynamic.alpha < STATIC_ALPHA) & (after.dynamic.alpha < STATIC_ALPHA)
            change = image_quality.flicker(before.joint.image.clamp(0, 1), after.joint.image.clamp(0, 1), static)
            changes += [] if math.isnan(change) else [change]
        before = after
    return statistics.fmean(changes) if changes else None


def playback_rate(scene: Renderer, cameras: Sequence[Camera], quiet: bool) -> float:
    """Joint images per second through pinholes, as viewers have, including everything that depends on time."""
    return frame_rate(scene.play, [camera.pinhole for camera in cameras])


def frame_rate(play: Callable[[Camera], object], cameras: Sequence[Camera]) -> float:
    """Frames per second of wall time, after one warm-up frame, cycling through the cameras."""
    device = cameras[0].viewmat.device

    def play_frames(count: int) -> None:
        for k in range(count):
            play(cameras[k % len(cameras)])
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    play_frames(1)
    start, rounds = time.perf_counter(), 0
    while time.perf_counter() - start < TIMED_SECONDS:
        play_frames(TIMED_FRAMES)
        rounds += 1
    return rounds * TIMED_FRAMES / (time.perf_counter() - start)
