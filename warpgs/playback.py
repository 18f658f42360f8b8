"""Playing a trained scene: one frame after another, both networks evaluated for each."""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .cameras import Camera
from .config import RenderSettings, TrainConfig
from .ops.graph import capture
from .render import Rendering, render
from .scene.split import SplitScene


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
        self.scene, self.config = scene, config
        self._stage = (bool(facts["moving"]), bool(facts["relit"]), int(facts["sh_degree"]))
        self._size: tuple[int, int] | None = None
        self._replay: Callable[[], tuple[Tensor, ...]] | None = None

    def __call__(self, camera: Camera, branches: bool) -> Rendering:
        """Renders through a camera at the camera's time, with or without the images of the branches."""
        time = torch.tensor([camera.time], device=camera.viewmat.device)
        return self._render(camera, time, branches)

    def play(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The joint image; on CUDA the same tensor every time, with new values."""
        if not (camera.viewmat.is_cuda and self.config.graph):
            return self(camera, False).joint.image
        if self._replay is None or self._size != camera.size:
            self._size = camera.size
            self._seen = Camera(camera.viewmat.clone(), camera.K.clone(), *camera.size)
            self._time = torch.tensor([camera.time], device=camera.viewmat.device)
            self._replay = capture(lambda: (self._render(self._seen, self._time, False).joint.image,))
        self._seen.viewmat.copy_(camera.viewmat)
        self._seen.K.copy_(camera.K)
        self._time.fill_(camera.time)
        return self._replay()[0]

    @torch.no_grad()
    def _render(self, camera: Camera, time: Tensor, branches: bool) -> Rendering:
        settings = RenderSettings(branches=branches, antialias=self.config.antialias)
        return render(self.scene.splats(time, *self._stage), camera, settings=settings)
