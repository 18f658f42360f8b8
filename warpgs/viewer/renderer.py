"""Requests for images, and rendering them."""

import threading
import time
from typing import NamedTuple

from warpgs.cameras import Camera
from warpgs.model.splats import Splats
from warpgs.runs.trained import TrainedScene
from warpgs.visualize.images import to_bytes

from .layers import Image, render_layer
from .marks import NO_MARKS, Marks, rows_of, tinted, with_outline
from .pose import Pose, camera_of


class RenderRequest(NamedTuple):
    """Everything that an image depends on except its resolution.

    Attributes:
        scene: The trained scene.
        pose: Camera of the browser.
        canvas: (width, height) of the browser's canvas [px].
        max_width: Maximum width of the image [px].
        layer: Key of ``LAYERS``.
        residual: Whether the appearance network changes the static Gaussians.
        time: Time in [0, 1].
        truth: Index of the training camera whose image is shown beside, and the part of its width; None without.
        marks: What is selected.
    """

    scene: TrainedScene
    pose: Pose
    canvas: tuple[int, int]
    max_width: int
    layer: str
    residual: bool
    time: float
    truth: tuple[int, float] | None = None
    marks: Marks = NO_MARKS

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image at full resolution: no larger than the canvas, nor wider than ``max_width``."""
        width, height = self.canvas
        across = min(width, self.max_width)
        return across, max(1, round(height * across / width))

    @property
    def seen(self) -> Camera:
        """The camera of the browser, with the size of the canvas."""
        return camera_of(self.pose, self.canvas, self.time)

    def size_at(self, scale: float) -> tuple[int, int]:
        """(width, height) of the image at a scale of its sides."""
        width, height = self.size
        return max(1, round(width * scale)), max(1, round(height * scale))


class Rendered(NamedTuple):
    """An image and what it took.

    Attributes:
        image: [H, W, 3] 8-bit RGB.
        seconds: Time to render it [s].
        is_warm_up: Whether it was rendered before images of its size replay a CUDA graph; later images take less time.
    """

    image: Image
    seconds: float
    is_warm_up: bool


class Renderer:
    """Renders the images of one browser.

    Args:
        lock: Held while rendering; it is shared by all browsers, so that one image is rendered at a time.
    """

    def __init__(self, lock: threading.Lock) -> None:
        self._lock = lock
        self._splats: tuple[RenderRequest, Splats] | None = None

    def render(self, request: RenderRequest, scale: float) -> Rendered:
        """Renders an image at a scale of its sides.

        Full-resolution images of the joint layer are replayed from a CUDA graph on CUDA, which is faster.
        """
        size, scene = request.size_at(scale), request.scene
        replays = (
            scale == 1
            and request.layer == "joint"
            and request.residual
            and scene.uses_graphs
            and not request.marks.selected
        )
        is_warm_up = replays and not scene.is_captured(size)
        with self._lock:
            start = time.perf_counter()
            camera = camera_of(request.pose, size, request.time)
            image = to_bytes(scene.play(camera.to(scene.device))) if replays else self._render_layer(request, camera)
            image = with_outline(image, request.marks.outline)
            return Rendered(image, time.perf_counter() - start, is_warm_up)

    def _render_layer(self, request: RenderRequest, camera: Camera) -> Image:
        splats, selected = self._splats_of(request), request.marks.selected
        if selected is not None:
            splats = tinted(splats, rows_of(request.scene, selected))
        return render_layer(request.layer, splats, camera, request.scene.config.render_settings)

    def _splats_of(self, request: RenderRequest) -> Splats:
        """The Gaussians of a request, kept while only the camera moves, so that the networks need not run again."""
        kept = self._splats
        if kept is None or any(getattr(kept[0], n) != getattr(request, n) for n in ("scene", "time", "residual")):
            kept = self._splats = (request, request.scene.splats(request.time, request.residual))
        return kept[1]
