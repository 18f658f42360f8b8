"""Checkpoints: safetensors files, written so that a crash at any moment leaves a whole one behind."""

import json
import os
import reprlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from warpgs.config import LARGEST, ModelConfig
from warpgs.files import beside
from warpgs.model.scene import SplitScene

VERSION = 2
FOLDER = "checkpoints"


@dataclass(frozen=True)
class Checkpoint:
    """What is read back.

    Attributes:
        path: Where it was read from.
        tensors: By name, on the CPU; those of the scene begin with "scene.".
        facts: Iteration and other plain values.
    """

    path: Path
    tensors: dict[str, Tensor]
    facts: dict[str, Any]

    def tensor(self, name: str, shape: Sequence[int]) -> Tensor:
        """A tensor of numbers in single precision.

        Raises:
            ValueError: If it is missing or of another shape or type.
        """
        tensor = self.tensors[name]
        if tensor.shape != torch.Size(shape) or tensor.dtype != torch.float32:
            raise ValueError(
                f"{self.path} is damaged: expected {name} as {list(shape)} numbers in single precision, "
                f"got {list(tensor.shape)} {tensor.dtype}"
            )
        return tensor

    def number(self, name: str) -> int | float:
        """A fact that is a number, 0 or more.

        Raises:
            ValueError: If it is missing or something else.
        """
        value = self.facts[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value <= LARGEST:
            raise ValueError(f"{self.path} is damaged: {name} can't be {reprlib.repr(value)}")
        return value

    def flag(self, name: str) -> bool:
        """A fact that is true or false.

        Raises:
            ValueError: If it is missing or something else.
        """
        value = self.facts[name]
        if not isinstance(value, bool):
            raise ValueError(f"{self.path} is damaged: {name} can't be {value!r}")
        return value

    def check_stage(self, sh_degree: int) -> None:
        """Checks the facts that say how the scene is shown.

        Args:
            sh_degree: Highest degree that the scene has.

        Raises:
            ValueError: If one is missing or something else.
        """
        self.flag("moving")
        self.flag("relit")
        self.number("iteration")
        if self.number("sh_degree") not in range(sh_degree + 1):
            raise ValueError(f"{self.path} is damaged: sh_degree can't be {self.facts['sh_degree']!r}")


def save(path: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    """Writes a checkpoint beside its place and moves it there, so that no half-written file ever has its name.

    Raises:
        OSError: If it can't be written; the message names the file.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    metadata = {"format": "warpgs", "version": str(VERSION), "facts": json.dumps(facts)}
    with beside(path) as partial:
        partial.touch()
        mode = partial.stat().st_mode
        try:
            save_file(plain, partial, metadata=metadata)
        except SafetensorError as error:
            raise OSError(str(error)) from error
        partial.chmod(mode)  # safetensors lets nobody but the owner read it, unlike all else in a run
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())


def load(path: Path) -> Checkpoint:
    """Reads a checkpoint; never executes anything of it.

    Raises:
        ValueError: If it is missing, damaged or not one of ours; the message names the file.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != "warpgs":
                raise ValueError(f"{path} is not a checkpoint of warpgs")
            if metadata.get("version") != str(VERSION):
                raise ValueError(f"{path} has version {metadata.get('version')}, this program reads {VERSION}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return Checkpoint(path, _Parts(path, tensors), _Parts(path, _facts(path, metadata["facts"])))
    except FileNotFoundError as error:
        raise ValueError(f"{path} does not exist") from error
    except (SafetensorError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def _facts(path: Path, text: str) -> dict[str, Any]:
    try:
        return json.loads(text)
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error


class _Parts(dict[str, Any]):
    """Parts of a file by name; one that it lacks is an error that names the file."""

    def __init__(self, path: Path, parts: dict[str, Any]) -> None:
        super().__init__(**parts)
        self._path = path

    def __missing__(self, name: str) -> Any:
        raise ValueError(f"{self._path} is damaged: it has no {name}")


def path_of(run: Path, iteration: int) -> Path:
    """Where a run keeps the checkpoint of an iteration."""
    return run / FOLDER / f"{iteration:07d}.safetensors"


def saved(run: Path) -> list[Path]:
    """The checkpoints of a run folder, oldest first."""
    return sorted((run / FOLDER).glob("*.safetensors"))


def keep_newest(run: Path, count: int) -> None:
    """Deletes all but the ``count`` newest checkpoints, and what a killed program left half-written."""
    for path in [*saved(run)[: -max(1, count)], *(run / FOLDER).glob("*.partial")]:
        path.unlink()


def load_scene(checkpoint: Checkpoint, config: ModelConfig, origin: Path) -> SplitScene:
    """The scene of a checkpoint.

    Raises:
        ValueError: If tensors are missing or of other shapes than the config says; the message names ``origin``.
    """
    state = {
        name.removeprefix("scene."): tensor for name, tensor in checkpoint.tensors.items() if name.startswith("scene.")
    }
    try:
        # Rows of three: the size of the file bounds their number, whatever shape it claims.
        static, dynamic = state["static.means"].view(-1, 3), state["dynamic.means"].view(-1, 3)
        sizes = len(static), len(dynamic), config
        with torch.device("meta"):  # where a config that claims too much takes no memory
            SplitScene.empty(*sizes).load_state_dict(state, assign=True)
        scene = SplitScene.empty(*sizes)
        scene.load_state_dict(state)
    except (KeyError, RuntimeError) as error:
        reason = str(error).splitlines()[:2][-1].strip()  # torch has the first detail on the second line
        raise ValueError(f"{origin} does not hold a scene of this run's config: {reason}") from error
    if not all(bool(torch.isfinite(tensor).all()) for tensor in state.values()):
        raise ValueError(f"{origin} holds values that are not finite")
    return scene
