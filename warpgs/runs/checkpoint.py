"""Checkpoints: safetensors files, written so that a crash at any time leaves a complete one."""

import hashlib
import json
import os
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import ModelConfig
from warpgs.config.bounds import MAX_VALUE
from warpgs.data.capture import extent_of
from warpgs.files import atomic_path, require_file
from warpgs.model.poses import PoseCorrections
from warpgs.model.scene import SplitScene

VERSION = 2
FOLDER = "checkpoints"

NUM_KEPT = 2
"""Number of newest checkpoints of a run that training keeps: where one is damaged, the other continues."""

MAX_BYTES = 16 << 30
"""Maximum size of a checkpoint [bytes]; 20 million Gaussians with Adam's moments."""

HEADER_KEYS = ("format", "version", "facts", "sha256")
"""Keys of the file's metadata; "facts" has the fields of ``Metadata``. Checkpoints of version 0.2 and
earlier have no ``sha256``."""


class DamagedCheckpointError(ValueError):
    """A checkpoint whose content is not what was written.

    Attributes:
        path: The file.
    """

    def __init__(self, path: Path, reason: object) -> None:
        super().__init__(f"{path} is damaged: {reason}")
        self.path = path


@dataclass(frozen=True)
class Metadata:
    """Plain values of a checkpoint, beside its tensors.

    Attributes:
        iteration: Iterations done.
        use_deformation: Whether the deformation network moves the dynamic Gaussians.
        use_appearance: Whether the appearance network changes the static Gaussians.
        sh_degree: Highest degree of spherical harmonics in use.
        train_seconds: Training time so far [s].
        peak_bytes: Peak memory of tensors on the GPU [bytes]; None on CPU.
        rollbacks: Returns to a checkpoint after a loss that was not finite.
        views: Ids of the training frames.
        times: Their times in [0, 1]; none in checkpoints of version 0.2 and earlier.
        unit: Of learning rates of positions and of corrections of poses [scene units]; None in checkpoints of version
            0.3 and earlier. See ``unit_of``.
    """

    iteration: int
    use_deformation: bool
    use_appearance: bool
    sh_degree: int
    train_seconds: float = 0.0
    peak_bytes: int | None = None
    rollbacks: int = 0
    views: tuple[str, ...] = ()
    times: tuple[float, ...] = ()
    unit: float | None = None


FILE_KEYS = {"use_deformation": "moving", "use_appearance": "relit"}
"""Names of fields of ``Metadata`` in the file where they differ: the format is that of version 2."""

