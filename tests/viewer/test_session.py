"""What a browser says is not taken on trust, and its events may come in any order."""

import math
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

import threading

from tests.video.test_camera_paths import capture
from warpgs.viewer import path_editor
from warpgs.viewer.panel import Panel
from warpgs.viewer.path_editor import PathEditor
from warpgs.viewer.pose import Pose, camera_of
from warpgs.viewer.session import MAX_ASPECT, MAX_CANVAS, Session
from warpgs.viewer.training_cameras import TrainingCameras

pytestmark = pytest.mark.usefixtures("contracts_off")
TRAINING = TrainingCameras(capture([0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.25, 0.5, 0.75, 1.0]))


def panel(**values):
    """A panel whose controls have values as a browser sent them."""
    made = Panel.__new__(Panel)
    for name, value in values.items():
        setattr(made, name, SimpleNamespace(value=value))
    return made


def session(canvas=(900, 700), **controls):
    """A session that renders nothing, with a canvas and a panel as the browser claims them."""
    made = Session.__new__(Session)
    camera = SimpleNamespace(image_width=canvas[0], image_height=canvas[1])
    made._client = SimpleNamespace(camera=camera, scene=Scene())
    made._changing = threading.Lock()
    made._pose = lambda: Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
    made.panel = panel(**controls)
    return made


@pytest.fixture(autouse=True)
def _without_pictures(monkeypatch):
    monkeypatch.setattr(TRAINING, "picture", lambda _: None)


class Scene:
    """What is drawn into it."""

    def __init__(self):
        self.drawn = []

    def add_camera_frustum(self, name, *_, **__):
        self.drawn.append(name)
        return SimpleNamespace(on_click=lambda _: None)

    def remove_by_name(self, name):
        self.drawn = [other for other in self.drawn if not other.startswith(name)]


@pytest.mark.parametrize(
    ("claimed", "canvas"),
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
def test_no_canvas_is_larger_than_a_screen(claimed, canvas):
    assert session(claimed)._canvas() == canvas
    assert canvas[0] <= MAX_CANVAS[0]
    assert canvas[1] <= MAX_CANVAS[1]


@pytest.mark.parametrize("size", [(1, 10**6), (10**6, 1), (900, 700)])
def test_a_keyframe_has_a_size_that_can_be_rendered(size):
    camera = session(size, width=10**9, time=0.5)._look()
    assert 1 <= camera.width <= 1920
    assert 1 <= camera.height <= MAX_ASPECT * 1920


@pytest.mark.parametrize(
    ("sent", "moment", "pace", "across"),
    [
        (0.5, 0.5, 0.5, 160),
        (-1.0, 0.0, 0.1, 160),
        (1e9, 1.0, 4.0, 1920),
        (math.inf, 1.0, 4.0, 1920),
        (math.nan, 0.0, 0.1, 160),
    ],
)
def test_sliders_are_within_their_ends_whatever_is_sent(sent, moment, pace, across):
    told = panel(time=sent, speed=sent, width=sent)
    assert (told.moment, told.pace, told.across) == (moment, pace, across)


def test_training_cameras_are_drawn_while_the_panel_says_so():
    here = session(show_cameras=True)
    here._show_cameras(TRAINING)
    assert here._client.scene.drawn == [f"/training/{k}" for k in TRAINING.spread()]
    here.panel.show_cameras.value = False
    here._show_cameras(TRAINING)
    assert here._client.scene.drawn == []


def test_cameras_that_are_switched_off_while_they_are_drawn_are_not_left(monkeypatch):
    here = session(show_cameras=True)
    asked = []

    def slow_picture(number):
        asked.append(number)
        here.panel.show_cameras.value = len(asked) < 3

    monkeypatch.setattr(TRAINING, "picture", slow_picture)
    here._show_cameras(TRAINING)
    assert len(asked) == 3
    assert here._client.scene.drawn == []


def test_an_event_of_before_draws_nothing():
    """The last thing that was clicked counts, whichever thread comes first."""
    here = session(show_cameras=False)
    here._show_cameras(TRAINING)
    assert here._client.scene.drawn == []


def test_events_wait_for_each_other():
    here = session(show_cameras=True)
    with here._changing:
        other = threading.Thread(target=here._show_cameras, args=(TRAINING,))
        other.start()
        other.join(0.2)
        assert here._client.scene.drawn == []
    other.join()
    assert here._client.scene.drawn


def test_a_path_has_a_largest_number_of_keyframes(tmp_path, monkeypatch):
    monkeypatch.setattr(path_editor, "MAX_KEYFRAMES", 2)
    button = SimpleNamespace(on_click=lambda _: None)
    controls = SimpleNamespace(
        add_keyframe=button, remove_keyframe=button, save_path=button, path_note=SimpleNamespace()
    )
    camera = camera_of(Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0), (64, 48), 0.0)
    editor = PathEditor(Scene(), controls, tmp_path, lambda: camera, 0.1)
    for _ in range(3):
        editor._add()
    assert len(editor.cameras) == 2
    assert controls.path_note.content == "a path has at most 2 keyframes"
