"""Playing a trained scene: one frame after another, both networks evaluated for each."""

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import RenderSettings, TrainConfig
from warpgs.runtime.graphs import capture
from warpgs.render import Rendering, render
from warpgs.model.splats import Splats
from warpgs.model.scene import SplitScene

MOST_RECORDINGS = 4
"""Sizes of images whose frames are kept recorded: a few browsers may watch one scene."""


class _Recording(NamedTuple):
    """A frame in a CUDA graph, which reads the camera and the time from where they were when it was recorded."""

    camera: Camera
    time: Float[Tensor, "1"]
    replay: Callable[[], tuple[Tensor, ...]]


class Player:
    """Renders a scene as the stage that it was trained to does.

    On CUDA, ``play`` records a frame in a CUDA graph and replays it for every camera of the same size: Python takes
    longer to launch a frame's kernels than the GPU to run them.

    Args:
        scene: On its device.
        config: Of its run.
        facts: Of its checkpoint.
    """

    def __init__(self, scene: SplitScene, config: TrainConfig, facts: dict[str, Any]) -> None:
        self.scene, self.config, self.facts = scene, config, facts
        self._moving, self._relit, self._degree = bool(facts["moving"]), bool(facts["relit"]), int(facts["sh_degree"])
        self._recordings: dict[tuple[int, int], _Recording] = {}

    @property
    def device(self) -> torch.device:
        return self.scene.static.means.device

    @property
    def records(self) -> bool:
        """Whether ``play`` replays a CUDA graph."""
        return self.device.type == "cuda" and self.config.graph

    def is_recorded(self, size: tuple[int, int]) -> bool:
        """Whether a frame of this size is recorded already; else the next one takes longer."""
        return size in self._recordings

    @torch.no_grad()
    def splats(self, moment: float, residual: bool = True) -> Splats:
        """The scene at a moment in [0, 1], with or without the appearance residual."""
        time = torch.tensor([moment], device=self.device)
        return self.scene.splats(time, self._moving, self._relit and residual, self._degree)

    def __call__(self, camera: Camera, branches: bool) -> Rendering:
        """Renders through a camera at the camera's time, with or without the images of the branches."""
        return self._render(camera, torch.tensor([camera.time], device=camera.viewmat.device), branches)

    def play(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The joint image; on CUDA the same tensor every time, with new values."""
        if not self.records:
            return self(camera, False).joint.image
        recording = self._recordings.get(camera.size) or self._record(camera)
        recording.camera.viewmat.copy_(camera.viewmat)
        recording.camera.K.copy_(camera.K)
        recording.time.fill_(camera.time)
        return recording.replay()[0]

    def _record(self, camera: Camera) -> _Recording:
        while len(self._recordings) >= MOST_RECORDINGS:
            del self._recordings[next(iter(self._recordings))]
        seen = Camera(camera.viewmat.clone(), camera.K.clone(), *camera.size)
        time = torch.tensor([camera.time], device=camera.viewmat.device)
        replay = capture(lambda: (self._render(seen, time, False).joint.image,))
        recording = self._recordings[camera.size] = _Recording(seen, time, replay)
        return recording

    @torch.no_grad()
    def _render(self, camera: Camera, time: Float[Tensor, "1"], branches: bool) -> Rendering:
        settings = RenderSettings(branches=branches, antialias=self.config.antialias)
        splats = self.scene.splats(time, self._moving, self._relit, self._degree, late_sh=True)
        return render(splats, camera, settings=settings)
