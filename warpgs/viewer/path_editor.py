"""The keyframes that one browser collects."""

import threading
from collections.abc import Callable
from pathlib import Path

import viser

from warpgs.cameras import Camera
from warpgs.video import keyframes

from .frustums import ORANGE, add_frustum
from .panel import Panel, plain
from .pose import camera_of, pose_of

MAX_KEYFRAMES = 1000


class PathEditor:
    """Adds, removes and saves keyframes as the panel's buttons say.

    Args:
        scene: Where keyframes are drawn.
        panel: Whose buttons they are.
        run: Run folder to save into.
        look: The camera as it is now.
        scale: Size to draw keyframes at [scene units].
    """

    def __init__(
        self, scene: viser.SceneApi, panel: Panel, run: Path, look: Callable[[], Camera], scale: float
    ) -> None:
        self._scene, self._panel, self._run, self._look, self._scale = scene, panel, run, look, scale
        self._changing = threading.Lock()  # every click comes on a thread of its own
        self.cameras: list[Camera] = []
        panel.add_keyframe.on_click(lambda _: self._add())
        panel.remove_keyframe.on_click(lambda _: self._remove())
        panel.save_path.on_click(lambda _: self._save())

    def _add(self) -> None:
        seen = self._look()
        pose = pose_of(seen)
        even = (max(2, seen.width & ~1), max(2, seen.height & ~1))  # video codecs want even sizes
        with self._changing:
            if len(self.cameras) >= MAX_KEYFRAMES:
                self._panel.path_note.content = f"a path has at most {MAX_KEYFRAMES} keyframes"
                return
            size = self.cameras[0].size if self.cameras else even  # a film has one
            self.cameras.append(camera_of(pose, size, seen.time))
            add_frustum(self._scene, self._name(), pose, size[0] / size[1], self._scale, ORANGE)
            self._panel.path_note.content = self._count()

    def _remove(self) -> None:
        with self._changing:
            if self.cameras:
                self._scene.remove_by_name(self._name())
                self.cameras.pop()
            self._panel.path_note.content = self._count()

    def _save(self) -> None:
        try:
            with self._changing:  # two clicks would have one name
                path = keyframes.path_of(self._run, self._panel.path_name.value)
                keyframes.write_path(path, self.cameras)
        except (ValueError, OSError) as error:
            self._panel.path_note.content = plain(str(error))
        else:
            self._panel.path_note.content = plain(f"{self._count()} saved as {path}")

    def _name(self) -> str:
        return f"/keyframes/{len(self.cameras)}"

    def _count(self) -> str:
        count = len(self.cameras)
        return f"{count or 'no'} keyframe{'' if count == 1 else 's'}"
