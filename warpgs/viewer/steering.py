"""From where a browser looks: along the training cameras, or as its mouse and keys say, near what was filmed.

While the view follows the training cameras, images are rendered along their path without moving the browser's own
camera: that would take a message per image, and the browser's answers, which are late, would be taken for drags. The
browser's camera catches up where the time stands still, and as soon as the mouse moves it.
"""

import math
import threading
import time as clock
from functools import partial

import numpy as np
import viser
from scipy.spatial.transform import Rotation, Slerp

from warpgs.video.filmed import DRAG_LIMIT, Filmed

from .browser_camera import BrowserCamera, set_camera
from .canvas import canvas_of
from .pose import Pose
from .training_path import TrainingPath

ANSWER_SECONDS = 1.0
"""Time within which a browser answers a new camera [s]; until then it may tell where it was, or is on its way."""

NEAR_DISTANCE, NEAR_ANGLE = 0.05, math.radians(5.0)
"""Distance, relative to the depth of the scene, and angle within which a drag goes on from a new camera [rad]."""

MOVED = 1e-4
"""Distance, relative to the depth of the scene, and angle from which the mouse has moved a camera [rad]."""

MAX_SENT = 16
"""Number of cameras that were sent to a browser and may still be answered."""

PARTS = (0.5, 0.25, 0.125)
"""Parts of a step that are tried where the whole step would lead too far from what was filmed."""