LISTS = ("views", "times")
"""Fields of ``Metadata`` that are lists in the file."""


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that was read.

    Attributes:
        path: The file.
        tensors: By name, on the CPU; those of the scene begin with "scene.".
        metadata: Iteration and other plain values.
    """

    path: Path
    tensors: dict[str, Tensor]
    metadata: Metadata

    def tensor(self, name: str, shape: Sequence[int]) -> Tensor:
        """A tensor of single-precision numbers.

        Raises:
            DamagedCheckpointError: If it is missing or has another shape or type.
        """
        if name not in self.tensors:
            raise DamagedCheckpointError(self.path, f"it has no {name}")
        tensor = self.tensors[name]
        if tensor.shape != torch.Size(shape) or tensor.dtype != torch.float32:
            raise DamagedCheckpointError(
                self.path,
                f"expected {name} as {list(shape)} single-precision numbers, got {list(tensor.shape)} {tensor.dtype}",
            )
        return tensor


def save(path: Path, tensors: dict[str, Tensor], metadata: Metadata) -> None:
    """Writes a checkpoint to a temporary file and renames it, so that no half-written file ever has its name.

    Raises:
        OSError: If it cannot be written; the message names the file.
    """
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    values = {FILE_KEYS.get(name, name): value for name, value in asdict(metadata).items()}
    text = json.dumps(values)
    header = {"format": "warpgs", "version": str(VERSION), "facts": text, "sha256": _hash(plain, text)}
    with atomic_path(path) as partial:
        partial.touch()
        mode = partial.stat().st_mode
        try:
            save_file(plain, partial, metadata=header)
        except SafetensorError as error:
            raise OSError(str(error)) from error
        partial.chmod(mode)  # safetensors lets only the owner read it, unlike every other file of a run
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())


def _hash(tensors: Mapping[str, Tensor], text: str) -> str:
    """SHA-256 of the names, types, shapes and bytes of tensors on the CPU, and of the plain values as JSON."""
    digest = hashlib.sha256(text.encode())
    for name, tensor in sorted(tensors.items()):
        digest.update(f"\0{name} {tensor.dtype} {list(tensor.shape)}\0".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def load(path: Path) -> Checkpoint:
    """Reads a checkpoint; never executes anything from it.

    Raises:
        DamagedCheckpointError: If its content is not what was written.
        ValueError: If it is missing, not a regular file or not a checkpoint of this program. All messages name it.
    """
    require_file(path, MAX_BYTES)
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != "warpgs":
                raise ValueError(f"{path} is not a checkpoint of warpgs")
            if header.get("version") != str(VERSION):
                raise ValueError(f"{path} has version {header.get('version')}, this program reads {VERSION}")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    except SafetensorError as error:
        raise DamagedCheckpointError(path, error) from error
    if unknown := sorted(set(header) - set(HEADER_KEYS)):  # as a damaged "sha256" is
        raise DamagedCheckpointError(path, f"its header has {reprlib.repr(unknown[0])}")
    if "sha256" in header and header["sha256"] != _hash(tensors, header.get("facts", "")):
        raise DamagedCheckpointError(path, "its content has another SHA-256 than what was written")
    _check_state(path, tensors)
    if "gradients.total" in tensors:  # of version 0.3 and earlier: as if no view had shown any Gaussian
        tensors.setdefault("gradients.resolution", torch.zeros_like(tensors["gradients.total"]))
    return Checkpoint(path, tensors, _parse_metadata(path, header.get("facts", "")))


def _check_state(path: Path, tensors: Mapping[str, Tensor]) -> None:
    """Refuses a state of the optimizer, of densification or of poses that training cannot have."""
    for name, tensor in tensors.items():
        if not name.startswith(("adam.", "gradients.", "poses.")):
            continue
        if not bool(tensor.isfinite().all()):
            raise DamagedCheckpointError(path, f"{name} holds values that are not finite")
        if not name.startswith(("adam.exp_avg.", "poses.")) and not bool((tensor >= 0).all()):
            raise DamagedCheckpointError(path, f"{name} holds negative values")


def _parse_metadata(path: Path, text: str) -> Metadata:
    try:
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DamagedCheckpointError(path, error) from error
    if not isinstance(values, dict) or not all(isinstance(values.get(key, []), list) for key in LISTS):
        raise DamagedCheckpointError(path, "expected an object of plain values")
    parsed: dict[str, Any] = {}
    values = {"times": [], "unit": None, **values}
    for field in fields(Metadata):
        key = FILE_KEYS.get(field.name, field.name)
        if key not in values:
            raise DamagedCheckpointError(path, f"it has no {key}")
        value = tuple(values[key]) if field.name in LISTS else values[key]
        if not _is_valid(field.name, value):
            raise DamagedCheckpointError(path, f"{key} cannot be {reprlib.repr(value)}")
        parsed[field.name] = value
    return Metadata(**parsed)


def _is_valid(name: str, value: Any) -> bool:
    if name == "views":
        return all(isinstance(view, str) for view in value)
    if name == "times":
        return all(type(time) in (int, float) and 0 <= time <= 1 for time in value)
    if name in ("use_deformation", "use_appearance"):
        return isinstance(value, bool)
    if name in ("peak_bytes", "unit") and value is None:
        return True
    if name == "unit" and value == 0:
        return False
    is_number = isinstance(value, int) or (name in ("train_seconds", "unit") and isinstance(value, float))
    return is_number and not isinstance(value, bool) and 0 <= value <= MAX_VALUE


def path_of(run: Path, iteration: int) -> Path:
    """The file of the checkpoint of an iteration."""
    return run / FOLDER / f"{iteration:07d}.safetensors"


def list_checkpoints(run: Path) -> list[Path]:
    """The checkpoints of a run folder, oldest first."""
    return sorted((run / FOLDER).glob("*.safetensors"))


def keep_newest(run: Path, count: int) -> None:
    """Deletes all but the ``count`` newest checkpoints, and half-written files of a killed program."""
    for path in [*list_checkpoints(run)[: -max(1, count)], *(run / FOLDER).glob("*.partial")]:
        path.unlink()


def set_aside(path: Path) -> Path:
    """Renames a damaged checkpoint, so that it is not listed any more; returns its new path.

    Raises:
        OSError: If it cannot be renamed.
    """
    return path.replace(path.with_name(path.name + ".damaged"))


def restore_newest(run: Path, restore: Callable[[Path], None], log: Callable[[str], None]) -> Path | None:
    """Restores the newest checkpoint of a run folder that is not damaged; returns it, or None if there are none.

    Damaged ones that are newer are renamed, with a warning.

    ``restore`` raises DamagedCheckpointError if the checkpoint is damaged.

    Raises:
        DamagedCheckpointError: If all are damaged.
    """
    damaged: list[DamagedCheckpointError] = []
    for path in reversed(list_checkpoints(run)):
        try:
            restore(path)
        except DamagedCheckpointError as error:
            damaged.append(error)
            continue
        for reason in damaged:
            aside = set_aside(reason.path)
            log(f"warning: {reason}; it is now {aside.name}, and training continues from {path}")
        return path
    if damaged:
        raise damaged[0]
    return None


def unit_of(checkpoint: Checkpoint, cameras: Sequence[Camera]) -> float:
    """Unit of learning rates of positions and of corrections of poses [scene units].

    Checkpoints of version 0.3 and earlier do not have it. It was the extent of the training cameras; with another unit,
    corrections would mean other poses.
    """
    return extent_of(cameras) if checkpoint.metadata.unit is None else checkpoint.metadata.unit


def load_poses(checkpoint: Checkpoint, unit: float) -> PoseCorrections:
    """The corrections of the training cameras, on the CPU.

    Args:
        checkpoint: Of a run that corrected poses.
        unit: Of ``PoseCorrections``; from ``unit_of`` [scene units].

    Raises:
        DamagedCheckpointError: If they are missing, or there is not one for each training view.
    """
    num = len(checkpoint.metadata.views)
    places = checkpoint.tensors.get("poses.places", torch.arange(num))  # until 0.3, one per view
    if places.shape != (num,) or places.dtype != torch.int64 or not bool(((places >= 0) & (places < num)).all()):
        raise DamagedCheckpointError(checkpoint.path, f"expected poses.places as {num} integers below {num}")
    poses = PoseCorrections(places, unit)
    for name, parameter in poses.named_parameters():
        parameter.data.copy_(checkpoint.tensor(f"poses.{name}", parameter.shape))
    return poses


def load_scene(checkpoint: Checkpoint, config: ModelConfig, has_dome: bool = False) -> SplitScene:
    """The scene of a checkpoint, on the CPU; with ``has_dome`` under a sky.

    Raises:
        DamagedCheckpointError: If its values are not finite, or its metadata does not fit the config.
        ValueError: If tensors are missing or do not have the shapes of the config. All messages name the file.
    """
    state = {
        name.removeprefix("scene."): tensor for name, tensor in checkpoint.tensors.items() if name.startswith("scene.")
    }
    path = checkpoint.path
    for part in ("deformation", "deformation.network"):  # offsets of version 0.3 and earlier are in scene units
        if config.deformation in ("mlp", "splines") and f"{part}.trunk.values" in state:
            state.setdefault(f"{part}.units", torch.ones(10, dtype=torch.float32))
    try:
        # Rows of three: the size of the file bounds their number, whatever shape it claims.
        static, dynamic = state["static.means"].view(-1, 3), state["dynamic.means"].view(-1, 3)
        sizes = len(static), len(dynamic), config, has_dome
        with torch.device("meta"):  # a config that claims too much takes no memory there
            SplitScene.empty(*sizes).load_state_dict(state, assign=True)
        scene = SplitScene.empty(*sizes)
        scene.load_state_dict(state)
    except (KeyError, RuntimeError) as error:
        reason = str(error).splitlines()[:2][-1].strip()  # torch has the first detail on the second line
        raise ValueError(f"{path} does not hold a scene of this run's config: {reason}") from error
    if not all(bool(torch.isfinite(tensor).all()) for tensor in state.values()):
        raise DamagedCheckpointError(path, "its scene holds values that are not finite")
    found = scene.dynamic.segments
    if found is not None and not bool(((found >= 0) & (found < scene.num_segments)).all()):
        raise DamagedCheckpointError(path, f"a dynamic Gaussian has a segment outside of 0 to {scene.num_segments - 1}")
    if checkpoint.metadata.sh_degree > config.sh_degree:
        raise DamagedCheckpointError(path, f"sh_degree cannot be {checkpoint.metadata.sh_degree}")
    return scene
