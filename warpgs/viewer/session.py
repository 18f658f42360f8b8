"""One browser: its camera, its controls, and the thread that renders for it."""

import bisect
import gc
import threading
import time
from collections import deque
from functools import partial
from typing import NamedTuple

import numpy as np
import viser

from warpgs.cameras import Camera
from warpgs.files import encode_png
from warpgs.posix import release_free_memory

from . import comparison
from .adaptive_resolution import AdaptiveResolution
from .browser_camera import set_camera, through_training_camera
from .canvas import NARROW, canvas_of, size_at
from .cleanup import Cleanup
from .clock import Clock
from .comparison import with_truth
from .frustums import FRUSTUMS, show_training
from .page_state import PageState
from .panel import FORWARD, PAUSE, PLAY, Panel, set_value
from .path_editor import PathEditor
from .pose import Pose, camera_of, pose_of
from .renderer import Renderer, RenderRequest
from .source import Source
from .status import HIDDEN, LEAVES, about, status_html
from .steering import Steering
from .training_cameras import TrainingCameras

REST_SECONDS = 0.2
"""Time without a change after which the image is refined [s]."""

IDLE_SECONDS = 0.5
"""Interval between checks for a newer checkpoint while nothing else happens [s]."""

STATUS_SECONDS = 0.3
"""Minimum interval between updates of the status [s]."""

QUALITY, QUALITY_AT_REST = 80, 92
"""JPEG quality while something changes, and at rest."""

RATE_SECONDS = 2.0
"""Interval over which images are counted for the FPS [s]; at rest, the FPS are estimated from the last image."""

KEYFRAME_SCALE = 0.1
"""Size of keyframes in a scene without training cameras [scene units]."""

ROUNDED = 0.51e-3
"""Maximum error of a time from its slider, which has three digits."""

STEPS = 60
"""Steps of the time of a scene without training cameras."""


class Shown(NamedTuple):
    """The image that the browser shows, and the scale of its sides."""

    request: RenderRequest
    scale: float


