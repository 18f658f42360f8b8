"""Run folders: opened and created; docs/run-folder.md lists their files."""

import dataclasses
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from warpgs.config import Device, Plan, TrainConfig
from warpgs.config.builtin import is_builtin
from warpgs.data.capture import Capture
from warpgs.errors import command, similar_path
from warpgs.files import partial_path
from warpgs.locks import LOCK, lock_folder
from warpgs.model.trunk import in_single_precision
from warpgs.ops.mlp import limit_of_multiprocessors
from warpgs.runtime.devices import choose_device

from . import checkpoint
from .config_file import NAME, read_config, write_config
from .trained import TrainedScene

MASK_TRIAL = "mask_trial.json"
"""File in a run folder: what the trial of the masks found, for metrics.json. It exists only after a trial."""

TRAINED = "trained"
"""What a process does with the run folder that it locks, for messages."""


def new_folder(config: TrainConfig, capture: Capture) -> Path:
    """The folder of a new run; nothing is created yet.

    Raises:
        ValueError: If ``config.out`` exists already and is not an empty folder.
    """
    folder = config.out
    if folder is None:
        stem = Path("runs") / "-".join(filter(None, (capture.name, config.preset)))
        folder = next(p for k in range(1, 10_000) if not (p := stem if k == 1 else Path(f"{stem}-{k}")).exists())
    elif folder.exists() and (not folder.is_dir() or not _is_empty(folder)):
        advice = f"continue it with {command('train', '--resume', folder)}, or " if (folder / NAME).exists() else ""
        raise ValueError(f"{folder} exists and is not empty: {advice}choose another --out")
    return folder


def _is_empty(folder: Path) -> bool:
    """Whether a folder holds nothing but what a kill before or in the first write leaves."""
    return {path.name for path in folder.iterdir()} <= {partial_path(folder / NAME).name, LOCK}


@contextmanager
def locked_new_folder(config: TrainConfig, capture: Capture) -> Iterator[Path]:
    """Makes and locks the folder of a new run; in the end it is removed again if nothing was written into it.

    Raises:
        ValueError: As ``new_folder`` does, or if another process trains in the folder.
        OSError: If it cannot be written.
    """
    folder = new_folder(config, capture)
    with lock_folder(folder, TRAINED):
        new_folder(dataclasses.replace(config, out=folder), capture)  # another process may have been faster
        yield folder


@dataclass(frozen=True)
class Run:
    """A run folder with its plan, opened for reading.

    Attributes:
        folder: The run folder.
        config: Its plan; ``device`` is the one that the scene is opened on.
    """

    folder: Path
    config: Plan

    def __repr__(self) -> str:
        data, preset = self.config.data or "the built-in scene", self.config.preset or "no preset"
        return f"<Run {self.folder}: {preset} on {data}, {self.config.schedule.num_iterations:,} iterations>"

    @staticmethod
    def open(folder: Path, device: Device | None = None, data: Path | None = None) -> "Run":
        """Opens a run folder.

        Args:
            folder: With config.json.
            device: Device for the scene; CUDA if None and there is a GPU.
            data: Current folder of the capture, if it was moved.

        Raises:
            ValueError: If the folder is not a run folder, its config is damaged, or there is no such device.
        """
        config = read_config(folder)
        return Run(folder, dataclasses.replace(config, device=choose_device(device), data=data or config.data))

    @staticmethod
    def create(folder: Path, config: Plan) -> "Run":
        """Creates a run folder and writes its config.json.

        Raises:
            OSError: If it cannot be written.
        """
        folder.mkdir(parents=True, exist_ok=True)
        write_config(folder, config)
        return Run(folder, config)

    @property
    def path(self) -> Path:
        """What commands open it by."""
        return self.folder

    @property
    def has_capture(self) -> bool:
        """Whether a capture is known."""
        return True

    @property
    def device(self) -> torch.device:
        return torch.device(self.config.device)

    def open_capture(self, quiet: bool = False) -> Capture:
        """The capture that the run was trained on; raises as ``open_capture``."""
        data = self.config.data
        if data is not None and not is_builtin(data) and not data.exists():
            raise ValueError(
                f"the capture of {self.folder}, {data}, does not exist; if it was moved, give it by --data"
                f"{similar_path(data)}"
            )
        from warpgs.captures.opening import open_capture  # imports all loaders and the ray tracer

        return open_capture(self.config, quiet)

    def open_corrected_capture(self, quiet: bool = False) -> Capture:
        """The capture, with the cameras of the frames that the run was trained on where training moved them.

        Raises:
            ValueError: As ``open_capture``, or if the newest checkpoint is damaged.
            OSError: As ``open_capture``.
        """
        capture, path = self.open_capture(quiet), self.newest_checkpoint()
        if not self.config.optim.poses or path is None:
            return capture
        loaded = checkpoint.load(path)
        cameras = {name: capture.cameras[name] for name in loaded.metadata.views if name in capture.cameras}
        if not cameras:
            return capture
        poses = checkpoint.load_poses(loaded, checkpoint.unit_of(loaded, list(cameras.values())))
        indices = {name: torch.tensor([k]) for k, name in enumerate(loaded.metadata.views)}
        with torch.no_grad():
            return capture.with_cameras({name: poses.moved(camera, indices[name]) for name, camera in cameras.items()})

    def newest_checkpoint(self) -> Path | None:
        """The checkpoint of the last saved iteration; None if there is none yet."""
        saved = checkpoint.list_checkpoints(self.folder)
        return saved[-1] if saved else None

    def trained_scene(self, path: Path | None = None) -> TrainedScene:
        """The scene of a checkpoint, on the run's device.

        Args:
            path: The checkpoint; the newest one if None.

        Raises:
            ValueError: If there is no checkpoint, or it is damaged or does not fit the config.
        """
        saved = checkpoint.list_checkpoints(self.folder) if path is None else [path]
        resume = command("train", "--resume", self.folder)
        if not saved:
            raise ValueError(f"{self.folder} has no checkpoint yet: {resume} trains on")
        try:
            loaded = checkpoint.load(saved[-1])
            scene = checkpoint.load_scene(loaded, self.config.model, self.config.background == "sky")
        except checkpoint.DamagedCheckpointError as error:
            if len(saved) == 1:
                raise
            advice = f"move it elsewhere to use {saved[-2].name}, or {resume} continues from the newest intact one"
            raise ValueError(f"{error}; {advice}") from error
        if limit_of_multiprocessors():  # which may break half precision; PSNR is the same to 0.001 dB
            in_single_precision(scene)
        return TrainedScene(scene.to(self.device).requires_grad_(False), self.config, loaded.metadata)

    def require_present(self, *_: object) -> None:
        """Refuses to go on if the folder was moved or deleted: files would be written into a new one of its name.

        Takes any arguments, as a callback of training does.

        Raises:
            OSError: If it has no config.json.
        """
        if not (self.folder / NAME).is_file():
            raise OSError(
                f"{self.folder} was moved or deleted meanwhile: it has no {NAME}; if it was moved, warpgs train "
                "--resume with its new place continues from its last checkpoint"
            )

    def lock(self) -> AbstractContextManager[None]:
        """Locks the folder against other training processes; raises as ``lock_folder``."""
        return lock_folder(self.folder, TRAINED)
