"""Memory stays flat in long trainings, and from one training to the next."""

import dataclasses
import gc
import sys
import time

import pytest

from tests import tiny
from tests.campaign.memory import MAX_GROWTH, growth, in_mebibytes, needs_proc, resident
from warpgs.config import scaled
from warpgs.runs import checkpoint

pytestmark = pytest.mark.usefixtures("quickly")

MIN_ITERATIONS = 1000
"""Fewer iterations are too few for memory to settle."""


@needs_proc
def test_the_memory_of_long_trainings_is_flat(tmp_path, count, minutes, monkeypatch):
    if count < MIN_ITERATIONS:
        pytest.skip(f"takes minutes: --campaign {MIN_ITERATIONS} trains as many iterations, --minutes 30 repeatedly")
    monkeypatch.setattr(checkpoint, "NUM_KEPT", 2)
    config = scaled(dataclasses.replace(tiny.CONFIG, iterations=count, checkpoint_every=97))
    data, start, runs = tiny.write(tmp_path / "cache"), time.monotonic(), 0
    sizes: list[int] = []
    while not sizes or time.monotonic() < start + 60 * minutes:
        trainer = tiny.trainer(data, tmp_path / f"run{runs}", config)

        def measure(trainer=trainer) -> bool:
            if trainer.iteration % 20 == 0:
                sizes.append(resident())
            return False

        assert tiny.train(trainer, tiny.StopWhen(measure))
        assert trainer.iteration == count
        runs += 1
        del trainer, measure
        gc.collect()
    duration = (time.monotonic() - start) / 60
    sys.stdout.write(f"{runs} trainings of {count} iterations in {duration:.0f} minutes\n")
    sys.stdout.write(f"resident memory [MiB]: {in_mebibytes(sizes)}, growth {growth(sizes) / 2**20:.2f}\n")
    assert growth(sizes) < MAX_GROWTH