class Session:
    """Renders for one browser until it is stopped.

    Args:
        client: The browser.
        source: The scene to show.
        training: The training cameras, if there are any.
        rendering: Lock of ``Renderer``.
        width: Initial width of the image at rest [px].
        view: What the page showed before it was reloaded; None for a new one.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        source: Source,
        training: TrainingCameras | None,
        rendering: threading.Lock,
        width: int,
        view: PageState | None = None,
    ) -> None:
        self._client, self._source, self._training = client, source, training
        self._renderer, self._resolution, self._clock = Renderer(rendering), AdaptiveResolution(), Clock()
        self._stopped, self._wake, self._wants_screenshot = (threading.Event() for _ in range(3))
        self._lock = threading.Lock()  # each event of the panel is handled on its own thread
        self._requested: RenderRequest | None = None
        self._changed_at = 0.0
        self._shown: Shown | None = None
        self._sent: deque[float] = deque(maxlen=200)
        self._cost = ("", 0.0)
        self._note = self._problem = ""
        self._fitted = (0, 0)  # the canvas that the view of a training camera was fitted to
        self._status_at = 0.0
        path, filmed = (None, None) if training is None else (training.path, training.filmed)
        self._steering = Steering(client.camera, path, filmed)
        self.panel = Panel(client.gui, training, width, is_narrow=self._canvas()[0] < NARROW)
        scale, capture = (KEYFRAME_SCALE, None) if training is None else (training.frustum_scale, training.capture)
        self.path = PathEditor(client.scene, self.panel.path, source.run, self, scale, capture)
        self.cleanup = Cleanup(client.scene, self.panel, source, rendering, self._wake.set, self._request)
        self._frustums = client.scene.add_frame(FRUSTUMS, show_axes=False, visible=False)
        if view is not None:
            self._restore(view)
        self._connect()
        if training is not None and view is None:
            set_value(self.panel.view, len(training.views) // 2 + 1)  # its handler calls _snap
        self._thread = threading.Thread(target=self._run, name=f"viewer-{client.client_id}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread after the current image."""
        self._stopped.set()
        self._wake.set()
        self.path.stop()

    def join(self, timeout: float | None = None) -> None:
        """Waits for the thread, at most ``timeout`` seconds."""
        self._thread.join(timeout)

    # A page that is reloaded ------------------------------------------------------------------------------------------

    def view(self) -> PageState:
        """What the browser shows."""
        return PageState.of(self._steering, self.panel, self._training is not None, self.path, self.cleanup.edits)

    def _restore(self, view: PageState) -> None:
        self.path.restore(view.path)
        self.cleanup.restore(view.edits)
        for name, value in view.controls.items():
            set_value(getattr(self.panel, name), value)
        if self._training is not None and view.training_view is not None:
            set_value(self.panel.view, view.training_view)
            self._show_thumbnail(self._training)
        with self._client.atomic():
            set_camera(self._client.camera, view.camera)
            self._client.camera.wxyz = view.orientation
        self._steering.placed(view.pose, self.panel.current_time)

    # Handlers of the controls -----------------------------------------------------------------------------------------

    def _connect(self) -> None:
        panel, training = self.panel, self._training
        self._client.camera.on_update(lambda _: self._look())
        panel.follow.on_update(lambda _: self._follow())
        self._client.gui.add_command("Play or pause", hotkey="space").on_trigger(lambda _: self._toggle())
        for control in (panel.time, panel.layer, panel.residual, panel.width):
            control.on_update(lambda _: self._wake.set())
        panel.play.on_click(lambda _: self._toggle())
        panel.step.on_click(lambda _: self._step(panel.step.value == FORWARD))
        panel.screenshot.on_click(lambda _: self._ask_for_screenshot())
        if training is not None:
            self._client.camera.on_update(lambda _: self._fit(training))
            panel.wipe.on_update(lambda _: self._wake.set())
            panel.view.on_update(lambda _: self._select(training))
            panel.snap.on_click(lambda _: self._snap(training))
            panel.show_cameras.on_update(lambda _: self._show_cameras(training))

    def _look(self) -> None:
        """The browser's camera or canvas has changed: by the mouse, which ends following, or by the session."""
        if self.panel.follow.value and self._steering.is_moved_by_hand():
            set_value(self.panel.follow, False)  # its handler lets the browser's camera catch up
        self.panel.fill(self._client.camera.image_width)
        self._wake.set()

    def _follow(self) -> None:
        """Goes to the training camera, or lets the browser's camera go on from there."""
        if self.panel.follow.value:
            self._steering.follow()
        else:
            self._steering.catch_up()
        self._wake.set()

    def _toggle(self) -> None:
        with self._lock:
            self._clock.toggle()
            self.panel.play.label = PAUSE if self._clock.playing else PLAY
        self._wake.set()

    def _step(self, forward: bool) -> None:
        """Goes to the time of the next training frame, or of the one before, and pauses."""
        with self._lock:
            if self._clock.playing:
                self._clock.toggle()
                self.panel.play.label = PLAY
            times = [k / STEPS for k in range(STEPS + 1)] if self._training is None else self._training.times
            now = self.panel.current_time
            index = (
                bisect.bisect_right(times, now + ROUNDED) if forward else bisect.bisect_left(times, now - ROUNDED) - 1
            )
            set_value(self.panel.time, times[min(max(index, 0), len(times) - 1)])
        self._wake.set()

    def _ask_for_screenshot(self) -> None:
        """Lets the thread of this session render it: what a thread learns of image sizes is kept until it ends."""
        self._wants_screenshot.set()
        self._wake.set()

    def _send_screenshot(self) -> None:
        """Sends the image to the browser as a PNG file, as wide as the slider says, also if the canvas is narrower."""
        request = self._request()
        if request is None:
            return
        request = request._replace(canvas=size_at(request.canvas, request.max_width))
        try:
            image = with_truth(self._renderer.render(request, 1.0).image, request, self._training)
        except (ValueError, RuntimeError) as error:
            self._problem = str(error)
            return
        name = f"{self._source.run.folder.resolve().name}-{request.layer.replace(' ', '-')}-{request.time:.3f}.png"
        self.download(name, encode_png(image))

    def _select(self, training: TrainingCameras) -> None:
        """Looks through the selected training camera, and shows its number if there is none of the number typed in."""
        selected = self._selected(training) + 1
        if self.panel.view.value != selected:
            set_value(self.panel.view, selected)  # its handler comes back here
        else:
            self._snap(training)

    def _snap(self, training: TrainingCameras) -> None:
        """Looks through the training camera that the slider selects, at its time."""
        with self._lock:
            index = self._selected(training)
            view, camera = training.views[index], self._client.camera
            self._fitted = canvas = self._canvas()
            seen = through_training_camera(training, index, canvas[0] / canvas[1])
            with self._client.atomic():
                set_camera(camera, seen)
                camera.wxyz = np.array(view.pose.wxyz)
            set_value(self.panel.time, view.time)
            self._steering.placed(view.pose._replace(fov=seen.fov), self.panel.current_time)
            is_shown = self._show_thumbnail(training)
            self._note = "" if is_shown else f"the image of {view.name} cannot be read"
        self._wake.set()

    def _fit(self, training: TrainingCameras) -> None:
        """Shows the whole image of the training camera also when the canvas changes, as long as the camera stays."""
        with self._lock:
            index, canvas, now = self._selected(training), self._canvas(), self._pose()
            pose = training.views[index].pose
            stays = np.allclose(now.position, pose.position, atol=1e-5) and abs(np.dot(now.wxyz, pose.wxyz)) > 1 - 1e-6
            if self._fitted != canvas and stays:
                self._fitted = canvas
                self._client.camera.fov = through_training_camera(training, index, canvas[0] / canvas[1]).fov

    def _selected(self, training: TrainingCameras) -> int:
        """Index of the training camera that the slider selects."""
        return min(max(int(self.panel.view.value), 1), len(training.views)) - 1

    def _show_thumbnail(self, training: TrainingCameras) -> bool:
        """Shows the image of the selected training camera in the panel; whether it can be read."""
        if (image := training.thumbnail(self._selected(training))) is not None:
            self.panel.truth.image = image
        return image is not None

    def _show_cameras(self, training: TrainingCameras) -> None:
        """Adds the training cameras to the scene or removes them, as the checkbox is set by now."""
        with self._lock:
            show_training(self._client.scene, training, partial(self._look_through, training), self.panel)

    def _look_through(self, training: TrainingCameras, index: int, _: object) -> None:
        if self.panel.view.value == index + 1:
            self._snap(training)
        else:
            set_value(self.panel.view, index + 1)  # its handler calls _snap

    # Rendering --------------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                if self._wants_screenshot.is_set():
                    self._wants_screenshot.clear()
                    self._send_screenshot()
                wait = self._update_image()
            except (ValueError, RuntimeError) as error:  # out of memory is a RuntimeError
                self._problem, wait = str(error), IDLE_SECONDS
            self._update_status()
            if wait and self._wake.wait(wait):
                self._wake.clear()
        gc.collect()  # viser's handles refer to each other: Python finds that of itself after about a hundred visits
        release_free_memory()

    def _update_image(self) -> float:
        """Renders an image if it would be better than the one shown; returns how long to wait for the next [s]."""
        now = time.monotonic()
        panel = self.panel
        if self._clock.playing:
            set_value(panel.time, self._clock.advance(panel.current_time, panel.current_speed, now))
        request = self._request()
        if request is None:
            return IDLE_SECONDS
        follows = self._clock.playing and bool(panel.follow.value)  # then the browser's camera is elsewhere
        self._frustums.visible = self._at(request) is None and not follows  # from one, they would cover the image
        if request != self._requested:
            self._requested, self._changed_at = request, now
        shown = self._shown.scale if self._shown is not None and self._shown.request == request else 0.0
        until_rest = self._changed_at + REST_SECONDS - now
        if until_rest <= 0:
            self._steering.catch_up()
        if until_rest > 0 or not shown:
            scale = self._resolution.interactive_scale(request.size[0] * request.size[1])
        else:
            scale = self._resolution.refined(shown)
        if scale > shown:
            self._render(request, scale)
            return 0.0
        return until_rest if until_rest > 0 and shown < 1 else IDLE_SECONDS

    def _request(self) -> RenderRequest | None:
        """The image that the camera and the controls ask for; None without a scene."""
        if (scene := self.cleanup.scene()) is None:
            return None
        panel = self.panel
        controls = (panel.current_width, panel.current_layer, bool(panel.residual.value), panel.current_time)
        request = RenderRequest(scene, self._pose(), self._canvas(), *controls)
        return request._replace(truth=self._truth_for(request), marks=self.cleanup.selection.marks)

    def _truth_for(self, request: RenderRequest) -> tuple[int, float] | None:
        """The training camera whose image is shown beside, and which part; only from where and when it was recorded."""
        wipe = self.panel.current_wipe
        index = self._at(request) if wipe else None
        if self._training is None or index is None or abs(request.time - self._training.views[index].time) > ROUNDED:
            return None
        return index, wipe

    def _at(self, request: RenderRequest) -> int | None:
        """The training camera that the slider selects, if the browser's camera is where it was recorded."""
        training = self._training
        if training is None:
            return None
        index = self._selected(training)
        camera = camera_of(request.pose, request.size, request.time)
        return index if comparison.is_beside(camera, training.camera(index), training.capture.median_depth) else None

    def _render(self, request: RenderRequest, scale: float) -> None:
        """Renders an image and sends it to the browser."""
        rendered = self._renderer.render(request, scale)
        start = time.perf_counter() - rendered.seconds  # without waiting for the images of other browsers
        image, quality = with_truth(rendered.image, request, self._training), QUALITY_AT_REST if scale == 1 else QUALITY
        self._client.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
        now = time.perf_counter()
        width, height = request.size_at(scale)
        if not rendered.is_warm_up:
            self._resolution.add(width * height, now - start)
        self._shown, self._problem = Shown(request, scale), ""
        self._sent.append(now)
        digits = 1 if rendered.seconds < 0.1 else 0  # the line must not wrap, which would move all controls
        self._cost = (f"{width} × {height} in {1e3 * rendered.seconds:.{digits}f} ms", 1.0 / (now - start))

    def _pose(self) -> Pose:
        return self._steering.pose(self.panel.current_time, bool(self.panel.follow.value))

    def _canvas(self) -> tuple[int, int]:
        """(width, height) of the canvas."""
        return canvas_of(self._client.camera)

    def go_to(self, camera: Camera) -> None:
        """Moves the camera of the browser, and its time; it no longer follows the training camera."""
        pose, handle = pose_of(camera), self._client.camera
        set_value(self.panel.follow, False)
        with self._client.atomic():
            handle.wxyz, handle.position = np.array(pose.wxyz), np.array(pose.position)
            handle.fov = pose.fov
        set_value(self.panel.time, camera.time)
        self._steering.placed(pose, self.panel.current_time)
        self._wake.set()

    def download(self, name: str, content: bytes) -> None:
        """Lets the browser download a file."""
        self._client.send_file_download(name, content, save_immediately=True)

    def current_camera(self) -> Camera:
        """The current camera for a keyframe, with the width of the slider: the size of the canvas may change."""
        return camera_of(self._pose(), size_at(self._canvas(), self.panel.current_width), self.panel.current_time)

    def _update_status(self) -> None:
        """Shows problems, numbers of Gaussians, the iteration and the speed."""
        now = time.perf_counter()
        if now - self._status_at < STATUS_SECONDS:
            return
        self._status_at = now
        hidden = HIDDEN if self.panel.shows_cameras and not self._frustums.visible else ""
        leaves = LEAVES if self._steering.outside() > 1 else ""
        notes = [n for n in (self._problem, leaves, self._note, hidden, self._source.note, self._source.progress) if n]
        lines = []
        if self._shown is not None:
            recent, (cost, rate) = sum(now - sent < RATE_SECONDS for sent in self._sent), self._cost
            lines = about(self._shown.request.scene, cost, recent / RATE_SECONDS if recent > 2 else rate)
        if (text := status_html(lines, notes)) != self.panel.status.content:
            self.panel.status.content = text