class Steering:
    """Decides from where one browser looks.

    Args:
        handle: The browser's camera.
        path: Path of the training camera; None if it is unknown or jumps from frame to frame.
        filmed: What was filmed; None if that is unknown: then the mouse may go anywhere.
    """

    def __init__(self, handle: viser.CameraHandle, path: TrainingPath | None, filmed: Filmed | None) -> None:
        self._handle, self.path, self._filmed = handle, path, filmed
        self._lock = threading.RLock()
        self._held = self._told = Pose(tuple(handle.wxyz.tolist()), tuple(handle.position.tolist()), float(handle.fov))
        self._sent: list[Pose] = [self._held]  # where the browser may be without its user, the newest last
        self._time: float | None = None  # at which the view was placed
        self._canvas = canvas_of(handle)
        self._is_on_path = self._is_behind = False  # whether the browser's camera has to catch up
        self._is_answered, self._until = True, 0.0  # whether the browser is where it was sent; when it should be
        handle.on_update(self._hear)

    def pose(self, time: float, follows: bool) -> Pose:
        """From where to look at a time in [0, 1]; ``follows`` the training camera if there is a path."""
        with self._lock:
            canvas = canvas_of(self._handle)
            if follows and self.path and (time != self._time or (self._is_on_path and canvas != self._canvas)):
                self._held = self.path.pose(time, canvas[0] / canvas[1])
                self._time, self._canvas, self._is_on_path, self._is_behind = time, canvas, True, True
            if self._is_behind:
                return self._held
            fov = float(self._handle.fov)
            browser = (self._told if self._has_answered() else self._held)._replace(fov=fov)
            self._held = self._bounded(browser)
            if self._held != browser:
                self._send()
            return self._held

    def placed(self, pose: Pose, time: float) -> None:
        """Notes that the browser's camera was placed, for a time in [0, 1]."""
        with self._lock:
            self._held, self._time = pose, time
            self._is_on_path = False
            self._note_sent(pose)

    def is_moved_by_hand(self) -> bool:
        """Whether mouse or keys have moved the browser's camera since it was placed."""
        with self._lock:
            is_late = self._is_answered or clock.monotonic() > self._until
            return is_late and not any(self._is_at(self._told, pose) for pose in self._sent)

    def catch_up(self) -> None:
        """Lets the browser's camera catch up with a view that has followed the training camera."""
        with self._lock:
            if self._is_behind:
                self._send()

    def follow(self) -> None:
        """Goes to the training camera, also if the time stands still."""
        with self._lock:
            self._time = None

    def outside(self) -> float:
        """How far the view is outside of what was filmed; 0 if that is unknown."""
        with self._lock:
            return self._outside(self._held)

    def seen(self) -> BrowserCamera:
        """The view, as a browser takes it."""
        with self._lock:
            handle, pose = self._handle, self._held
            if not self._is_behind:
                return BrowserCamera(handle.position, handle.look_at, handle.up_direction, float(handle.fov))
            target = np.array(pose.position) + self._depth(pose) * _forward(pose)
            return BrowserCamera(np.array(pose.position), target, handle.up_direction, pose.fov)

    @property
    def orientation(self) -> np.ndarray:
        """Quaternion of the view, with its roll."""
        with self._lock:
            return np.array(self._held.wxyz)

    async def _hear(self, handle: viser.CameraHandle) -> None:
        """The browser tells where its camera is; as a coroutine, before anything else can move it."""
        told = Pose(tuple(handle.wxyz.tolist()), tuple(handle.position.tolist()), float(handle.fov))
        with self._lock:
            self._told = told
            if self._is_at(told, self._sent[-1]):
                self._is_answered, self._sent = True, self._sent[-1:]

    def _has_answered(self) -> bool:
        """Whether the browser's camera is where it was sent, or has gone on from there."""
        if not self._is_answered:
            is_old = any(self._is_at(self._told, pose) for pose in self._sent)
            is_late = clock.monotonic() > self._until
            self._is_answered = not is_old and (is_late or self._is_near(self._told, self._held))
        return self._is_answered

    def _note_sent(self, pose: Pose) -> None:
        self._sent = [*self._sent[-MAX_SENT:], self._told, pose]
        self._is_answered, self._until, self._is_behind = False, clock.monotonic() + ANSWER_SECONDS, False

    def _send(self) -> None:
        """Moves the browser's camera to the view."""
        seen = self.seen() if self._is_behind else self._at_the_border()
        self._note_sent(self._held)
        with self._handle.client.atomic():
            set_camera(self._handle, seen)
            self._handle.wxyz = np.array(self._held.wxyz)

    def _at_the_border(self) -> BrowserCamera:
        """The view, orbiting a point as far away as before."""
        handle, position = self._handle, np.array(self._held.position)
        distance = float(np.linalg.norm(handle.look_at - handle.position))
        return BrowserCamera(position, position + distance * _forward(self._held), handle.up_direction, self._held.fov)

    def _bounded(self, browser: Pose) -> Pose:
        """A step from the view towards the browser's camera that does not lead too far from what was filmed."""
        limit = max(DRAG_LIMIT, self._outside(self._held))
        if self._outside(browser) <= limit or not _is_valid(self._held):
            return browser
        steps = map(partial(_between, self._held, browser), PARTS)
        return next((step for step in steps if self._outside(step) <= limit), self._held._replace(fov=browser.fov))

    def _outside(self, pose: Pose) -> float:
        if self._filmed is None or not _is_valid(pose):  # what is not valid is refused where it is rendered
            return 0.0
        return self._filmed.outside(np.array(pose.position), _forward(pose))

    def _depth(self, pose: Pose) -> float:
        return 1.0 if self._filmed is None else self._filmed.depth(np.array(pose.position))

    def _is_at(self, a: Pose, b: Pose) -> bool:
        return _distance(a, b) <= MOVED * self._depth(b) and _angle(a, b) <= MOVED

    def _is_near(self, a: Pose, b: Pose) -> bool:
        return _distance(a, b) < NEAR_DISTANCE * self._depth(b) and _angle(a, b) < NEAR_ANGLE


def _is_valid(pose: Pose) -> bool:
    return all(map(math.isfinite, (*pose.wxyz, *pose.position))) and any(pose.wxyz)


def _rotation(pose: Pose) -> Rotation:
    w, x, y, z = pose.wxyz
    return Rotation.from_quat([x, y, z, w])


def _forward(pose: Pose) -> np.ndarray:
    return _rotation(pose).as_matrix()[:, 2]


def _distance(a: Pose, b: Pose) -> float:
    return math.dist(a.position, b.position)


def _angle(a: Pose, b: Pose) -> float:
    if not (_is_valid(a) and _is_valid(b)):
        return math.inf
    return float((_rotation(a).inv() * _rotation(b)).magnitude())


def _between(a: Pose, b: Pose, part: float) -> Pose:
    rotations = Rotation.concatenate([_rotation(a), _rotation(b)])
    x, y, z, w = Slerp([0.0, 1.0], rotations)(part).as_quat().tolist()
    position = tuple(p + part * (q - p) for p, q in zip(a.position, b.position, strict=True))
    return Pose((w, x, y, z), position, b.fov)
