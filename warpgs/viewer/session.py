"""One browser: its camera, its controls and the thread that renders for it."""

import threading
import time
from collections import deque
from functools import partial
from typing import NamedTuple

import numpy as np
import viser
from jaxtyping import UInt8

from warpgs.cameras import Camera
from warpgs.model.splats import Splats
from warpgs.runs.trained import TrainedScene
from warpgs.visualize import to_bytes

from .clock import Clock
from .frustums import BLUE, add_frustum
from .layers import LayerName, picture
from .looks import aim, look_through
from .pace import Pace
from .panel import PAUSE, PLAY, Panel, plain, put
from .path_editor import PathEditor
from .pose import Pose, camera_of
from .source import Source
from .training_cameras import TrainingCameras

REST_SECONDS = 0.2
"""After this long without a change, the picture is refined."""

IDLE_SECONDS = 0.5
"""Between looks for a newer checkpoint, where nothing else happens."""

STATUS_SECONDS = 0.3
"""Between changes of the status: no more often than a person reads."""

QUALITY, QUALITY_AT_REST = 80, 92
"""Of JPEG."""

RATE_SECONDS = 2.0
"""Pictures of the last seconds that count for frames a second; at rest it is what the last one would allow."""

MAX_CANVAS = (4096, 2160)
"""Width and height to draw for [px]."""

MAX_ASPECT = 4
"""Height over width of a keyframe, at most."""

KEYFRAME_SCALE = 0.1
"""Size to draw keyframes at where there are no training cameras [scene units]."""


