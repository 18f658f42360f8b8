"""Processes that train together as those of torchrun do, forked from one that has imported everything."""

import dataclasses
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch._dynamo  # noqa: F401  # optimizers import it, which takes seconds
from torch.distributed import TCPStore

from warpgs.config import TrainConfig
from warpgs.data.capture import Capture
from warpgs.distortion import Distortion
from warpgs.files import write_json
from warpgs.runs import checkpoint
from warpgs.runs.checkpoint import _hash
from warpgs.runtime import ranks
from warpgs.training import command, mask_trial
from warpgs.training import train as script
from warpgs.training.step import Step
from warpgs.training.trainer import Trainer

TIMEOUT = 120.0
"""Time after which processes that have not ended are killed [s]."""


def start(folder: Path, work: Callable[..., Any], *arguments: Any, num: int = 2) -> list[int]:
    """Runs ``work(folder, *arguments)`` on ``num`` ranks; returns their exit codes, negative after a signal.

    As torchrun, it sends SIGTERM to all when one has failed.

    ``folder`` then has what they wrote: rank0.out, rank0.err, rank1.out …
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.two_ranks"])
    folder.mkdir(exist_ok=True)
    store = TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)  # torchrun also holds it
    processes = [
        context.Process(target=_main, args=(rank, num, store.port, folder, work, arguments)) for rank in range(num)
    ]
    for process in processes:
        process.start()
    end = time.monotonic() + TIMEOUT
    while any(process.is_alive() for process in processes) and time.monotonic() < end:
        if any(process.exitcode for process in processes):
            for process in processes:
                process.terminate()
        time.sleep(0.1)
    for process in processes:
        process.kill()
        process.join()
    return [process.exitcode for process in processes]


def errors(folder: Path, rank: int) -> list[str]:
    """The lines that a rank has written to stderr, without those of Warp and torch."""
    lines = (folder / f"rank{rank}.err").read_text().splitlines()
    return [line for line in lines if not line.startswith(("Warp ", "[W", "[Gloo]"))]


def _main(rank: int, num: int, port: int, folder: Path, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    numbers = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": num, "LOCAL_WORLD_SIZE": num, "MASTER_PORT": port}
    os.environ.update({name: str(number) for name, number in numbers.items()})
    os.environ.update(
        MASTER_ADDR="127.0.0.1",
        TORCHELASTIC_RUN_ID="test",
        TORCHELASTIC_USE_AGENT_STORE="True",
        GLOO_SOCKET_IFNAME="lo",
    )
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / f"rank{rank}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
    sys.stdout, sys.stderr = (os.fdopen(number, "w", buffering=1) for number in (1, 2))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    torch.set_num_threads(1)
    sys.exit(work(folder, *arguments))


# What the ranks do ---------------------------------------------------------------------------------------------------


def digest(trainer: Trainer) -> str:
    """Hash of all parameters and of Adam's state."""
    tensors = {name: parameter.detach().cpu() for name, parameter in trainer.step.parameters().items()}
    for name, parameter in trainer.step.parameters().items():
        state = trainer.step.optimizer.state.get(parameter, {})
        tensors |= {f"{part} {name}": value.cpu() for part, value in state.items()}
    return _hash(tensors, "")


def train(folder: Path, config: TrainConfig, stop_at: int | None = None, bad_at: int | None = None) -> int:
    """Trains; each rank writes what it has in the end and in between to rank0.json, rank1.json …

    After its step ``stop_at`` rank 1 gets SIGTERM, after ``bad_at`` its loss is not finite.
    """
    rank, steps, lines, whole = int(os.environ["RANK"]), [], [], Step.__call__

    def step(self, plan, sample):
        whole(self, plan, sample)
        steps.append({"view": sample.view, "static": len(self.scene.static), "dynamic": len(self.scene.dynamic)})
        if len(steps) == stop_at and rank == 1:
            signal.raise_signal(signal.SIGTERM)
        if len(steps) == bad_at and rank == 1:
            self._sums.fill_(torch.nan)

    Step.__call__ = step
    checkpoint.NUM_KEPT = 100  # one of them is continued by a single process
    script.evaluate_run = lambda *_, **__: "evaluated"
    make_trainer, trainers = script.make_trainer, []
    script.make_trainer = lambda *arguments: trainers.append(make_trainer(*arguments)) or trainers[0]
    try:
        return command.run_command(lambda: script.train(config, log=lines.append))
    finally:
        result = {"digest": digest(trainers[0]), "iteration": trainers[0].iteration, "steps": steps, "lines": lines}
        write_json(folder / f"rank{rank}.json", result)


