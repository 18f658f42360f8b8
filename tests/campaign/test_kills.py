"""A training that is killed at any time, again and again, ends in the same bits as one that is left alone."""

import multiprocessing
import random
import signal
import sys
import time
from collections import Counter

import pytest

from tests import tiny
from tests.campaign.training import train
from warpgs.runs import checkpoint

pytestmark = pytest.mark.usefixtures("quickly")

PER_KILL = 25
"""Inputs of the other campaigns per kill, which takes longer."""

MIN_KILLS = 40
"""Fewer do not reach all stages."""

PART, LONGER = 0.3, 1.1
"""A training lives for at most this part of its duration, and this factor longer after each kill: it always ends."""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_trainings_that_are_killed_again_and_again_are_bit_identical(tmp_path, count):
    if count < MIN_KILLS * PER_KILL:
        pytest.skip(f"takes minutes: --campaign {MIN_KILLS * PER_KILL} kills {MIN_KILLS} times, more in proportion")
    processes = multiprocessing.get_context("forkserver")
    processes.set_forkserver_preload(["tests.campaign.training"])
    data = tiny.write(tmp_path / "cache")

    def lives(run, seconds=None):
        """Whether a training ends by itself within a time."""
        process = processes.Process(target=train, args=(data, run))
        process.start()
        process.join(seconds)
        process.kill()
        process.join()
        assert process.exitcode in (0, -signal.SIGKILL)
        return process.exitcode == 0

    assert lives(tmp_path / "first")  # starts the server and loads the kernels
    start = time.monotonic()
    assert lives(tmp_path / "whole")
    duration = time.monotonic() - start
    r, kills, stages, run = random.Random(count), 0, Counter[int](), 0
    while kills < count // PER_KILL:
        folder, limit = tmp_path / f"run{run}", PART * duration
        while not lives(folder, r.uniform(0.0, limit)):
            kills, limit = kills + 1, LONGER * limit
            saved = checkpoint.list_checkpoints(folder)
            stages[checkpoint.load(saved[-1]).metadata.iteration if saved else -1] += 1
        assert tiny.differences(tiny.state(folder), tiny.state(tmp_path / "whole")) == []
        assert not list((folder / checkpoint.FOLDER).glob("*.partial"))
        run += 1
    sys.stdout.write(f"{kills} kills in {run} trainings; newest checkpoints then: {sorted(stages.items())}\n")
    assert len(stages) > 3
