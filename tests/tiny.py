"""Runs that take less than a second: a small built-in capture and small networks, through all stages."""

import dataclasses
import json
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jaxtyping
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from tests import plain
from warpgs.command_line.interrupt import Interrupt
from warpgs.config import TrainConfig
from warpgs.data.loaders import LoadOptions, load_with
from warpgs.initialization.prepare_start import prepare_start
from warpgs.runs import checkpoint
from warpgs.runs.logger import TrainingLogger
from warpgs.runs.run import Run
from warpgs.synthetic.room import BuiltinScene, builtin_capture
from warpgs.training.optimizer import GROUPS
from warpgs.training.schedule import Action, IterationPlan
from warpgs.training.trainer import Trainer

checkpoint.NUM_KEPT = 100  # tests look at earlier ones, too

SCENE = BuiltinScene(width=32, height=24, num_frames=6, num_samples=1, num_points=200)

MODEL = plain.model(
    position_bands=2, time_bands=2, depth=2, width=8, skip=1, max_static_points=50, dynamic_points=20, dropout=0.1
)

# Pretraining takes iterations 0 to 5, stage I 6 to 21 (densified after 9, 13 and 17, opacities reset after 14, pruned
# after 11, 17 and 21, the weakest after 21, deformed from 9 on), stage II 22 to 31.
SCHEDULE = plain.schedule(
    pretrain=6,
    stage1=16,
    stage2=10,
    densify_from=3,
    densify_until=14,
    reset_every=9,
    prune_every=6,
    fit_motion=4,
    deform_from=3,
    noise_until=10,
    sh_degree_every=5,
)
LENGTH = 32

CONFIG = plain.config(
    preset="quick",
    device="cpu",
    model=MODEL,
    loss=plain.loss(ssim=0.0, acceleration=0.01),
    densify=plain.densify(every=4, gradient=1e-5, max_gaussians=120, weakest=0.01),
    schedule=SCHEDULE,
    checkpoint_every=7,
)


@contextmanager
def in_haste():
    """Disables run-time type checks and threads: both cost more time than they save in runs this small."""
    threads, disabled = torch.get_num_threads(), jaxtyping.config.jaxtyping_disable
    torch.set_num_threads(1)
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", disabled)
    torch.set_num_threads(threads)


def write(folder: Path) -> Path:
    """Writes the capture; returns its folder."""
    return builtin_capture(folder, SCENE, quiet=True)


def trainer(data: Path, run: Path, config: TrainConfig = CONFIG) -> Trainer:
    return Trainer(prepare_start(config, load_with(data, None, LoadOptions(depth=config.depth))), run)


def train(trainer: Trainer, interrupt: Interrupt | None = None) -> bool:
    with TrainingLogger(trainer.run / "events", trainer.protocol.num_iterations, trainer.iteration) as logger:
        return trainer.train(logger, interrupt)


def plan_to(trainer: Trainer, action: Action) -> IterationPlan:
    """The plan of the first iteration, after which only this is done."""
    return dataclasses.replace(trainer.protocol.at(0), actions=(action,))


def finished(folder: Path, config: TrainConfig = CONFIG) -> Path:
    """Trains a run through all stages; its capture is in the same folder."""
    data = write(folder / "capture")
    config = dataclasses.replace(config, data=data, out=folder / "run")
    Run.create(folder / "run", plain.plan(config))
    with in_haste():
        train(trainer(data, folder / "run", config))
    return folder / "run"


def equal_rates(rate: float) -> dict[str, Tensor]:
    """One learning rate for every parameter group."""
    return {name: torch.tensor(rate) for name in GROUPS}


class StopWhen(Interrupt):
    """Requests a stop as soon as a condition holds."""

    def __init__(self, condition: Callable[[], bool]) -> None:
        self._condition = condition

    @property
    def requested(self) -> bool:
        return self._condition()


def state(run: Path) -> dict[str, Tensor]:
    """All tensors of a run's newest checkpoint: parameters, optimizer state, statistics."""
    return checkpoint.load(checkpoint.list_checkpoints(run)[-1]).tensors


def edit_metadata(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Changes the plain values of a checkpoint in its file, which then has no hash, as those of version 0.2."""
    with safe_open(path, framework="pt") as file:
        header, tensors = file.metadata(), {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    values = json.loads(header["facts"])
    header.pop("sha256", None)
    change(values)
    save_file(tensors, path, metadata={**header, "facts": json.dumps(values)})


def differences(a: dict[str, Tensor], b: dict[str, Tensor]) -> list[str]:
    """Names of the tensors that only one has, or that are not bit-identical."""
    return sorted(n for n in a.keys() | b.keys() if n not in a or n not in b or bytes_of(a[n]) != bytes_of(b[n]))


def bytes_of(tensor: Tensor) -> tuple[tuple[int, ...], str, bytes]:
    return tuple(tensor.shape), str(tensor.dtype), tensor.contiguous().numpy().tobytes()
