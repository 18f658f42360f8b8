"""Sweeps on a real Ray; with ``--cluster`` on two nodes, of which one is killed in the middle."""

import contextlib
import http.server
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

pytest.importorskip("ray")

from warpgs.sweep import ray_pool
from warpgs.sweep.ray_pool import RayPool
from warpgs.sweep.scheduler import ClusterGoneError, Result
from warpgs.sweep.worker import Job

pytestmark = pytest.mark.filterwarnings("default")  # Ray's own


def job(name, argument=""):
    return Job(name, "", "", "", (argument,), "cpu")


@pytest.fixture(scope="module")
def pool():
    def pretend(job):
        import os
        import time

        if job.name == "crash":
            os._exit(1)
        if job.name == "bug":
            raise RuntimeError("a bug")
        if job.name.startswith("long"):
            try:
                open(job.arguments[0], "w").close()
                for _ in range(600):
                    time.sleep(0.1)
            except KeyboardInterrupt:
                open(job.arguments[0] + ".saved", "w").close()
                raise
        return job.arguments[0] or None

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ray_pool, "run_job", pretend)
        made = RayPool(None, None, 1, 1)
    yield made
    made.close()


def results(pool, count, seconds=60):
    found, deadline = {}, time.monotonic() + seconds
    while len(found) < count and time.monotonic() < deadline:
        found.update({result.name: result for result in pool.wait(0.2)})
    return found


def test_jobs_report_success_failure_bugs_and_lost_workers(pool):
    assert pool.device == "cpu"
    for made in (job("good"), job("bad", "broken capture"), job("crash"), job("bug")):
        pool.submit(made)
    found = results(pool, 4)
    assert (found["good"].error, found["bad"].error) == (None, "broken capture")
    assert found["crash"].is_lost
    assert not found["bug"].is_lost
    assert "a bug" in found["bug"].error
    assert {found[name].node for name in ("good", "bad")} == pool.nodes()


def test_a_queued_job_that_is_moved_runs_only_elsewhere_and_one_that_runs_goes_on(pool, tmp_path):
    (tmp_path / "runs").touch()
    running = [
        job(f"long{k}", str(tmp_path / f"started{k}"))._replace(running=str(tmp_path / "runs"))
        for k in range(os.cpu_count())
    ]
    queued = job("queued")._replace(running=str(tmp_path / "does not run"))
    for made in (*running, queued):
        pool.submit(made)
    wait_until(lambda: all(Path(made.arguments[0]).exists() for made in running))
    for made in (*running, queued):
        pool.move(made, pool.nodes())  # there is no other node
    assert results(pool, 1, seconds=3) == {}
    for made in (*running, queued):
        pool.move(made, frozenset())
    assert not list(tmp_path.glob("*.saved"))
    for made in running:
        pool._ray.cancel(pool._references[made.name])
    assert results(pool, len(running) + 1)["queued"] == Result("queued", None, node=next(iter(pool.nodes())))


def test_stop_interrupts_what_runs_and_drops_what_waits(pool, tmp_path):
    paths = [tmp_path / f"started{k}" for k in range(os.cpu_count() + 1)]
    for k, path in enumerate(paths):
        pool.submit(job(f"long{k}", str(path)))
    deadline = time.monotonic() + 60
    while sum(path.exists() for path in paths) < os.cpu_count() and time.monotonic() < deadline:
        pool.wait(0.2)
    stopped = time.monotonic()
    pool.stop()
    assert time.monotonic() - stopped < 20
    started = [path for path in paths if path.exists()]
    assert len(started) == os.cpu_count()
    assert all(path.with_name(path.name + ".saved").exists() for path in started)


def test_an_address_without_a_cluster_is_refused_at_once():
    started = time.monotonic()
    with pytest.raises(ConnectionError, match=r"there is no Ray cluster at 127\.0\.0\.1:9 .*refused"):
        RayPool("127.0.0.1:9", None, 1, None)
    with pytest.raises(ConnectionError, match="expected HOST:PORT"):
        RayPool("auto", None, 1, None)
    assert time.monotonic() - started < 5


