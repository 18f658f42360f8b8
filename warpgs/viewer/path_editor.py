"""The keyframes that one browser collects: added, edited, previewed, saved, loaded and rendered."""

import operator
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol, runtime_checkable

import viser

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.runs.run import Run
from warpgs.video import keyframes

from .frustums import ORANGE, add_frustum
from .panel import set_value
from .path_controls import DEFAULT_NAME, END_PREVIEW, NEW, PREVIEW, PathControls, note_html
from .path_video import PathVideo
from .pose import camera_of, pose_of
from .video_options import VideoOptions

MAX_KEYFRAMES = 1000
PREVIEW_RATE = 24.0
"""Frames per second of a preview."""

NONE = "none"
"""Entry of the menu of keyframes without any."""


@runtime_checkable
class BrowserView(Protocol):
    """What the editor needs of a browser."""

    def current_camera(self) -> Camera:
        """The camera of the browser, with the time that it shows."""

    def go_to(self, camera: Camera) -> None:
        """Moves the camera of the browser, and its time."""

    def download(self, name: str, content: bytes) -> None:
        """Lets the browser download a file."""


class PathState(NamedTuple):
    """What an editor holds, which survives a reload of its page.

    Attributes:
        cameras: The keyframes.
        selected: Index of the selected one.
        name: Name to save them by.
        opened: Name of the file that was opened or saved last; ``NEW`` without one.
        stored: Its keyframes.
        own: Names of all files that were opened or saved here.
    """

    cameras: list[Camera]
    selected: int
    name: str
    opened: str
    stored: list[Camera]
    own: set[str]


