"""A trained scene: splats at any time, rendered images, and fast playback."""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.config import Plan
from warpgs.data.capture import Capture, background_color
from warpgs.model.scene import SplitScene
from warpgs.model.splats import Splats
from warpgs.rendering import Rendering, render, require_camera
from warpgs.runtime.checks import as_number
from warpgs.runtime.graphs import GraphCache

from .checkpoint import Metadata

MAX_GRAPHS = 4
"""Image sizes whose frames stay captured: several browsers may watch one scene."""


TIME_ROUNDING = 1e-6
"""How far a time may be outside of [0, 1], because sums and single precision round."""


class _Inputs(NamedTuple):
    """What a captured frame reads, at addresses that stay the same."""

    viewmat: Float[Tensor, "4 4"]
    K: Float[Tensor, "3 3"]
    time: Float[Tensor, "1"]


def require_time(time: float) -> float:
    """A time as a number of Python; raises ValueError unless it is in [0, 1], but for rounding; NaN is not."""
    time = as_number("time", time)
    if not -TIME_ROUNDING <= time <= 1.0 + TIME_ROUNDING:
        raise ValueError(f"time must be in [0, 1], from the first frame to the last, got {time}")
    return time


class TrainedScene:
    """The scene of a checkpoint, rendered as the stage of training that wrote it does.

    Args:
        scene: Gaussians and networks, on the device to render on.
        config: Plan of the run.
        metadata: Of the checkpoint: which networks are in use, and the degree of spherical harmonics.

    Attributes:
        rows (Tensor | None): [N] the rows that its Gaussians have in the scene they were selected from; None in that.
        varies: Whether it has other Gaussians at other times, so that ``scene`` are not all.
        background (Tensor | Dome | None): Behind all Gaussians, on the scene's device: a [3] colour, or the sky; None
            is black.
    """

    varies = False

    def __init__(self, scene: SplitScene, config: Plan, metadata: Metadata) -> None:
        self.scene, self.config, self.metadata = scene, config, metadata
        self.rows: Int64[Tensor, " N"] | None = None
        self._graphs: GraphCache[tuple[int, int]] = GraphCache(MAX_GRAPHS, repeatable=True)
        self._inputs: _Inputs | None = None
        color = background_color(config.background)
        self.background = torch.tensor(color, dtype=torch.float32, device=self.device) if any(color) else scene.dome

    def __repr__(self) -> str:
        static, dynamic = len(self.scene.static), len(self.scene.dynamic)
        gaussians = f"{static:,} static and {dynamic:,} dynamic Gaussians"
        return f"<TrainedScene: {gaussians}, iteration {self.metadata.iteration:,}, on {self.device}>"

    @property
    def device(self) -> torch.device:
        return self.scene.static.means.device

    @property
    def uses_graphs(self) -> bool:
        """Whether ``play`` replays CUDA graphs."""
        return self.device.type == "cuda" and self.config.graph

    def is_captured(self, size: tuple[int, int]) -> bool:
        """Whether frames of this (width, height) replay already; until then a frame takes longer."""
        return self._graphs.is_captured(size)

    def open_capture(self, quiet: bool = False) -> Capture:
        """The capture that the scene was trained on.

        Args:
            quiet: Whether to hide progress bars.

        Raises:
            ValueError: If a file of the capture is missing or damaged; the message names it.
        """
        from warpgs.captures.opening import open_capture  # imports all loaders and the ray tracer

        return open_capture(self.config, quiet)

    def select(self, kept: Bool[Tensor, " N"]) -> "TrainedScene":
        """A scene of copies of the Gaussians to keep, by their rows in ``splats``."""
        num_static = len(self.scene.static)
        part = TrainedScene(self.scene.select(kept[:num_static], kept[num_static:]), self.config, self.metadata)
        part.rows = kept.nonzero()[:, 0] if self.rows is None else self.rows[kept]
        return part

    @torch.no_grad()
    def splats(self, time: float, residual: bool = True, camera: Camera | None = None) -> Splats:
        """The Gaussians at a time in [0, 1], static ones first.

        Args:
            time: Time in [0, 1].
            residual: Whether the appearance network changes the static Gaussians (paper Eq. 8).
            camera: On the scene's device. With a rolling shutter, the dynamic ones are at the times of the rows that
                see them.

        Raises:
            ValueError: If the time is not in [0, 1]: nothing was trained there.
        """
        return self._splats(self._on_device(time), residual, camera)

    def _on_device(self, time: float) -> Float[Tensor, "1"]:
        return torch.tensor([require_time(time)], dtype=torch.float32, device=self.device)

    def _splats(self, time: Float[Tensor, "1"], residual: bool = True, camera: Camera | None = None) -> Splats:
        flags = self.metadata.use_deformation, self.metadata.use_appearance and residual
        delays = self.scene.with_delays(camera, time) if camera is not None and flags[0] else None
        splats = self.scene.splats(time, *flags, self.metadata.sh_degree, delays)
        return replace(splats, background=self.background)

    def render(
        self, camera: Camera, time: float | None = None, branches: bool = False, depth: bool = False
    ) -> Rendering:
        """Renders the scene through a camera.

        Args:
            camera: The camera, on any device.
            time: Time in [0, 1]; ``camera.time`` if None.
            branches: Whether to render the static and the dynamic image as well.
            depth: Whether to render depth as well, as ``depth`` [H, W] of each layer: the mean depth of its Gaussians
                along the camera's z axis, or from a fisheye camera their distance from it, weighted by their
                contribution [scene units]. Where alpha is 0, it is 0; where alpha is low, it is that of the little that
                is there.

        Raises:
            TypeError: If the camera is something else.
            ValueError: If the time is not a number in [0, 1]: nothing was trained there.
        """
        require_camera(camera)
        at = self._on_device(camera.time if time is None else time)
        return self._render(camera.to(self.device), at, branches, depth)

    def play(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The joint image at the camera's time, as fast as possible.

        On CUDA the frame is captured in a CUDA graph and replayed for every pinhole camera of the same size; the image
        is then the same tensor in every call, with new values. Raises as ``render``.
        """
        require_camera(camera)
        if not self.uses_graphs or camera.distortion is not None or camera.motion is not None:
            return self.render(camera).joint.image
        require_time(camera.time)
        if self._inputs is None:
            self._inputs = _Inputs(camera.viewmat.clone(), camera.K.clone(), camera.viewmat.new_zeros(1))
        inputs = self._inputs
        inputs.viewmat.copy_(camera.viewmat)
        inputs.K.copy_(camera.K)
        inputs.time.fill_(camera.time)
        return self._graphs.run(camera.size, partial(self._render_inputs, inputs, camera.size))[0]

    def _render_inputs(self, inputs: _Inputs, size: tuple[int, int]) -> tuple[Float[Tensor, "H W 3"]]:
        return (self._render(Camera(inputs.viewmat, inputs.K, *size), inputs.time).joint.image,)

    @torch.no_grad()
    def _render(
        self, camera: Camera, time: Float[Tensor, "1"], branches: bool = False, depth: bool = False
    ) -> Rendering:
        settings = replace(self.config.render_settings, branches=branches, depth=depth)
        return render(self._splats(time, camera=camera), camera, settings=settings)
