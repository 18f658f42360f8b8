"""The view follows the training camera until the mouse moves it, and stays near what was filmed."""

import asyncio
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from scipy.spatial.transform import Rotation

from warpgs.video.filmed import DRAG_LIMIT, Filmed
from warpgs.viewer import steering
from warpgs.viewer.pose import Pose
from warpgs.viewer.steering import Steering

pytestmark = pytest.mark.usefixtures("contracts_off")
FILMED = Filmed(np.array([[0.0, 0.0, -3.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([3.0]), np.array([0.4]))


class Handle:
    """The camera of a browser, as viser keeps it: all axes are those of the world."""

    def __init__(self):
        self.wxyz, self.position, self.fov = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, -3.0]), 0.8
        self.look_at, self.up_direction = np.zeros(3), np.array([0.0, -1.0, 0.0])
        self.image_width, self.image_height = 800, 600
        self.client = SimpleNamespace(atomic=nullcontext)

    def on_update(self, heard):
        self._heard = heard

    def tell(self):
        """The browser tells where its camera is."""
        asyncio.run(self._heard(self))

    @property
    def pose(self):
        return Pose(tuple(self.wxyz), tuple(self.position), self.fov)


class Path:
    """A camera that moves to the right while time runs, by a tenth of a unit in all."""

    def pose(self, time, aspect):
        return Pose((1.0, 0.0, 0.0, 0.0), (0.1 * time, 0.0, -3.0), 0.8 / aspect)


@pytest.fixture
def clock(monkeypatch):
    now = SimpleNamespace(seconds=100.0)
    monkeypatch.setattr(steering, "clock", SimpleNamespace(monotonic=lambda: now.seconds))
    return now


@pytest.fixture
def steered(clock):
    made = Steering(Handle(), Path(), FILMED)
    made.placed(made._handle.pose, 0.0)
    made._handle.tell()
    return made


def drag(steered, *position):
    """The browser tells that its camera is elsewhere."""
    steered._handle.position = np.array(position)
    steered._handle.tell()


def test_the_view_follows_the_training_camera_while_the_browser_stays(steered):
    for time in (0.2, 0.7):
        assert steered.pose(time, True).position == pytest.approx((0.1 * time, 0.0, -3.0))
    assert steered._handle.position.tolist() == [0.0, 0.0, -3.0]
    assert not steered.is_moved_by_hand()


def test_the_view_stays_where_it_was_placed_until_time_runs(steered):
    placed = steered._handle.pose._replace(position=(0.03, 0.0, -3.0))
    steered.placed(placed, 0.5)
    assert steered.pose(0.5, True) == placed
    assert steered.pose(0.6, True).position == pytest.approx((0.06, 0.0, -3.0))


def test_the_browser_catches_up_where_time_stands_still(steered):
    steered.pose(0.7, True)
    steered.catch_up()
    assert steered._handle.position == pytest.approx((0.07, 0.0, -3.0))
    assert steered._handle.look_at == pytest.approx((0.07, 0.0, 0.0))


def test_the_mouse_goes_on_from_where_the_view_has_followed_to(steered):
    followed = steered.pose(0.9, True)
    drag(steered, 0.002, 0.0, -3.0)  # of the browser's own camera, which has stayed behind
    assert steered.is_moved_by_hand()
    steered.catch_up()
    drag(steered, 0.4, 0.0, -3.0)  # sent before the browser knew
    assert steered.pose(0.9, False).position == followed.position
    drag(steered, 0.11, 0.0, -3.0)
    assert steered.pose(0.9, False).position == (0.11, 0.0, -3.0)
    drag(steered, 0.4, 0.0, -3.0)
    assert steered.pose(0.9, False).position == (0.4, 0.0, -3.0)


def test_answers_of_the_browser_are_no_drags_however_late_they_are(steered, clock):
    for time in (0.4, 0.5):
        steered.pose(time, True)
        steered.catch_up()
    for x in (0.0, 0.04, 0.05 + 1e-6):  # where it was, and where it was sent to
        clock.seconds += 10.0
        drag(steered, x, 0.0, -3.0)
        assert not steered.is_moved_by_hand()
        assert steered.pose(0.5, True).position == pytest.approx((0.05, 0.0, -3.0), abs=1e-5)
    drag(steered, 0.06, 0.0, -3.0)
    assert steered.is_moved_by_hand()


def test_a_camera_on_its_way_is_no_drag_until_it_should_be_there(steered, clock):
    steered.pose(0.5, True)
    steered.catch_up()
    drag(steered, 0.02, 0.0, -3.0)
    assert not steered.is_moved_by_hand()
    clock.seconds += 2.0
    assert steered.is_moved_by_hand()


def test_a_new_canvas_shows_the_whole_image_of_the_training_camera(steered):
    assert steered.pose(0.5, True).fov == pytest.approx(0.8 / (800 / 600))
    steered._handle.image_width = 400
    assert steered.pose(0.5, True).fov == pytest.approx(0.8 / (400 / 600))


def test_the_mouse_cannot_leave_the_region_around_what_was_filmed(steered):
    for k in range(1, 100):
        drag(steered, *(steered._handle.position + np.array([0.1, 0.02, 0.0])))
        pose = steered.pose(0.0, False)
        assert steered.outside() <= DRAG_LIMIT
        assert steered._handle.position == pytest.approx(pose.position), k
        steered._handle.tell()
    assert steered.outside() > 0.9 * DRAG_LIMIT
    drag(steered, 0.0, 0.0, -3.0)
    assert steered.pose(0.0, False).position == (0.0, 0.0, -3.0)


def test_a_view_that_was_placed_outside_may_only_come_back(steered):
    drag(steered, 9.0, 0.0, -3.0)
    steered.placed(steered._handle.pose, 0.0)
    for x, seen in ((9.0, 9.0), (9.5, 9.0), (9.0, 9.0), (8.0, 8.0)):
        drag(steered, x, 0.0, -3.0)
        assert steered.pose(0.0, False).position == (seen, 0.0, -3.0)


def test_turning_away_is_bounded_too(steered):
    for _ in range(50):
        w, x, y, z = steered._handle.wxyz
        x, y, z, w = (Rotation.from_quat([x, y, z, w]) * Rotation.from_rotvec([0.0, 0.1, 0.0])).as_quat()
        steered._handle.wxyz = np.array([w, x, y, z])
        steered._handle.tell()
        steered.pose(0.0, False)
        steered._handle.tell()
    assert 0.8 * DRAG_LIMIT < steered.outside() <= DRAG_LIMIT


def test_without_training_cameras_the_mouse_may_go_anywhere():
    free = Steering(Handle(), None, None)
    drag(free, 50.0, 0.0, 0.0)
    assert free.pose(0.5, True).position == (50.0, 0.0, 0.0)
    assert free.outside() == 0.0


@pytest.mark.parametrize("position", [(np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0)])
def test_a_camera_that_is_not_finite_does_not_stay(steered, position):
    drag(steered, *position)
    steered.pose(0.0, False)
    drag(steered, 0.1, 0.0, -3.0)
    assert steered.pose(0.0, False).position == (0.1, 0.0, -3.0)
