"""The editor of camera paths."""

import html
import io
import json
import re
import signal
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from tests.video.test_camera_paths import capture
from tests.viewer.watched import Scene
from warpgs.viewer import path_editor, path_video
from warpgs.viewer.path_controls import PathControls
from warpgs.viewer.path_editor import PathEditor
from warpgs.viewer.pose import Pose, camera_of
from warpgs.viewer.training_cameras import TrainingCameras
from warpgs.viewer.video_options import VideoOptions

pytestmark = pytest.mark.usefixtures("contracts_off")
TRAINING = TrainingCameras(capture([0.0, 0.1, 0.2, 0.3, 0.4], [0.0, 0.25, 0.5, 0.75, 1.0]))


class Control:
    """A control: a value, options, a text, and handlers that are called when the value is set, as viser's are."""

    def __init__(self, value=None):
        self.visible, self._value, self.options, self.content, self._handlers = True, value, (), "", []

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

    def download(self, name, content):
        self.downloaded = name, content


def camera_at(x):
    return camera_of(Pose((1.0, 0.0, 0.0, 0.0), (x, 0.0, 0.0), 1.0), (64, 48), 0.5)


def positions(cameras):
    return [pytest.approx(camera.position[0].item(), abs=1e-6) for camera in cameras]


CONTROLS = ("saved", "name", "selected", "add", "replace", "remove", "preview", "save", "render", "note")
CONTROLS += ("duration", "rate", "size", "progress", "download")


def opened(folder, browser):
    """An editor of a run folder."""
    controls = SimpleNamespace(**{name: Control("path") for name in CONTROLS})
    controls.duration.value, controls.rate.value, controls.size.value = 5.0, 24.0, (64.0, 48.0)
    controls.download.disabled = True
    run = SimpleNamespace(folder=folder, path=folder, device=torch.device("cpu"))
    made = PathEditor(Scene(), controls, run, browser, 0.1, TRAINING.capture)
    made.click = lambda name: getattr(controls, name).click()
    made.controls, made.browser = controls, made._browser
    return made


@pytest.fixture
def editor(tmp_path):
    return opened(tmp_path, Browser())


def note(editor):
    """The text of the note, without its HTML."""
    return html.unescape(re.sub("<[^>]*>", "", editor.controls.note.content))


def add(editor, *positions):
    for x in positions:
        editor.browser.at = camera_at(x)
        editor.click("add")


def test_the_number_of_keyframes_is_limited(editor, monkeypatch):
    monkeypatch.setattr(path_editor, "MAX_KEYFRAMES", 2)
    add(editor, 0.0, 1.0, 2.0)
    assert len(editor.cameras) == 2
    assert note(editor) == "a path has at most 2 keyframes"


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


def files(editor):
    """Names and numbers of keyframes of the saved paths."""
    found = sorted((editor._run.folder / "paths").iterdir())
    return {path.stem: len(json.loads(path.read_text())["keyframes"]) for path in found}


def test_a_path_that_is_saved_again_replaces_its_file(editor):
    add(editor, 0.0)
    editor.click("save")
    add(editor, 1.0)
    editor.click("save")
    assert files(editor) == {"path": 2}
    assert (editor.controls.name.value, editor.controls.saved.value) == ("path", "path")


def test_an_opened_path_is_replaced_when_it_is_saved(editor):
    add(editor, 0.0)
    editor.click("save")
    later = opened(editor._run.folder, Browser())
    later.controls.saved.value = "path"
    add(later, 1.0)
    later.click("save")
    assert files(editor) == {"path": 2}


def test_a_new_path_gets_a_free_name_which_is_shown(editor):
    add(editor, 0.0)
    editor.click("save")
    other = opened(editor._run.folder, Browser())
    assert other.controls.name.value == "path-2"
    other.controls.name.value = "path"
    add(other, 0.0, 1.0)
    other.click("save")
    assert files(editor) == {"path": 1, "path-2": 2}
    assert (other.controls.name.value, other.controls.saved.value) == ("path-2", "path-2")
    assert "path-2.json" in note(other)


