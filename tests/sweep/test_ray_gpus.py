"""A sweep on a machine with two GPUs, which Ray is told of: it only hands out their numbers."""

import importlib.util
import json
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray")

# Ray reads its environment when it is imported, which other tests of this process have done.
SCRIPT = """
import functools, json, os, pathlib, time
import torch
from warpgs.sweep import ray_pool
from warpgs.sweep.worker import Job


def pretend(job):
    pathlib.Path(job.folder, job.name).touch()
    while len(os.listdir(job.folder)) < 4:  # until all four run at once
        time.sleep(0.1)
    return json.dumps([os.environ[name] for name in ("CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS")])


torch.cuda.device_count = lambda: 2
ray_pool.run_job = pretend
ray = ray_pool._import_ray(None)
ray.init = functools.partial(ray.init, num_cpus=8)
pool = ray_pool.RayPool(None, None, 2, None)
for k in range(4):
    pool.submit(Job(str(k), FOLDER, "", "", (), pool.device))
found = []
while len(found) < 4:
    found += [json.loads(result.error) for result in pool.wait(1.0)]
print(json.dumps([pool.device, pool._head, os.environ["RAY_USAGE_STATS_ENABLED"], sorted(found)]))
pool.close()
"""


def test_trainings_share_gpus_and_cores_on_a_ray_that_only_this_machine_reaches(tmp_path):
    script = SCRIPT.replace("FOLDER", repr(str(tmp_path)))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    device, head, usage_stats, found = json.loads(done.stdout.splitlines()[-1])
    assert device == "cuda"
    assert head.startswith("127.0.0.1:")
    assert usage_stats == "0"
    assert found == [["0", "2"], ["0", "2"], ["1", "2"], ["1", "2"]]
