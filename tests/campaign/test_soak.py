"""Memory stays flat in a long training."""

import dataclasses
import sys
from pathlib import Path

import pytest

from tests import tiny
from tests.tiny import quickly  # noqa: F401  # a fixture
from warpgs.config import scaled

pytestmark = pytest.mark.usefixtures("quickly")

MIN_ITERATIONS = 1000
"""Fewer iterations are too few for memory to settle."""

MAX_GROWTH = 8 << 20
"""Bytes by which resident memory may grow after the first third."""


def resident() -> int:
    """Resident memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


@pytest.mark.skipif(not Path("/proc/self/statm").is_file(), reason="needs /proc")
def test_the_memory_of_a_long_training_is_flat(tmp_path, count):
    if count < MIN_ITERATIONS:
        pytest.skip(f"takes minutes: --campaign {MIN_ITERATIONS} trains as many iterations")
    config = scaled(dataclasses.replace(tiny.CONFIG, iterations=count, checkpoint_every=97, keep_checkpoints=2))
    trainer = tiny.trainer(tiny.write(tmp_path / "cache"), tmp_path / "run", config)
    sizes: list[int] = []

    def measure() -> bool:
        if trainer.iteration % 20 == 0:
            sizes.append(resident())
        return False

    assert tiny.train(trainer, tiny.StopWhen(measure))
    assert trainer.iteration == count
    settled = sizes[len(sizes) // 3 :]
    growth = max(settled[len(settled) // 2 :]) - max(settled[: len(settled) // 2])
    sys.stdout.write(f"resident memory over {count} iterations [MiB]: {[size >> 20 for size in sizes]}\n")
    assert growth < MAX_GROWTH
