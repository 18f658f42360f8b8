"""Values from a browser are checked, and its events may arrive in any order."""

import math
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

import threading

from tests.video.test_camera_paths import capture
from tests.viewer.watched import Scene
from warpgs.viewer.adaptive_resolution import AdaptiveResolution
from warpgs.viewer.browser_camera import through_training_camera
from warpgs.viewer.canvas import MAX_ASPECT, MAX_CANVAS
from warpgs.viewer.clock import Clock
from warpgs.viewer.layers import LAYERS
from warpgs.viewer.marks import NO_MARKS
from warpgs.viewer.panel import Panel
from warpgs.viewer.pose import Pose
from warpgs.viewer.session import Session
from warpgs.viewer.training_cameras import TrainingCameras

pytestmark = pytest.mark.usefixtures("contracts_off")
TRAINING = TrainingCameras(capture([0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.25, 0.5, 0.75, 1.0]))


def panel(**values):
    """A panel whose controls have the values that a browser sent."""
    made = Panel.__new__(Panel)
    for name, value in values.items():
        setattr(made, name, SimpleNamespace(value=value))
    return made


def session(canvas=(900, 700), **controls):
    """A session that renders nothing, with the canvas and the controls that a browser sent."""
    made = Session.__new__(Session)
    camera = SimpleNamespace(image_width=canvas[0], image_height=canvas[1])
    made._client = SimpleNamespace(camera=camera, scene=Scene())
    made._lock = threading.Lock()
    made._pose = lambda: Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
    made.panel = panel(**controls)
    return made


@pytest.fixture(autouse=True)
def _without_thumbnails(monkeypatch):
    monkeypatch.setattr(TRAINING, "thumbnail", lambda _: None)


@pytest.mark.parametrize(
    ("sent", "canvas"),
    [
        ((900, 700), (900, 700)),
        ((0, 0), (1, 1)),
        ((-5, 700), (1, 700)),
        ((32768, 32768), (2160, 2160)),
        ((8192, 2160), (4096, 1080)),
        ((1, 10**9), (1, 2160)),
        ((10**9, 1), (4096, 1)),
    ],
)
def test_the_canvas_size_is_limited(sent, canvas):
    assert session(sent)._canvas() == canvas
    assert canvas[0] <= MAX_CANVAS[0]
    assert canvas[1] <= MAX_CANVAS[1]


@pytest.mark.parametrize("size", [(1, 10**6), (10**6, 1), (900, 700)])
def test_the_size_of_a_keyframe_is_limited(size):
    camera = session(size, width=10**9, time=0.5).current_camera()
    assert 1 <= camera.width <= 1920
    assert 1 <= camera.height <= MAX_ASPECT * 1920


def sent_screenshot(canvas, width):
    """(width, height) of the image that a session with a canvas sends."""
    here, sent = looking(TRAINING.views[0].pose, 0.5), []
    camera = here._client.camera
    camera.image_width, camera.image_height = canvas
    here.panel.width.value = width
    here._source.run = SimpleNamespace(folder=Path("run"))
    render = Mock(side_effect=lambda r, scale: SimpleNamespace(image=np.zeros((*r.size_at(scale)[::-1], 3), np.uint8)))
    here._renderer = SimpleNamespace(render=render)
    here._client.send_file_download = lambda _, data, **__: sent.append(cv2.imdecode(np.frombuffer(data, np.uint8), 1))
    here._send_screenshot()
    return sent[0].shape[1::-1]