def test_a_new_path_is_empty(editor):
    add(editor, 0.0)
    editor.click("save")
    editor.controls.saved.value = "(new path)"
    assert editor.cameras == []
    assert editor._scene.names == []
    assert editor.controls.name.value == "path-2"
    assert note(editor) == "no keyframes"


@pytest.mark.parametrize("choice", ["(new path)", "other"])
def test_keyframes_that_are_not_saved_are_only_dropped_on_the_second_choice(editor, choice):
    editor.controls.name.value = "other"
    add(editor, 5.0)
    editor.click("save")
    editor.controls.saved.value = "(new path)"
    add(editor, 0.0)
    editor.click("save")
    add(editor, 1.0)
    editor.controls.saved.value = choice
    assert positions(editor.cameras) == [0.0, 1.0]
    assert editor.controls.saved.value == "path"
    assert "2 keyframes not saved" in note(editor)
    editor.controls.saved.value = choice
    assert positions(editor.cameras) == ([] if choice == "(new path)" else [5.0])


def test_keyframes_survive_a_reload_without_moving_the_camera(editor):
    add(editor, 0.0)
    editor.click("save")
    add(editor, 1.0)
    after = opened(editor._run.folder, Browser())
    after.browser.at = camera_at(7.0)
    after.restore(editor.state())
    assert positions(after.cameras) == [0.0, 1.0]
    assert positions([after.browser.at]) == [7.0]
    assert [after.controls.selected.value, after.controls.saved.value] == ["2", "path"]
    after.click("save")
    assert files(editor) == {"path": 2}


@pytest.mark.parametrize("sent", ["../../etc/passwd", "missing", None])
def test_only_paths_of_the_run_are_loaded(editor, sent):
    editor.controls.saved.value = sent
    assert editor.cameras == []


def test_a_damaged_path_is_reported(editor):
    file = editor._run.folder / "paths" / "bad.json"
    file.parent.mkdir()
    file.write_text("{}")
    editor.controls.saved.value = "bad"
    assert "has no list of keyframes" in note(editor)


def test_a_preview_moves_along_the_path(editor, monkeypatch):
    seen = []
    editor.controls.duration.value = 0.5
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
    editor.controls.duration.value = 0.2
    editor.click("preview")
    assert len(seen) == 3 + 5


def test_a_preview_ends_with_the_browser(editor, monkeypatch):
    seen = []
    add(editor, 0.0, 2.0)
    monkeypatch.setattr(editor.browser, "go_to", lambda camera: (seen.append(camera), editor.stop()))
    editor.click("preview")
    assert len(seen) == 1


@pytest.fixture
def started(monkeypatch):
    """Commands that were started, which write a video of a few bytes, and signals that were sent to them."""
    commands, signals = [], []

    class Child:
        returncode = 0
        stdout_text = "wrote video.mp4\n"

        def __init__(self, command, **options):
            commands.append(command)
            assert options["env"]["WARPGS_PROGRESS_LINES"]
            self.stdout, self._ended = io.StringIO(self.stdout_text), False

        @property
        def stderr(self):
            for k in (0, 1, 2):
                yield f"rendering {k}/2\n"
                if during:
                    during.pop()()
                if self.returncode:
                    yield "warpgs render: stopped\n"
                    return
            folder = Path(commands[-1][4]) / "render" / Path(commands[-1][6]).stem
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "video.mp4").write_bytes(b"film")

        def send_signal(self, number):
            signals.append(number)
            self.returncode = 130

        def poll(self):
            return self.returncode if self._ended else None

        def wait(self):
            self._ended = True
            return self.returncode

    during = []
    monkeypatch.setattr(path_video.subprocess, "Popen", Child)
    return SimpleNamespace(commands=commands, signals=signals, during=during)


def test_a_path_that_is_saved_is_rendered_as_it_is(editor, started):
    add(editor, 0.0)
    editor.click("save")
    path = editor._run.folder / "paths" / "path.json"
    text = path.read_text().replace("  ", "")  # as an editor may have left it
    path.write_text(text)
    editor.controls.saved.value = "(new path)"
    editor.controls.saved.value = "path"
    editor.click("render")
    editor.click("render")
    assert files(editor) == {"path": 1}
    assert path.read_text() == text
    assert [command[command.index("--keyframes") + 1] for command in started.commands] == [str(path)] * 2


