"""A training that is killed at any time, again and again, ends in the same bits as one that is left alone."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests import tiny
from tests.tiny import quickly  # noqa: F401  # a fixture
from warpgs.runs import checkpoint

pytestmark = pytest.mark.usefixtures("quickly")

RUN_EVERY = 1000
"""Inputs of the other campaigns per run that is killed again and again."""

TRAIN = """
import sys
from pathlib import Path
from tests import tiny
with tiny.in_haste():
    trainer = tiny.trainer(Path(sys.argv[1]), Path(sys.argv[2]))
    trainer.restore_newest(print)
    print("ready", flush=True)
    tiny.train(trainer)
print("finished", flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="needs SIGKILL")
def test_a_training_killed_again_and_again_is_bit_identical(tmp_path, count):
    if count < RUN_EVERY:
        pytest.skip(f"takes minutes: --campaign {RUN_EVERY} kills one run, a multiple several")
    data = tiny.write(tmp_path / "cache")
    tiny.train(tiny.trainer(data, tmp_path / "whole"))
    killed = 0
    for seed in range(count // RUN_EVERY):
        r, finished = random.Random(seed), False
        run = tmp_path / f"run{seed}"
        command = [sys.executable, "-c", TRAIN, str(data), str(run)]
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
        while not finished:
            with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
                assert process.stdout is not None
                ready = any(line == "ready\n" for line in iter(process.stdout.readline, ""))
                assert ready
                time.sleep(r.uniform(0.0, 1.5))
                process.kill()
                finished = "finished\n" in process.stdout.read()
            killed += process.returncode == -signal.SIGKILL
        assert tiny.differences(tiny.state(run), tiny.state(tmp_path / "whole")) == []
        assert not list((run / checkpoint.FOLDER).glob("*.partial"))
    assert killed > 0