@pytest.mark.parametrize(
    ("canvas", "size"),
    [((900, 700), (1600, 1244)), ((1920, 1080), (1600, 900)), ((300, 10**6), (1600, 4096 * 2160 // 1600))],
)
def test_a_screenshot_is_as_wide_as_the_slider_says(canvas, size):
    assert sent_screenshot(canvas, 1600) == size


@pytest.mark.parametrize(
    ("sent", "time", "speed", "width"),
    [
        (0.5, 0.5, 0.5, 160),
        (-1.0, 0.0, 0.1, 160),
        (1e9, 1.0, 4.0, 1920),
        (math.inf, 1.0, 4.0, 1920),
        (math.nan, 0.0, 0.1, 160),
    ],
)
def test_values_of_sliders_are_clamped_to_their_ranges(sent, time, speed, width):
    made = panel(time=sent, speed=sent, width=sent)
    assert (made.current_time, made.current_speed, made.current_width) == (time, speed, width)


@pytest.mark.parametrize("sent", ["no layer", None, [], 3])
def test_an_unknown_layer_is_replaced_by_the_first(sent):
    assert panel(layer=sent).current_layer == next(iter(LAYERS))


def test_the_image_of_a_training_camera_stays_whole_as_the_canvas_changes_until_the_camera_moves():
    here, view = session((900, 700), view=2), TRAINING.views[1]
    here._fitted, here._pose = (900, 700), lambda: view.pose
    camera = here._client.camera
    camera.image_width = 300
    here._fit(TRAINING)
    fitted = camera.fov
    assert fitted == through_training_camera(TRAINING, 1, 300 / 700).fov > view.pose.fov
    here._pose = lambda: view.pose._replace(position=(9.0, 9.0, 9.0))
    camera.image_width = 200
    here._fit(TRAINING)
    assert camera.fov == fitted


def test_training_cameras_are_shown_while_the_checkbox_is_set():
    here = session(show_cameras=True)
    here._show_cameras(TRAINING)
    assert here._client.scene.names == [f"/training/{k}" for k in TRAINING.frustums()]
    here.panel.show_cameras.value = False
    here._show_cameras(TRAINING)
    assert here._client.scene.names == []


def test_cameras_that_are_switched_off_while_they_are_added_are_removed(monkeypatch):
    here = session(show_cameras=True)
    read = []

    def slow_thumbnail(index):
        read.append(index)
        here.panel.show_cameras.value = len(read) < 3

    monkeypatch.setattr(TRAINING, "thumbnail", slow_thumbnail)
    here._show_cameras(TRAINING)
    assert len(read) == 3
    assert here._client.scene.names == []


def looking(pose, time, wipe=0.0):
    """A session that looks with a pose at a time, with the second training camera selected; it renders nothing."""
    here = session(view=2, width=640, layer="joint", residual=True, time=time, wipe=wipe)
    here._pose, here._training, here._clock, here._resolution = lambda: pose, TRAINING, Clock(), AdaptiveResolution()
    here._source, here.cleanup = (
        SimpleNamespace(),
        SimpleNamespace(scene=object, selection=SimpleNamespace(marks=NO_MARKS)),
    )
    here._frustums = SimpleNamespace(visible=True)
    here._requested = here._shown = None
    here._changed_at = 0.0
    here._render = lambda *_: None
    return here


def test_training_cameras_are_hidden_from_where_the_selected_one_stands_and_shown_from_elsewhere():
    view = TRAINING.views[1]
    here = looking(view.pose, view.time)
    here._update_image()
    assert not here._frustums.visible
    here._pose = lambda: view.pose._replace(position=(9.0, 9.0, 9.0))
    here._update_image()
    assert here._frustums.visible


def test_truth_is_shown_where_and_when_it_was_recorded():
    view = TRAINING.views[1]
    assert looking(view.pose, round(view.time, 3), 0.5)._request().truth == (1, 0.5)
    assert looking(view.pose, view.time + 0.01, 0.5)._request().truth is None
    elsewhere = view.pose._replace(position=(9.0, 9.0, 9.0))
    assert looking(elsewhere, view.time, 0.5)._request().truth is None


@pytest.mark.parametrize(("sent", "shown"), [(999, 5), (-3, 1)])
def test_a_number_beyond_the_training_cameras_is_corrected(sent, shown):
    here = session(view=sent)
    here._snap = lambda _: None
    here._select(TRAINING)
    assert here.panel.view.value == shown


def test_an_outdated_event_shows_nothing():
    """The last click counts, in whichever order the threads run."""
    here = session(show_cameras=False)
    here._show_cameras(TRAINING)
    assert here._client.scene.names == []


def test_events_are_handled_one_at_a_time():
    here = session(show_cameras=True)
    with here._lock:
        other = threading.Thread(target=here._show_cameras, args=(TRAINING,))
        other.start()
        other.join(0.2)
        assert here._client.scene.names == []
    other.join()
    assert here._client.scene.names


def test_a_step_goes_to_the_next_training_time_and_pauses():
    here = session(time=0.25)
    here._training, here._clock, here._wake = TRAINING, Clock(), threading.Event()
    here.panel.play = SimpleNamespace(label="Pause")
    here._clock.toggle()
    times = []
    for forward in (True, True, True, True, False):
        here._step(forward)
        times.append(here.panel.time.value)
    assert times == [0.5, 0.75, 1.0, 1.0, 0.75]
    assert not here._clock.playing
    assert here.panel.play.label == "Play"
