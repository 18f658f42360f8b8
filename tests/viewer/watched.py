"""A small run to show in the viewer."""

import dataclasses
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import torch

from tests import tiny
from warpgs.model.scene import SplitScene
from warpgs.runs import checkpoint


def copy(finished: Path, folder: Path) -> Path:
    """A copy of a finished tiny run, changed so that its images are easy to tell apart."""
    run = shutil.copytree(finished, folder / "run")
    _brighten(run)
    return run


def _brighten(run: Path) -> None:
    """Makes the scene bright and dynamic; after so short a training it is neither."""
    newest = checkpoint.load(checkpoint.list_checkpoints(run)[-1])
    tensors = dict(newest.tensors)
    for branch in ("static", "dynamic"):
        tensors[f"scene.{branch}.logit_opacities"] = tensors[f"scene.{branch}.logit_opacities"] * 0 + 2.0
        tensors[f"scene.{branch}.log_scales"] = tensors[f"scene.{branch}.log_scales"].clamp(-3.0, -1.5)
    tensors["scene.dynamic.sh_dc"] = tensors["scene.dynamic.sh_dc"] + torch.tensor([1.0, -1.0, -1.0])
    for network in ("deformation", "appearance"):
        trunk = getattr(SplitScene.empty(1, 1, tiny.MODEL), network).trunk
        trunk.layers(tensors[f"scene.{network}.trunk.values"])[-1].weight.fill_(0.3)
    checkpoint.save(newest.path, tensors, newest.metadata)


def advance(run: Path, by: int = 1) -> Path:
    """Writes a later checkpoint with another scene, as if training had continued."""
    newest = checkpoint.load(checkpoint.list_checkpoints(run)[-1])
    metadata = dataclasses.replace(newest.metadata, iteration=newest.metadata.iteration + by)
    tensors = {n: t + 0.01 if n.startswith("scene.static.means") else t for n, t in newest.tensors.items()}
    path = checkpoint.path_of(run, metadata.iteration)
    checkpoint.save(path, tensors, metadata)
    return path


def same(a: torch.Tensor, b: torch.Tensor) -> bool:
    return bool(torch.equal(a, b))


def until(condition: Callable[[], object], seconds: float = 60.0) -> None:
    """Waits until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "timeout"
        time.sleep(0.02)


class Scene:
    """The scene of a browser, which only records the names of its objects."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def add_camera_frustum(self, name: str, *_: object, **__: object) -> SimpleNamespace:
        self.names.append(name)
        return SimpleNamespace(on_click=lambda _: None)

    def remove_by_name(self, name: str) -> None:
        self.names = [other for other in self.names if not other.startswith(name)]