class PathEditor:
    """Does what the controls of camera paths ask for.

    Args:
        scene: Scene of the browser, which shows the keyframes.
        controls: Controls of the browser.
        run: The run, whose folder paths are saved into and whose device renders their videos.
        browser: The browser's camera.
        scale: Size of the keyframes in the scene [scene units].
        capture: Capture whose views paths may name; None if it cannot be read: then paths cannot be loaded.
    """

    def __init__(
        self,
        scene: viser.SceneApi,
        controls: PathControls,
        run: Run,
        browser: BrowserView,
        scale: float,
        capture: Capture | None,
    ) -> None:
        self._scene, self._controls, self._run, self._scale = scene, controls, run, scale
        self._browser, self._capture = browser, capture
        # Each click is handled on its own thread; a control that is set calls its handlers on this one.
        self._lock = threading.RLock()
        self._stopped = threading.Event()
        self._video = PathVideo(controls, run, self._note, browser.download)
        self._preview_ended: threading.Event | None = None  # set to end the preview that runs
        self.cameras: list[Camera] = []
        self._opened = NEW
        self._stored: list[Camera] = []
        self._own: set[str] = set()
        self._warned = ""  # choice of a path that would have dropped keyframes
        self._sets = False  # whether this editor sets its menus, which then are not to be obeyed
        for button, action in (
            (controls.add, self._add),
            (controls.replace, self._replace),
            (controls.remove, self._remove),
            (controls.preview, self._preview),
            (controls.save, self._save),
            (controls.render, self._render),
        ):
            button.on_click(partial(_without_event, action))
        controls.selected.on_update(lambda _: self._go())
        controls.saved.on_update(lambda _: self._choose())
        self._start()

    def stop(self) -> None:
        """Ends a preview and a video that is being rendered."""
        self._stopped.set()
        with self._lock:
            if self._preview_ended is not None:
                self._preview_ended.set()
        self._video.stop()

    # A page that is reloaded ------------------------------------------------------------------------------------------

    def state(self) -> PathState:
        """What this editor holds."""
        with self._lock:
            name = str(self._controls.name.value)
            return PathState(self.cameras, self.selected, name, self._opened, self._stored, self._own)

    def restore(self, state: PathState) -> None:
        """Continues from a state, without moving the camera."""
        with self._lock, self._setting():
            self.cameras, self._opened, self._stored = list(state.cameras), state.opened, list(state.stored)
            self._own = set(state.own)
            self._show(state.selected)
            self._list_saved()
            set_value(self._controls.name, state.name)

    @contextmanager
    def _setting(self) -> Iterator[None]:
        """While this editor sets its menus; other threads wait for the lock, which has to be held."""
        before, self._sets = self._sets, True
        try:
            yield
        finally:
            self._sets = before

    # Keyframes --------------------------------------------------------------------------------------------------------

    @property
    def selected(self) -> int:
        """Index of the selected keyframe; -1 without keyframes."""
        value = self._controls.selected.value
        index = int(value) - 1 if isinstance(value, str) and value.isdecimal() and len(value) < 6 else -1
        return min(index, len(self.cameras) - 1)

    def _add(self) -> None:
        with self._lock:
            if len(self.cameras) >= MAX_KEYFRAMES:
                self._note(f"a path has at most {MAX_KEYFRAMES} keyframes")
                return
            index = self.selected + 1
            self.cameras.insert(index, self._current())
            self._show(index)

    def _replace(self) -> None:
        with self._lock:
            if self.cameras:
                self.cameras[self.selected] = self._current()
            self._show(self.selected)

    def _remove(self) -> None:
        with self._lock:
            index = self.selected
            if self.cameras:
                del self.cameras[index]
            self._show(min(index, len(self.cameras) - 1))

    def _current(self) -> Camera:
        """The camera of the browser; all frames of a video have one size, and codecs need even ones."""
        camera = self._browser.current_camera()
        even = (max(2, camera.width & ~1), max(2, camera.height & ~1))
        return camera_of(pose_of(camera), self.cameras[0].size if self.cameras else even, camera.time)

    def _go(self) -> None:
        with self._lock:
            camera = self.cameras[self.selected] if self.cameras and not self._sets else None
        if camera is not None:
            self._browser.go_to(camera)

    def _show(self, selected: int) -> None:
        """Shows all keyframes in the scene, and in the menu."""
        self._warned = ""
        self._scene.remove_by_name("/keyframes")
        for k, camera in enumerate(self.cameras):
            name = f"/keyframes/{k + 1}"
            add_frustum(self._scene, name, pose_of(camera), camera.width / camera.height, self._scale, ORANGE)
        names = tuple(str(k + 1) for k in range(len(self.cameras))) or (NONE,)
        self._controls.selected.options = names
        set_value(self._controls.selected, names[max(0, selected)])
        self._note(self._count())

    def _count(self) -> str:
        count = len(self.cameras)
        return f"{count or 'no'} keyframe{'' if count == 1 else 's'}"

    def _note(self, text: str) -> None:
        self._controls.note.content = note_html(text)

    # Files ------------------------------------------------------------------------------------------------------------

    def _list_saved(self) -> None:
        """Lists the files, with the opened one chosen."""
        with self._lock, self._setting():
            self._controls.saved.options = names = (NEW, *keyframes.saved_names(self._run.folder))
            set_value(self._controls.saved, self._opened if self._opened in names else NEW)

    def _is_stored(self) -> bool:
        """Whether the keyframes are as they were when their file was opened or saved."""
        return len(self.cameras) == len(self._stored) and all(map(operator.is_, self.cameras, self._stored))

    def _keep(self, name: str) -> None:
        """Remembers that the keyframes are those of a file."""
        self._opened, self._stored = name, list(self.cameras)
        self._own.add(name)
        self._list_saved()
        set_value(self._controls.name, name)

    def _save(self) -> Path | None:
        """Writes the keyframes, if they or their name have changed; only files of this editor are replaced."""
        try:
            with self._lock:  # otherwise two clicks could choose the same file
                name = self._controls.name.value
                path = keyframes.path_of(self._run.folder, name, replaces=name in self._own)
                if name != self._opened or not self._is_stored() or not path.exists():
                    keyframes.write_path(path, self.cameras)
                    self._keep(path.stem)
        except (ValueError, OSError) as error:
            self._note(str(error))
            return None
        self._note(f"{self._count()} saved as {path}")
        return path

    def _choose(self) -> None:
        """Opens the chosen file, or starts a new path; keyframes that are not saved are only dropped if asked twice."""
        with self._lock:
            name = self._controls.saved.value
            if self._sets or name not in (NEW, *keyframes.saved_names(self._run.folder)):  # a browser may send anything
                return
            if self.cameras and not self._is_stored() and self._warned != name:
                self._list_saved()
                self._note(f"{self._count()} not saved: save the path, or choose {name} again to drop them")
                self._warned = name
            elif name == NEW:
                self._start()
            else:
                self._open(name)

    def _start(self) -> None:
        """Starts an empty path, with a name that is free."""
        self.cameras, self._opened, self._stored = [], NEW, []
        self._show(-1)
        self._list_saved()
        set_value(self._controls.name, keyframes.path_of(self._run.folder, DEFAULT_NAME).stem)

    def _open(self, name: str) -> None:
        try:
            if self._capture is None:
                raise ValueError("paths cannot be loaded without the capture")
            cameras, _ = keyframes.read_keyframes(self._run.folder / keyframes.FOLDER / f"{name}.json", self._capture)
        except (ValueError, OSError) as error:
            self._note(str(error))
            self._list_saved()
            return
        self.cameras = cameras[:MAX_KEYFRAMES]
        self._show(0)
        self._keep(name)
        self._browser.go_to(cameras[0])

    def _options(self) -> VideoOptions:
        """Duration, frames per second and size of the video, as the controls say."""
        controls = self._controls
        return VideoOptions.of(controls.duration.value, controls.rate.value, controls.size.value)

    def _render(self) -> None:
        """Saves and renders the path; a second click cancels that."""
        if not self._video.cancel():
            path = self._save()
            if path is not None:
                self._video.render(path, self._options())

    def _preview(self) -> None:
        """Moves the browser's camera along the path; a second click ends that."""
        with self._lock:
            if self._preview_ended is not None:
                self._preview_ended.set()
                return
            if len(self.cameras) < 2:
                self._note("a preview needs two keyframes")
                return
            cameras, self._preview_ended = list(self.cameras), threading.Event()
            ended = self._preview_ended
        self._controls.preview.label = END_PREVIEW
        try:
            times = [float(k) for k in range(len(cameras))]
            for camera in keyframes.along(cameras, times, max(1, round(self._options().duration * PREVIEW_RATE))):
                self._browser.go_to(camera)
                if ended.wait(1.0 / PREVIEW_RATE) or self._stopped.is_set():
                    return
        finally:
            self._controls.preview.label = PREVIEW
            with self._lock:
                self._preview_ended = None


def _without_event(action: Callable[[], object], event: object) -> None:
    action()
