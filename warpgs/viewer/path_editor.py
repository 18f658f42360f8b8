"""The keyframes that one browser collects."""

import threading
from collections.abc import Callable
from pathlib import Path

import viser

from warpgs.cameras import Camera
from warpgs.video import keyframes

from .frustums import ORANGE, add_frustum
from .panel import Panel, escape
from .pose import camera_of, pose_of

MAX_KEYFRAMES = 1000


class PathEditor:
    """Adds, removes and saves keyframes with the buttons of a panel.

    Args:
        scene: Scene of the browser, which shows the keyframes.
        panel: Panel of the browser.
        run: Run folder to save into.
        current_camera: Returns the camera of the browser.
        scale: Size of the keyframes in the scene [scene units].
    """

    def __init__(
        self, scene: viser.SceneApi, panel: Panel, run: Path, current_camera: Callable[[], Camera], scale: float
    ) -> None:
        self._scene, self._panel, self._run, self._scale = scene, panel, run, scale
        self._current_camera = current_camera
        self._lock = threading.Lock()  # each click is handled on its own thread
        self.cameras: list[Camera] = []
        panel.add_keyframe.on_click(lambda _: self._add())
        panel.remove_keyframe.on_click(lambda _: self._remove())
        panel.save_path.on_click(lambda _: self._save())

    def _add(self) -> None:
        camera = self._current_camera()
        pose = pose_of(camera)
        even = (max(2, camera.width & ~1), max(2, camera.height & ~1))  # video codecs need even sizes
        with self._lock:
            if len(self.cameras) >= MAX_KEYFRAMES:
                self._panel.path_note.content = f"a path has at most {MAX_KEYFRAMES} keyframes"
                return
            size = self.cameras[0].size if self.cameras else even  # all frames of a video have one size
            self.cameras.append(camera_of(pose, size, camera.time))
            add_frustum(self._scene, self._last_name(), pose, size[0] / size[1], self._scale, ORANGE)
            self._panel.path_note.content = self._count()

    def _remove(self) -> None:
        with self._lock:
            if self.cameras:
                self._scene.remove_by_name(self._last_name())
                self.cameras.pop()
            self._panel.path_note.content = self._count()

    def _save(self) -> None:
        try:
            with self._lock:  # otherwise two clicks could choose the same file
                path = keyframes.path_of(self._run, self._panel.path_name.value)
                keyframes.write_path(path, self.cameras)
        except (ValueError, OSError) as error:
            self._panel.path_note.content = escape(str(error))
        else:
            self._panel.path_note.content = escape(f"{self._count()} saved as {path}")

    def _last_name(self) -> str:
        return f"/keyframes/{len(self.cameras)}"

    def _count(self) -> str:
        count = len(self.cameras)
        return f"{count or 'no'} keyframe{'' if count == 1 else 's'}"