def train_with_callback(folder: Path, config: TrainConfig) -> int:
    """Trains until a callback asks to stop, at the first check; each rank writes how often it was called."""
    calls = []
    script.evaluate_run = lambda *_, **__: "evaluated"
    script.train(config, callbacks=[lambda progress: calls.append(progress.status.iteration) or True])
    write_json(folder / f"rank{os.environ['RANK']}.json", {"calls": calls})
    return 0


def one_step(folder: Path, config: TrainConfig) -> None:
    """One iteration, of which each rank saves its choices, and rank 0 what is known after it."""
    with ranks.joined():
        trainer = script.make_trainer(config)
        plan = trainer.protocol.at(0)
        sample = trainer._sample(plan)
        trainer.step(plan, sample)
        torch.save(tuple(sample), folder / f"sample{ranks.rank()}.pt")
        trainer.step.density.merge()
        counts = trainer.step.density.count.clone()
        trainer.iteration = 1
        trainer.save()
        assert ranks.is_first() or not counts.any()


def fail_in_step(folder: Path, config: TrainConfig, how: str) -> int:
    """Trains by the command; rank 1 fails in its fifth iteration."""
    whole, count = Step.__call__, 0

    def step(self, plan, sample):
        nonlocal count
        whole(self, plan, sample)
        count += 1
        if count == 5 and os.environ["RANK"] == "1":
            if how == "killed":
                os.kill(os.getpid(), signal.SIGKILL)
            raise ValueError("rank 1 has a reason")

    Step.__call__ = step
    return by_command(folder, config)


def by_command(folder: Path, config: TrainConfig) -> int:
    """Trains by the command."""
    command.parse = lambda *_: config
    return command.main([], "warpgs train")


def with_differences(folder: Path, config: TrainConfig, what: str) -> int:
    """Trains by the command; the ranks have other options, or other captures under the same path."""
    if what == "options":
        config = dataclasses.replace(config, seed=int(os.environ["RANK"]))
    else:
        whole = script.open_capture
        script.open_capture = lambda *_: _changed(whole(*_), what, float(os.environ["RANK"]))
    return by_command(folder, config)


def _changed(capture: Capture, what: str, amount: float) -> Capture:
    """The capture with other points, or another camera: its shutter, or the circle of its fisheye lens."""
    if what == "points":
        return dataclasses.replace(capture, points=capture.points + 1e-3 * amount)
    camera = capture.cameras[capture.train[0]]
    if what == "shutter":
        changed = dataclasses.replace(camera, motion=torch.full((2, 3), 1e-3 * amount))
    else:
        lens = dataclasses.replace(Distortion.fisheye([], camera.K, camera.size), circle=3.0 + 0.1 * amount)
        changed = dataclasses.replace(camera, distortion=lens)
    return capture.with_cameras({capture.train[0]: changed})


def try_masks(folder: Path, config: TrainConfig) -> None:
    """Each rank finds another quality without masks, above and below that with them, and writes what it assumes."""
    without = 31.0 if os.environ["RANK"] == "0" else 29.0
    mask_trial.MIN_RELATIVE_LENGTH = 0.0
    mask_trial.held_out_psnr = lambda _, __, assume, *___: 30.0 if assume == "masks" else without
    with ranks.joined():
        trainer = script.make_trainer(config)
        write_json(folder / f"rank{ranks.rank()}.json", {"assume": trainer.config.assume})
