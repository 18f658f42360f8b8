"""Runs cells on Ray: this machine, all of its GPUs, or a cluster."""

import logging
import os
import socket
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Set
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

from warpgs.command_line.version import install_command
from warpgs.errors import one_line
from warpgs.posix import block_termination

from .scheduler import ClusterGoneError, Result
from .worker import GRACE_SECONDS, Job, run_job

PROBE_SECONDS = 5.0
"""Time for the head of a cluster to accept a connection, and between two such probes [s]."""

MAX_SILENCE = 20.0
"""Time without an accepted connection after which a cluster is gone [s]; Ray ends the program after 60 s."""

NODE_LABEL = "ray.io/node-id"
"""Label that Ray gives every node: its id."""

OBJECT_STORE_BYTES = 100 << 20
"""Shared memory of a Ray that is started here [bytes]; nothing is exchanged through it. Ray would take 30 % of the
memory, which containers seldom have in /dev/shm."""


def _import_ray(address: str | None) -> Any:
    """Ray, which reads these variables when it is imported."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    # Ray prints what happens to its workers, also to those of no training, and even without log_to_driver; the sweep
    # reports trainings itself. Lines that match are never printed.
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")
    # Ray's own handler of SIGTERM prints a stack trace and ends the program, whatever handler Python has.
    os.environ.setdefault("RAY_DISABLE_FAILURE_SIGNAL_HANDLER", "1")
    if address is None and "ray" not in sys.modules:
        # Anyone who can connect to Ray can run code, so a local instance listens on 127.0.0.1 only. That is Ray's
        # default on macOS and Windows; this variable, meant for these two, selects it on Linux as well.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        import ray
    except ImportError as error:
        raise ImportError(f"a sweep needs Ray: {install_command('sweep')}") from error
    return ray


class RayPool:
    """A pool of Ray tasks, one for each cell.

    Args:
        address: HOST:PORT of the head of a cluster; None starts Ray on this machine.
        device: Device of the trainings; CUDA if None and the cluster has GPUs.
        per_gpu: Number of trainings that share a GPU.
        cpus: Cores of each training; if None, its share of those of a node on a GPU, and 2 without.

    Raises:
        ImportError: If Ray is not installed.
        ConnectionError: If there is no cluster at the address.
        ValueError: If no node has what a training needs.
        KeyboardInterrupt: After Ctrl-C or SIGTERM; a Ray that was started here has ended.
    """

    def __init__(self, address: str | None, device: str | None, per_gpu: int, cpus: int | None) -> None:
        self._ray: Any = None
        self._jobs: dict[Any, Job] = {}  # by Ray's reference
        self._references: dict[str, Any] = {}  # by name of the job
        self._moved: dict[str, Set[str]] = {}  # nodes to avoid of cancelled jobs, which are queued again
        # Signals interrupt the main thread only, so Ray starts in another one: completely, or not at all. What it
        # starts on this machine inherits that SIGTERM is blocked, which timeout, Slurm and systemd send to all
        # processes: Ray and the cells run until the sweep stops them. Ray's processes end with that thread.
        self._thread = ThreadPoolExecutor(1, initializer=block_termination)
        try:
            self._thread.submit(self._connect, address).result()
            self._plan(device, per_gpu, cpus)
        except BaseException:
            self.close()
            raise
        self._heard = self._probed = time.monotonic()

    def _plan(self, device: str | None, per_gpu: int, cpus: int | None) -> None:
        """Decides what each training gets of a node."""
        total = self._ray.cluster_resources()
        self.device = device or ("cuda" if total.get("GPU", 0) else "cpu")
        gpus = 1.0 / per_gpu if self.device == "cuda" else 0.0
        cores = cpus or (self._share_of_cores(per_gpu) if gpus else min(2, round(total.get("CPU", 1))))
        self._check_room(gpus, cores)
        self._needs = gpus, cores
        self._look_around()
        # Attempts are counted by the sweep, and a worker's memory must not outlive its training.
        remote = self._ray.remote(num_cpus=cores, num_gpus=gpus, max_retries=0, max_calls=1)
        self._run, self._run_job = remote(_attempt), run_job

    def _connect(self, address: str | None) -> None:
        ray = _import_ray(address)
        if address is not None:
            _require_head(address)  # Ray would print and try for minutes, and then end the program
        logging.getLogger("ray").setLevel(logging.ERROR)
        options = {} if address else _local_options()
        self._ray = ray  # from here on, there is something to close
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # Ray's announcements of its future versions
                ray.init(
                    address or "local",
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    configure_logging=False,
                    **options,
                )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ConnectionError(f"Ray cannot be reached at {address or 'this machine'}: {one_line(error)}") from error
        self._head = ray.get_runtime_context().gcs_address

    def _nodes(self) -> list[dict[str, float]]:
        return [node["Resources"] for node in self._alive()]

    def _alive(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]

    def _look_around(self) -> None:
        """Takes note of the nodes for trainings."""
        self._ids = frozenset(node["NodeID"] for node in self._alive() if _has_room(node["Resources"], *self._needs))

    def _share_of_cores(self, per_gpu: int) -> int:
        """Cores per training on the node with the fewest; Ray limits the threads of torch to them."""
        shares = (node.get("CPU", 0) / (node["GPU"] * per_gpu) for node in self._nodes() if node.get("GPU", 0))
        return max(1, int(min(shares, default=1)))

    def _check_room(self, gpus: float, cores: int) -> None:
        nodes = self._nodes()
        if not any(_has_room(node, gpus, cores) for node in nodes):
            raise ValueError(
                f"no node of the cluster has {cores} cores{f' and {gpus:g} GPUs' if gpus else ''} for a training: "
                f"{', '.join(_described(node) for node in nodes) or 'there are no nodes'}"
            )

    def submit(self, job: Job, avoid: Set[str] = frozenset()) -> None:
        """Queues a job, for any node but those to avoid."""
        labels = {"label_selector": {NODE_LABEL: f"!in({','.join(sorted(avoid))})"}} if avoid else {}
        reference = self._run.options(name=job.name, **labels).remote(self._run_job, job)
        self._jobs[reference], self._references[job.name] = job, reference

    def move(self, job: Job, avoid: Set[str]) -> None:
        """Changes the nodes that a queued job avoids; one that runs goes on where it is.

        Ray cannot tell which jobs run. One that has begun a moment ago may be cancelled, too: it continues elsewhere.
        """
        if job.name in self._moved or not os.path.exists(job.running):
            self._moved[job.name] = avoid
            self._ray.cancel(self._references[job.name])

    def nodes(self) -> Set[str]:
        """Ids of the nodes that are alive and have room for a job."""
        return self._ids

    def wait(self, seconds: float) -> list[Result]:
        """The jobs that have ended since the last call; waits up to some seconds for the first.

        Raises:
            ClusterGoneError: If the head of the cluster has not answered for ``MAX_SILENCE``.
        """
        done, _ = self._ray.wait(list(self._jobs), timeout=seconds)
        self._check_head()
        return [result for reference in done if (result := self._result(reference))]

    def _result(self, reference: Any) -> Result | None:
        """How an attempt has ended; None if the job was moved, and is queued again."""
        job, errors = self._jobs.pop(reference), self._ray.exceptions
        moved = self._moved.pop(job.name, None)
        try:
            error, node = self._ray.get(reference)
            return Result(job.name, error, node=node)
        except errors.RayError as error:
            if moved is not None:
                self.submit(job, moved)
                return None
            if isinstance(error, errors.NodeDiedError | errors.WorkerCrashedError | errors.ObjectLostError):
                return Result(job.name, f"its node was lost ({type(error).__name__})", is_lost=True)
            lines = [line for line in str(error).splitlines() if line.strip()]
            return Result(job.name, one_line(ValueError(lines[-1] if lines else type(error).__name__))[:300])

    def _check_head(self) -> None:
        now = time.monotonic()
        if now - self._probed < PROBE_SECONDS:
            return
        self._probed = now
        with suppress(ConnectionError):
            _probe(self._head)
            self._heard = now
            self._look_around()
        if now - self._heard > MAX_SILENCE:
            raise ClusterGoneError(f"the Ray cluster at {self._head} is gone")

    def stop(self) -> None:
        """Drops what is queued, and interrupts what runs and waits until it has saved a checkpoint."""
        for reference in self._jobs:
            self._ray.cancel(reference)
        self._ray.wait(list(self._jobs), num_returns=len(self._jobs), timeout=GRACE_SECONDS + 10.0)

    def close(self) -> None:
        """Disconnects; a Ray that was started here ends, also one that is still starting."""
        with self._thread:
            self._thread.submit(self._disconnect).result()

    def _disconnect(self) -> None:
        if self._ray is not None:
            self._ray.shutdown()


def _attempt(run: Callable[[Job], str | None], job: Job) -> tuple[str | None, str]:
    """Runs a job on a node; returns its error and the id of the node."""
    import ray

    return run(job), ray.get_runtime_context().get_node_id()


def _has_room(node: Mapping[str, float], gpus: float, cores: int) -> bool:
    return node.get("GPU", 0) >= gpus and node.get("CPU", 0) >= cores


def _local_options() -> dict[str, Any]:
    """How a Ray of this machine alone is started: with the GPUs that torch sees, which Ray may count otherwise."""
    import torch

    return {
        "include_dashboard": False,
        "num_gpus": torch.cuda.device_count(),
        "object_store_memory": OBJECT_STORE_BYTES,
    }


def _probe(address: str) -> None:
    """Raises ConnectionError unless something listens at HOST:PORT."""
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), PROBE_SECONDS).close()
    except (OSError, ValueError, OverflowError) as error:
        raise ConnectionError(
            f"there is no Ray cluster at {address} (expected HOST:PORT of its head): {one_line(error)}"
        ) from error


def _require_head(address: str) -> None:
    """Raises ConnectionError unless the head of a Ray cluster answers at HOST:PORT."""
    _probe(address)
    try:
        import grpc  # comes with TensorBoard
        from ray._private.gcs_utils import create_gcs_channel  # with the TLS and the token of the cluster
    except ImportError:  # private to Ray, so it may move; then Ray finds out, which takes it minutes
        return
    try:
        create_gcs_channel(address).unary_unary("/ray.rpc.NodeInfoGcsService/CheckAlive")(b"", timeout=PROBE_SECONDS)
    except grpc.RpcError as error:
        reason = one_line(ValueError(error.details() or error.code().name))[:200]
        raise ConnectionError(f"what answers at {address} is not the head of a Ray cluster: {reason}") from error


def _described(node: dict[str, float]) -> str:
    return f"{node.get('CPU', 0):g} cores and {node.get('GPU', 0):g} GPUs"