def test_a_video_has_the_duration_rate_and_size_of_the_controls(editor, started):
    """The command runs in a process of its own, and what it prints is shown."""
    add(editor, 0.0, 2.0)
    editor.controls.duration.value, editor.controls.rate.value, editor.controls.size.value = 2.5, 30.0, (640.0, 361.0)
    editor.click("render")
    (command,) = started.commands
    assert command[1:5] == ["-m", "warpgs", "render", str(editor._run.folder)]
    options = dict(zip(command[5::2], command[6::2], strict=True))
    assert options["--device"] == "cpu"
    assert (options["--frames"], options["--rate"], options["--size"]) == ("75", "30", "640x360")
    assert (editor._run.folder / "paths" / "path.json").is_file()
    assert note(editor) == "wrote video.mp4"
    editor.stop()
    assert started.signals == []  # it has ended


def test_the_progress_of_a_video_is_shown_and_the_video_can_be_downloaded(editor, started):
    shown = []
    editor.controls.progress.on_update(lambda _: shown.append(editor.controls.progress.value))
    editor.click("download")
    assert not hasattr(editor.browser, "downloaded")
    add(editor, 0.0, 2.0)
    started.during.append(lambda: during.append((editor.controls.progress.visible, note(editor))))
    during = []
    editor.click("render")
    assert during == [(True, "rendering path, 120 frames …")]
    assert editor.controls.progress.visible
    assert shown == [0.0, 0.0, 50.0, 100.0]
    assert not editor.controls.download.disabled
    editor.click("download")
    assert editor.browser.downloaded == ("path.mp4", b"film")


def test_no_bar_is_shown_before_a_video_is_rendered():
    gui = MagicMock()
    PathControls(gui)
    gui.add_progress_bar.assert_called_once_with(0.0, visible=False)


def test_a_second_click_cancels_the_video(editor, started):
    add(editor, 0.0, 2.0)
    started.during.append(lambda: (labels.append(editor.controls.render.label), editor.click("render")))
    labels = []
    editor.click("render")
    assert labels == ["Cancel video"]
    assert started.signals == [signal.SIGINT]
    assert len(started.commands) == 1
    assert editor.controls.render.label == "Render video"
    assert note(editor) == "the video was cancelled"
    assert editor.controls.progress.value == 0.0
    assert not editor.controls.progress.visible
    assert editor.controls.download.disabled


def test_a_video_after_one_that_was_cancelled_is_shown_as_complete(editor, started):
    add(editor, 0.0, 2.0)
    started.during.append(lambda: editor.click("render"))
    editor.click("render")
    editor.click("render")
    assert note(editor) == "wrote video.mp4"
    assert editor.controls.progress.value == 100.0
    assert not editor.controls.download.disabled


def test_a_video_ends_with_the_browser(editor, started):
    add(editor, 0.0, 2.0)
    started.during.append(editor.stop)
    editor.click("render")
    assert started.signals == [signal.SIGINT]


def test_no_video_is_begun_after_the_browser_has_left(editor, started):
    add(editor, 0.0, 2.0)
    editor.stop()
    editor.click("render")
    assert started.commands == []


@pytest.mark.parametrize(
    ("duration", "rate", "size", "expected"),
    [
        (2.0, 30.0, (640, 480), (60, 30.0, (640, 480))),
        (0.0, 1e9, (-5, 10**9), (12, 120.0, (16, 4096))),
        (float("nan"), None, "x", (120, 24.0, (1280, 720))),
        ("1", [], (641.0, float("nan")), (120, 24.0, (640, 32))),
        (float("inf"), 1, (16,), (600, 1.0, (1280, 720))),
    ],
)
def test_options_of_a_video_are_within_their_ranges_whatever_a_browser_sends(duration, rate, size, expected):
    options = VideoOptions.of(duration, rate, size)
    assert (options.frames, options.rate, options.size) == expected