class RenderRequest(NamedTuple):
    """Everything that a picture depends on, but its resolution."""

    scene: TrainedScene
    pose: Pose
    canvas: tuple[int, int]
    across: int
    layer: LayerName
    residual: bool
    moment: float

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the whole picture: no larger than the canvas, nor wider than ``across``."""
        width, height = self.canvas
        across = min(width, self.across)
        return across, max(1, round(height * across / width))


class Session:
    """Renders for one browser until it is stopped.

    Args:
        client: The browser.
        source: What is shown.
        training: Cameras to snap to, if there are any.
        rendering: Held while rendering: one picture at a time, whoever it is for.
        width: Pixels across at rest, to begin with.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        source: Source,
        training: TrainingCameras | None,
        rendering: threading.Lock,
        width: int,
    ) -> None:
        self._client, self._source, self._training, self._rendering = client, source, training, rendering
        self._pace, self._clock = Pace(), Clock()
        self._stopped, self._wake = threading.Event(), threading.Event()
        self._changing = threading.Lock()  # every event of the panel comes on a thread of its own
        self._wished: RenderRequest | None = None
        self._changed = 0.0
        self._shown: tuple[RenderRequest, float] | None = None
        self._splats: tuple[RenderRequest, Splats] | None = None
        self._sent: deque[float] = deque(maxlen=200)
        self._cost = ("", 0.0)
        self._note = self._problem = ""
        self._said_at = 0.0
        self.panel = Panel(client.gui, training, width)
        scale = KEYFRAME_SCALE if training is None else training.frustum_scale
        self.path = PathEditor(client.scene, self.panel, source.run.folder, self._look, scale)
        self._connect()
        if training is not None:
            put(self.panel.view, len(training.views) // 2 + 1)  # which snaps
        self._thread = threading.Thread(target=self._run, name=f"viewer-{client.client_id}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread, after the picture that it is at."""
        self._stopped.set()
        self._wake.set()

    def join(self) -> None:
        self._thread.join()

    # What the controls do ---------------------------------------------------------------------------------------------

    def _connect(self) -> None:
        panel, training = self.panel, self._training
        self._client.camera.on_update(lambda _: self._wake.set())
        for control in (panel.time, panel.layer, panel.residual, panel.width):
            control.on_update(lambda _: self._wake.set())
        panel.play.on_click(lambda _: self._toggle())
        if training is not None:
            panel.view.on_update(lambda _: self._snap(training))
            panel.snap.on_click(lambda _: self._snap(training))
            panel.show_cameras.on_update(lambda _: self._show_cameras(training))

    def _toggle(self) -> None:
        with self._changing:
            self._clock.toggle()
            self.panel.play.label = PAUSE if self._clock.playing else PLAY
        self._wake.set()

    def _snap(self, training: TrainingCameras) -> None:
        """Looks through the training camera that the slider is at, at its time."""
        with self._changing:
            number = min(max(int(self.panel.view.value), 1), len(training.views)) - 1
            view, camera = training.views[number], self._client.camera
            width, height = self._canvas()
            with self._client.atomic():
                aim(camera, look_through(training, number, width / height))
                camera.wxyz = np.array(view.pose.wxyz)
            put(self.panel.time, view.time)
            image = training.picture(number)
            self._note = f"the picture of {view.name} can't be read" if image is None else ""
            if image is not None:
                self.panel.truth.image = image
        self._wake.set()

    def _show_cameras(self, training: TrainingCameras) -> None:
        """Draws training cameras into the scene, or takes them away, as the panel says by now."""
        with self._changing:
            for number in training.spread():
                if not self.panel.show_cameras.value:
                    break
                view, image = training.views[number], training.picture(number)
                name, scale = f"/training/{number}", training.frustum_scale
                frustum = add_frustum(self._client.scene, name, view.pose, view.aspect, scale, BLUE, image)
                frustum.on_click(partial(self._look_through, training, number))
            if not self.panel.show_cameras.value:
                self._client.scene.remove_by_name("/training")

    def _look_through(self, training: TrainingCameras, number: int, _: object) -> None:
        if self.panel.view.value == number + 1:
            self._snap(training)
        else:
            put(self.panel.view, number + 1)  # which snaps

    # Rendering --------------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                wait = self._turn()
            except (ValueError, RuntimeError) as error:  # out of memory is a RuntimeError
                self._problem, wait = str(error), IDLE_SECONDS
            self._say()
            if wait and self._wake.wait(wait):
                self._wake.clear()

    def _turn(self) -> float:
        """Draws a picture if there is a better one than what is shown; returns how long there will be none [s]."""
        now = time.monotonic()
        panel = self.panel
        if self._clock.playing:
            put(panel.time, self._clock.advance(panel.moment, panel.pace, now))
        wish = self._wish()
        if wish is None:
            return IDLE_SECONDS
        if wish != self._wished:
            self._wished, self._changed = wish, now
        shown = self._shown[1] if self._shown is not None and self._shown[0] == wish else 0.0
        rest = self._changed + REST_SECONDS - now
        width, height = wish.size
        scale = self._pace.while_moving(width * height) if rest > 0 or not shown else Pace.refined(shown)
        if scale > shown:
            self._draw(wish, scale, (max(1, round(width * scale)), max(1, round(height * scale))))
            return 0.0
        return rest if rest > 0 and shown < 1 else IDLE_SECONDS

    def _wish(self) -> RenderRequest | None:
        scene, panel = self._source.current(), self.panel
        if scene is None:
            return None
        looks = (panel.layer.value, bool(panel.residual.value), panel.moment)
        return RenderRequest(scene, self._pose(), self._canvas(), panel.across, *looks)

    def _draw(self, wish: RenderRequest, scale: float, size: tuple[int, int]) -> None:
        replays = scale == 1 and wish.layer == "joint" and wish.residual and wish.scene.uses_graphs
        is_first = replays and not wish.scene.is_captured(size)
        with self._rendering:
            start = time.perf_counter()
            camera = camera_of(wish.pose, size, wish.moment)
            image = self._replayed(wish, camera) if replays else self._rendered(wish, camera)
            drawn = time.perf_counter()
        quality = QUALITY_AT_REST if scale == 1 else QUALITY
        self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
        now = time.perf_counter()
        if not is_first:  # the recording takes longer than any picture after it
            self._pace.took(size[0] * size[1], now - start)
        self._shown, self._problem = (wish, scale), ""
        self._sent.append(now)
        self._cost = (f"{size[0]} × {size[1]} rendered in {(drawn - start) * 1e3:.1f} ms", 1.0 / (now - start))

    def _replayed(self, wish: RenderRequest, camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
        """A whole joint picture on CUDA, faster than its kernels could be launched."""
        return to_bytes(wish.scene.play(camera.to(wish.scene.device)))

    def _rendered(self, wish: RenderRequest, camera: Camera) -> UInt8[np.ndarray, "H W 3"]:
        return picture(self._splats_of(wish), camera, wish.layer, wish.scene.config.antialias)

    def _splats_of(self, wish: RenderRequest) -> Splats:
        """The scene at the moment; the last one is kept, so that the networks rest while only the camera moves."""
        kept = self._splats
        if kept is None or any(getattr(kept[0], n) != getattr(wish, n) for n in ("scene", "moment", "residual")):
            kept = self._splats = (wish, wish.scene.splats(wish.moment, wish.residual))
        return kept[1]

    def _pose(self) -> Pose:
        camera = self._client.camera
        return Pose(tuple(camera.wxyz.tolist()), tuple(camera.position.tolist()), float(camera.fov))

    def _canvas(self) -> tuple[int, int]:
        """Size of the canvas, no larger than any screen: the browser may claim what it likes."""
        camera = self._client.camera
        width, height = max(1, camera.image_width), max(1, camera.image_height)
        factor = min(1.0, MAX_CANVAS[0] / width, MAX_CANVAS[1] / height)
        return max(1, round(width * factor)), max(1, round(height * factor))

    def _look(self) -> Camera:
        """What is seen, as wide as the slider says: the browser changes the size of its canvas as it likes."""
        width, height = self._canvas()
        across = self.panel.across
        high = min(max(1, round(height * across / width)), MAX_ASPECT * across)
        return camera_of(self._pose(), (across, high), self.panel.moment)

    def _say(self) -> None:
        """Shows counts, speed and what is wrong."""
        now = time.perf_counter()
        if now - self._said_at < STATUS_SECONDS:
            return
        self._said_at = now
        lines = [plain(line) for line in (self._problem, self._note, self._source.note) if line]
        if self._shown is not None:
            trained = self._shown[0].scene
            static, dynamic = len(trained.scene.static), len(trained.scene.dynamic)
            recent = sum(now - sent < RATE_SECONDS for sent in self._sent)
            cost, rate = self._cost
            rate = recent / RATE_SECONDS if recent > 2 else rate
            counts = f"{static:,} static, {dynamic:,} dynamic Gaussians"
            lines += [counts, f"iteration {trained.metadata.iteration:,}", f"{cost}, {rate:.1f} FPS"]
        self.panel.status.content = "  \n".join(lines)