@pytest.mark.parametrize("port", ["of an HTTP server", "of a node"])
def test_what_is_not_the_head_of_a_cluster_is_refused_in_one_line(pool, capfd, port):
    with http.server.HTTPServer(("127.0.0.1", 0), http.server.BaseHTTPRequestHandler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        number = server.server_port if port == "of an HTTP server" else pool._ray.nodes()[0]["NodeManagerPort"]
        with pytest.raises(ConnectionError, match=rf"what answers at 127\.0\.0\.1:{number} is not the head of a Ray"):
            ray_pool._require_head(f"127.0.0.1:{number}")
        server.shutdown()
    assert "gcs_client" not in capfd.readouterr().err
    ray_pool._require_head(pool._head)


CRASH = """
import os, time
from warpgs.sweep import ray_pool
from warpgs.sweep.worker import Job

def crash(job):
    os._exit(1)

ray_pool.run_job = crash
pool = ray_pool.RayPool(None, "cpu", 1, 1)
pool.submit(Job("cell", "", "", "", (), "cpu"))
while not pool.wait(0.2):
    pass
time.sleep(3)  # Ray would print from a thread of its own
pool.close()
"""


def test_ray_prints_nothing_about_workers_that_died():
    done = subprocess.run([sys.executable, "-c", CRASH], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


SWEEP = """
import sys, time
from pathlib import Path
from warpgs.errors import run_command, terminable
from warpgs.sweep import ray_pool
from warpgs.sweep.scheduler import run_jobs
from warpgs.sweep.worker import Job

def train(job):
    try:
        Path(job.folder, "started").touch()
        for _ in range(600):
            time.sleep(0.1)  # in steps, so that Ray can interrupt
    except KeyboardInterrupt:
        time.sleep(1)
        Path(job.folder, "saved").touch()
        raise

def sweep():
    with terminable():
        pool = ray_pool.RayPool(None, "cpu", 1, 1)
        try:
            run_jobs(pool, [Job("cell", sys.argv[1], "", "", (), "cpu")], print, lambda: None)
        finally:
            pool.close()

ray_pool.run_job = train
sys.exit(run_command(sweep))
"""


@pytest.fixture
def start(tmp_path):
    """Starts a sweep of one cell, after a command such as ``timeout``, in a session of its own."""
    started = []

    def start(*command):
        words = [*command, sys.executable, "-c", SWEEP, str(tmp_path)]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        started.append(subprocess.Popen(words, text=True, start_new_session=True, **pipes))
        return started[-1]

    yield start
    for process in started:
        for pid in session(process):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.communicate()


def session(process):
    """The processes of a session, by name."""
    lines = subprocess.run(["ps", "-o", "pid=,comm=", "-s", str(process.pid)], capture_output=True, text=True).stdout
    return {int(pid): name for pid, name in (line.split(maxsplit=1) for line in lines.splitlines())}


def wait_until(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def leaves_nothing(process, *but):
    wait_until(lambda: not [name for name in session(process).values() if "defunct" not in name and name not in but])
    return True


def to_all(process):
    for pid in session(process):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)


SIGNALS = {
    "SIGTERM to the sweep": lambda process: process.terminate(),
    "SIGTERM to its process group, as timeout sends it": lambda process: os.killpg(process.pid, signal.SIGTERM),
    "SIGTERM to each process, as Slurm and systemd send it": to_all,
    "Ctrl-C in the terminal": lambda process: os.killpg(process.pid, signal.SIGINT),
}


@pytest.mark.parametrize("send", SIGNALS.values(), ids=SIGNALS.keys())
def test_a_signal_stops_a_sweep_which_saves_its_cells(start, tmp_path, send):
    process = start()
    wait_until((tmp_path / "started").exists)
    send(process)
    assert process.communicate(timeout=60) == ("", "warpgs: stopped\n")
    assert process.returncode == 130
    assert (tmp_path / "saved").exists()
    assert leaves_nothing(process)


def test_timeout_which_sends_sigterm_twice_stops_a_sweep_which_saves_its_cells(start, tmp_path):
    process = start("timeout", "--preserve-status", "15")
    assert process.communicate(timeout=60) == ("", "warpgs: stopped\n")
    assert process.returncode == 130
    assert (tmp_path / "saved").exists()
    assert leaves_nothing(process)


@pytest.mark.parametrize("send", list(SIGNALS.values())[-2:], ids=list(SIGNALS)[-2:])
@pytest.mark.parametrize("started", ["gcs_server", "raylet"])
def test_a_signal_while_ray_starts_is_one_line_and_leaves_nothing(start, started, send):
    process = start()
    wait_until(lambda: started in session(process).values())
    send(process)
    assert process.communicate(timeout=60) == ("", "warpgs: stopped\n")
    assert process.returncode == 130
    assert leaves_nothing(process)


def test_a_sweep_that_is_killed_leaves_nothing(start, tmp_path):
    process = start()
    wait_until((tmp_path / "started").exists)
    process.kill()
    process.communicate()
    agents = ("ray::DashboardA", "ray::RuntimeEnv")  # end a minute later, when they have not reached the rest of Ray
    assert leaves_nothing(process, *agents)


def test_a_training_that_fits_on_no_node_is_refused(pool):
    with pytest.raises(ValueError, match="no node of the cluster has 1000 cores for a training: "):
        pool._check_room(0.0, 1000)


def test_a_cluster_whose_head_is_silent_is_gone(pool, monkeypatch):
    monkeypatch.setattr(pool, "_head", "127.0.0.1:9")
    monkeypatch.setattr(ray_pool, "MAX_SILENCE", 0.0)
    monkeypatch.setattr(ray_pool, "PROBE_SECONDS", 0.01)
    with pytest.raises(ClusterGoneError, match=r"the Ray cluster at 127\.0\.0\.1:9 is gone"):
        results(pool, 1)


TOML = """
preset = "quick"
seeds = 4
[options]
model = {position_bands = 2, time_bands = 2, depth = 2, width = 8, skip = 1, max_static_points = 50, \
dynamic_points = 20}
loss.ssim = 0.0
densify.max_gaussians = 120
iterations = 600
checkpoint_every = 10
"""


@contextlib.contextmanager
def cluster_of(request, *environments):
    """A cluster of a head, on which nothing is trained, and a node of one core in each environment."""
    if not request.config.getoption("--cluster"):
        pytest.skip("minutes; runs with --cluster")
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    made.workers = []
    for environment in environments:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in environment.items():
                patch.setenv(name, value)
            made.workers.append(made.add_node(num_cpus=1))
    yield made
    made.shutdown()


@pytest.fixture
def cluster(request):
    with cluster_of(request, {}, {}) as made:
        yield made


def running_from(out, iteration):
    """The cells that run and have a checkpoint of this iteration or a later one; older checkpoints are removed."""
    saved = (path for path in out.glob("*/checkpoints/*.safetensors") if int(path.stem) >= iteration)
    return {path.parents[1].name for path in saved} & {path.name for path in out.glob("running/*")}


@contextlib.contextmanager
def sweeping(cluster, folder, *options):
    """The command in a process of its own; yields it once two running cells have written checkpoints."""
    from tests import tiny

    (folder / "tiny.toml").write_text(TOML)
    command = [sys.executable, "-m", "warpgs", "sweep", "tiny.toml", "--data", f"tiny={tiny.write(folder / 'capture')}"]
    command += ["--out", "out", "--address", cluster.address, "--cpus", "1", *options]
    process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        while process.poll() is None and len(running_from(folder / "out", 20)) < 2:
            time.sleep(0.1)
        yield process
    finally:
        process.kill()
        process.wait()


def kill(node):
    """Ends all of Ray on a node at once, as a power failure does; trainings must follow by themselves."""
    started = [info.process.pid for infos in node.all_processes.values() for info in infos]
    parents = ",".join(map(str, started))
    workers = subprocess.run(["ps", "-o", "pid=", "--ppid", parents], capture_output=True, text=True).stdout.split()
    for pid in [*started, *map(int, workers)]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def test_a_node_that_dies_loses_only_its_running_cell_which_goes_on_elsewhere(cluster, tmp_path):
    with sweeping(cluster, tmp_path) as process:
        kill(cluster.workers[0])
        output, _ = process.communicate(timeout=400)
    assert process.returncode == 0, output
    assert output.count("lost: its node was lost (") == 1, output
    assert "4 of 4 trainings finished" in output
    resumed = [log.read_text().count("--resume") for log in tmp_path.glob("out/logs/*.log")]
    assert sorted(resumed) == [0, 0, 0, 1]


def test_ctrl_c_saves_the_running_cells_and_the_next_start_goes_on(cluster, tmp_path):
    with sweeping(cluster, tmp_path) as process:
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=200)
    assert process.returncode == 130, output
    assert "stopped; the same command continues" in output
    logs = "".join(log.read_text() for log in tmp_path.glob("out/logs/*.log"))
    assert logs.count("; continue with warpgs train --resume") == 2
    with sweeping(cluster, tmp_path) as process:
        output, _ = process.communicate(timeout=400)
    assert process.returncode == 0, output
    assert "4 of 4 trainings finished" in output


def test_a_cluster_that_is_gone_leaves_one_line_and_the_tables(cluster, tmp_path):
    # Trainings go on without the head until the sweep notices that it is gone; these are too long to finish by then.
    with sweeping(cluster, tmp_path, "--iterations", "1000000") as process:
        kill(cluster.head_node)
        output, _ = process.communicate(timeout=200)
    assert process.returncode == 2, output
    assert "warpgs sweep: the Ray cluster at" in output
    assert "0 of 4 trainings finished" in output
    assert (tmp_path / "out/report.html").exists()


def test_a_node_that_cannot_keep_a_built_in_capture_costs_no_cell(request, tmp_path, monkeypatch):
    import warp

    import warpgs.runtime.launch  # noqa: F401  # initializes Warp
    from warpgs.synthetic.folder import builtin_folder

    monkeypatch.setenv("WARP_CACHE_PATH", str(Path(warp.config.kernel_cache_dir).parent))  # else they compile kernels
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "head"))
    capture = builtin_folder("builtin:room", quiet=True).relative_to(tmp_path / "head")
    blocked = tmp_path / "full" / capture.parent
    blocked.parent.mkdir(parents=True)
    blocked.touch()  # a file in the place of a folder
    (tmp_path / "tiny.toml").write_text(TOML)
    command = [sys.executable, "-m", "warpgs", "sweep", "tiny.toml", "--data", "builtin:room", "--iterations", "40"]
    with cluster_of(request, *({"XDG_CACHE_HOME": str(tmp_path / name)} for name in ("full", "good"))) as cluster:
        command += ["--out", "out", "--address", cluster.address, "--cpus", "1"]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 of 4 trainings finished" in done.stdout
    [line] = [line for line in done.stdout.splitlines() if " gets " in line]
    assert re.match(
        r"node [0-9a-f]{8} gets no more cells: .* failed on it in a row \(.*builtin cannot be kept in ", line
    )
    assert (tmp_path / "good" / capture).is_dir()  # each node makes its own
