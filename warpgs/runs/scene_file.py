"""Scenes of other programs: a file of Gaussians, or several over time, opened like a run."""

import dataclasses
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import Plan
from warpgs.data.capture import Capture
from warpgs.formats.cloud import Cloud
from warpgs.formats.readers import read_cloud
from warpgs.model.gaussians import Gaussians
from warpgs.model.scene import SplitScene
from warpgs.model.splats import Splats
from warpgs.ops.sh import degree_of

from .checkpoint import Metadata
from .run import Run
from .trained import TrainedScene

MAX_CACHE_BYTES = 1 << 30
"""Memory of the Gaussians of a sequence that are kept; those of two times are in any case."""


@dataclass(frozen=True)
class SceneFile(Run):
    """Files of Gaussians, one or several over time.

    Attributes:
        folder: Where edits, paths and what is rendered and exported are kept: named like the file, or that of several.
        config: A plan that was not trained by; its ``data`` is the folder of a capture in the scene's coordinates.
        files: The files, in the order of time, at times that are evenly spaced.
    """

    files: tuple[Path, ...]

    def __repr__(self) -> str:
        last = f" to {self.files[-1].name}" if len(self.files) > 1 else ""
        return f"<SceneFile {self.files[0]}{last}>"

    @property
    def path(self) -> Path:
        return self.folder if len(self.files) > 1 else self.files[0]

    @property
    def has_capture(self) -> bool:
        return self.config.data is not None

    def open_capture(self, quiet: bool = False) -> Capture:
        """The capture that was given; raises ValueError if none was, or as ``Run.open_capture``."""
        if not self.has_capture:
            raise ValueError(f"{self.files[0]} has no capture")
        return super().open_capture(quiet)

    def newest_checkpoint(self) -> None:
        """Files have no checkpoints."""

    def trained_scene(self, path: Path | None = None) -> TrainedScene:
        """The scene, on the run's device.

        Raises:
            ValueError: If a file is damaged; the message names it.
            OSError: If it needs a package that is not installed.
        """
        if len(self.files) > 1:
            return SceneSequence(self.files, self.config)
        cloud = read_cloud(self.files[0])
        config = _plan_of(cloud, self.config)
        return TrainedScene(_scene_of(cloud, config).to(self.device), config, _metadata_of(cloud))


class SceneSequence(TrainedScene):
    """Files of Gaussians over time, at evenly spaced times in [0, 1]; at any other time the nearest file is shown.

    All of them are dynamic. ``scene`` is that of the first file.

    Args:
        files: The files, in the order of time.
        config: The plan; its device is that of the scene.
    """

    varies = True

    def __init__(self, files: tuple[Path, ...], config: Plan) -> None:
        first = read_cloud(files[0])
        config = dataclasses.replace(_plan_of(first, config), graph=False)
        super().__init__(_scene_of(first, config, True).to(config.device), config, _metadata_of(first))
        self.files = files
        size = sum(tensor.nbytes for tensor in self.scene.dynamic.state_dict().values())
        stored = [file.stat().st_size for file in files]
        largest = max(size * max(stored) // stored[0], max(stored))  # of small files most is the header
        self._frame = lru_cache(maxsize=max(2, MAX_CACHE_BYTES // largest))(self._read)

    def has_same_gaussians(self) -> bool:
        """Whether all files have one number of Gaussians, as those of one moving scene do; reads them all."""
        return len({len(read_cloud(file)) for file in self.files}) == 1

    def _splats(self, time: Float[Tensor, "1"], residual: bool = True, camera: Camera | None = None) -> Splats:
        index = round(float(time.clamp(0, 1)) * (len(self.files) - 1))
        return dataclasses.replace(self._frame(index).splats(time, False, False), background=self.background)

    def _read(self, index: int) -> SplitScene:
        cloud = read_cloud(self.files[index])
        return _scene_of(cloud, _plan_of(cloud, self.config), True).to(self.device)


def _plan_of(cloud: Cloud, plan: Plan) -> Plan:
    """The plan with the degree of a cloud, its anti-aliasing and the smallest networks, which are not used."""
    degree = degree_of(cloud.sh.shape[1])
    model = dataclasses.replace(plan.model, sh_degree=degree, depth=1, width=8, appearance_size=None)
    return dataclasses.replace(plan, model=model, antialias=cloud.antialias)


def _metadata_of(cloud: Cloud) -> Metadata:
    return Metadata(0, use_deformation=False, use_appearance=False, sh_degree=degree_of(cloud.sh.shape[1]))


def _scene_of(cloud: Cloud, plan: Plan, is_dynamic: bool = False) -> SplitScene:
    """A scene whose static, or dynamic, Gaussians are those of a cloud."""
    parts = (cloud.means, cloud.quats, cloud.log_scales, cloud.logit_opacities, cloud.sh[:, :1], cloud.sh[:, 1:])
    gaussians = Gaussians(*(torch.from_numpy(np.ascontiguousarray(part)) for part in parts))
    none = Gaussians.empty(0, plan.model.sh_degree)
    branches = (none, gaussians) if is_dynamic else (gaussians, none)
    center, half_size = torch.zeros(3, dtype=torch.float32), torch.ones(3, dtype=torch.float32)
    return SplitScene(*branches, plan.model, center, half_size).requires_grad_(False)
