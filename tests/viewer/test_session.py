"""Values from a browser are checked, and its events may arrive in any order."""

import math
import signal
from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

import threading

from tests.video.test_camera_paths import capture
from warpgs.viewer import path_editor
from warpgs.viewer.adaptive_resolution import AdaptiveResolution
from warpgs.viewer.browser_camera import through_training_camera
from warpgs.viewer.canvas import MAX_ASPECT, MAX_CANVAS
from warpgs.viewer.clock import Clock
from warpgs.viewer.layers import LAYERS
from warpgs.viewer.panel import Panel
from warpgs.viewer.path_editor import PathEditor
from warpgs.viewer.pose import Pose, camera_of
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


class Scene:
    """Records the names of its objects."""

    def __init__(self):
        self.names = []

    def add_camera_frustum(self, name, *_, **__):
        self.names.append(name)
        return SimpleNamespace(on_click=lambda _: None)

    def remove_by_name(self, name):
        self.names = [other for other in self.names if not other.startswith(name)]


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
    here._source = SimpleNamespace(current=object)
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


class Control:
    """A control: a value, options, a text, and handlers that are called when the value is set, as viser's are."""

    def __init__(self, value=None):
        self._value, self.options, self.content, self._handlers = value, (), "", []

    @property
    def value(self):
        return self._value

    @value.setter
    def value(self, value):
        self._value = value
        for handler in self._handlers:
            handler(None)

    def on_update(self, handler):
        self._handlers.append(handler)

    def on_click(self, handler):
        self.click = lambda: handler(None)


class Browser:
    """A browser's camera."""

    def __init__(self):
        self.at = camera_at(0.0)

    def current_camera(self):
        return self.at

    def go_to(self, camera):
        self.at = camera


def camera_at(x):
    return camera_of(Pose((1.0, 0.0, 0.0, 0.0), (x, 0.0, 0.0), 1.0), (64, 48), 0.5)


def positions(cameras):
    return [pytest.approx(camera.position[0].item(), abs=1e-6) for camera in cameras]


CONTROLS = ("saved", "name", "selected", "add", "replace", "remove", "preview", "save", "render", "note")


@pytest.fixture
def editor(tmp_path):
    controls = SimpleNamespace(**{name: Control("path") for name in CONTROLS})
    run = SimpleNamespace(folder=tmp_path, device=torch.device("cpu"))
    made = PathEditor(Scene(), controls, run, Browser(), 0.1, TRAINING.capture)
    made.click = lambda name: getattr(controls, name).click()
    made.controls, made.browser = controls, made._browser
    return made


def add(editor, *positions):
    for x in positions:
        editor.browser.at = camera_at(x)
        editor.click("add")


def test_the_number_of_keyframes_is_limited(editor, monkeypatch):
    monkeypatch.setattr(path_editor, "MAX_KEYFRAMES", 2)
    add(editor, 0.0, 1.0, 2.0)
    assert len(editor.cameras) == 2
    assert editor.controls.note.content == "a path has at most 2 keyframes"


def test_keyframes_are_inserted_behind_the_selected_one_replaced_and_removed(editor):
    add(editor, 0.0, 2.0)
    editor.controls.selected.value = "1"
    add(editor, 1.0)
    assert positions(editor.cameras) == [0.0, 1.0, 2.0]
    assert editor.controls.selected.value == "2"
    assert editor._scene.names == ["/keyframes/1", "/keyframes/2", "/keyframes/3"]
    editor.browser.at = camera_at(1.5)
    editor.click("replace")
    assert positions(editor.cameras) == [0.0, 1.5, 2.0]
    editor.click("remove")
    assert positions(editor.cameras) == [0.0, 2.0]


def test_selecting_a_keyframe_goes_to_it(editor):
    add(editor, 0.0, 2.0)
    editor.controls.selected.value = "1"
    assert positions([editor.browser.at]) == [0.0]


@pytest.mark.parametrize("sent", ["-3", "9" * 30, "x", None, 7])
def test_the_selected_keyframe_always_exists(editor, sent):
    add(editor, 0.0, 2.0)
    editor.controls.selected._value = sent
    assert -1 <= editor.selected < 2


def test_a_saved_path_is_listed_and_loaded(editor):
    add(editor, 0.0, 2.0)
    editor.controls.name.value = "around"
    editor.click("save")
    assert editor.controls.saved.options == ("(new path)", "around")
    editor.click("remove")
    editor.click("remove")
    assert editor.cameras == []
    editor.controls.saved.value = "around"
    assert positions(editor.cameras) == [0.0, 2.0]
    assert positions([editor.browser.at]) == [0.0]
    assert editor.controls.name.value == "around"


@pytest.mark.parametrize("sent", ["../../etc/passwd", "missing", None])
def test_only_paths_of_the_run_are_loaded(editor, sent):
    editor.controls.saved.value = sent
    assert editor.cameras == []


def test_a_damaged_path_is_reported(editor):
    file = editor._run.folder / "paths" / "bad.json"
    file.parent.mkdir()
    file.write_text("{}")
    editor.controls.saved.value = "bad"
    assert "has no list of keyframes" in editor.controls.note.content.replace("\\", "")


def test_a_preview_moves_along_the_path(editor, monkeypatch):
    seen = []
    monkeypatch.setattr(path_editor, "PREVIEW_SECONDS", 0.5)
    monkeypatch.setattr(editor.browser, "go_to", lambda camera: seen.append(camera))
    add(editor, 0.0, 2.0)
    seen.clear()
    editor.click("preview")
    assert len(seen) == 12
    assert positions([seen[0], seen[-1]]) == [0.0, 2.0]


def test_a_second_click_ends_the_preview(editor, monkeypatch):
    seen = []

    def go_to(camera):
        seen.append(camera)
        if len(seen) == 3:
            assert editor.controls.preview.label == "End preview"
            editor.click("preview")

    add(editor, 0.0, 2.0)
    monkeypatch.setattr(editor.browser, "go_to", go_to)
    editor.click("preview")
    assert len(seen) == 3
    assert editor.controls.preview.label == "Preview"
    monkeypatch.setattr(path_editor, "PREVIEW_SECONDS", 0.2)
    editor.click("preview")
    assert len(seen) == 3 + 5


def test_a_preview_ends_with_the_browser(editor, monkeypatch):
    seen = []
    add(editor, 0.0, 2.0)
    monkeypatch.setattr(editor.browser, "go_to", lambda camera: (seen.append(camera), editor.stop()))
    editor.click("preview")
    assert len(seen) == 1


def test_a_video_is_rendered_by_the_command(editor, monkeypatch):
    """The command runs in a process of its own, and what it prints is shown."""
    commands, signals = [], []

    class Child:
        returncode = 0

        def __init__(self, command, **_):
            commands.append(command)

        def communicate(self):
            return "wrote video.mp4\n", ""

        def send_signal(self, number):
            signals.append(number)

    monkeypatch.setattr(path_editor.subprocess, "Popen", Child)
    add(editor, 0.0, 2.0)
    editor.click("render")
    (command,) = commands
    assert command[1:5] == ["-m", "warpgs", "render", str(editor._run.folder)]
    assert command[command.index("--device") + 1] == "cpu"
    assert (editor._run.folder / "paths" / "path.json").is_file()
    assert editor.controls.note.content == "wrote video.mp4"
    editor.stop()
    assert signals == [signal.SIGINT]


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
