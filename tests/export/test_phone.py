"""The page on a phone: by touch, in portrait, with many pixels."""

import numpy as np
import pytest

from tests.export.browser import Browser, executable
from tests.export.test_page import start
from warpgs.export.baking import bake
from warpgs.export.page import write_page
from warpgs.video.camera_paths import evenly_spaced

pytestmark = pytest.mark.skipif(executable() is None, reason="the test needs Chromium")

SIZE = (390, 844)
RESTS = "pace.idle > REST && document.body.dataset.state === 'settled'"
CENTER = np.array([195.0, 300.0])
APART = np.array([50.0, 0.0])


@pytest.fixture(scope="module")
def phone(tmp_path_factory, clouds):
    folder = tmp_path_factory.mktemp("page")
    write_page(folder / "scene.html", bake(clouds.at, evenly_spaced(5)), start(track=True))
    with Browser(folder / "profile", *SIZE, scale=3, mobile=True) as browser:
        browser.open(f"file://{folder / 'scene.html'}?autoplay=0&time=0.5")
        browser.until("document.body?.dataset.state === 'settled'")
        yield browser


@pytest.fixture
def view(phone):
    phone.value("home()")
    return phone


def drag(phone, *fingers):
    """Moves fingers from their first to their second position."""
    for kind, positions in (("touchStart", 0), ("touchMove", 1), ("touchEnd", None)):
        points = [] if positions is None else [{"x": f[positions][0], "y": f[positions][1]} for f in fingers]
        phone.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    return phone.value("[orbit.rotation[2], orbit.pivot, orbit.distance]")


def test_one_finger_orbits(view):
    forward, pivot, distance = drag(view, (CENTER, CENTER + APART))
    assert abs(forward[0]) > 0.1
    assert pivot == pytest.approx([0, 0, 0], abs=1e-6)
    assert distance == pytest.approx(3)


def test_two_fingers_zoom(view):
    left, right = CENTER - APART, CENTER + APART
    forward, pivot, distance = drag(view, (left, left - APART), (right, right + APART))
    assert distance == pytest.approx(1.5, rel=0.02)
    assert forward == pytest.approx([0, 0, 1], abs=1e-6)
    assert pivot == pytest.approx([0, 0, 0], abs=0.02)


def test_two_fingers_pan(view):
    left, right = CENTER - APART, CENTER + APART
    down = np.array([0.0, 40.0])
    forward, pivot, distance = drag(view, (left, left + down), (right, right + down))
    assert pivot[1] < -0.05
    assert forward == pytest.approx([0, 0, 1], abs=1e-6)
    assert distance == pytest.approx(3, rel=0.1)


def test_the_controls_fit_and_leave_the_scene_visible(phone):
    boxes = phone.value(
        "[...document.querySelectorAll('#controls :is(button, select, label, input[type=range])')]"
        ".map((e) => e.getBoundingClientRect()).filter((box) => box.width)"
        ".map(({left, right, top, bottom}) => [left, right, top, bottom])"
    )
    left, right, top, bottom = np.array(boxes).T
    assert len(boxes) >= 7
    assert left.min() >= 0
    assert right.max() <= SIZE[0]
    assert bottom.max() <= SIZE[1]
    assert top.min() > 0.8 * SIZE[1]
    assert (bottom - top).min() >= 32  # of a finger's size
    assert phone.value("document.documentElement.scrollWidth") == SIZE[0]


def test_at_rest_the_image_has_two_pixels_per_css_pixel(phone):
    phone.until(RESTS)
    assert phone.value("[canvas.width, canvas.height, devicePixelRatio]") == [780, 1688, 3]


PACE = """(() => {{
  Object.assign(pace, {{part: 1, seconds: FAST, idle: Infinity}});
  const parts = [];
  for (let k = 0; k < 60; k++) {{
    state.changed = true;
    parts.push(paced({seconds}));
  }}
  state.changed = false;
  const rest = [];
  for (let k = 0; k < 20; k++) rest.push(paced(1 / 60));
  state.changed = true;
  return [parts, rest, paced(1 / 60)];
}})()"""


@pytest.mark.parametrize(("seconds", "part"), [(1 / 60, 1.0), (1 / 30, 1.0), (1 / 10, 0.4), (2.0, 0.4)])
def test_slow_images_have_fewer_pixels_until_they_rest(phone, seconds, part):
    parts, rest, again = phone.value(PACE.format(seconds=seconds))
    assert (parts[0], parts[-1]) == (1, part)
    assert (rest[0], rest[-1]) == (part, 1)
    assert again == pytest.approx(min(1, 1.25 * part))  # tries more pixels after each rest


def test_one_late_frame_keeps_the_pixels(phone):
    seconds = "k === 30 ? 0.5 : 1 / 60"
    assert set(phone.value(PACE.format(seconds=seconds))[0]) == {1}


def test_a_scene_at_rest_is_neither_sorted_nor_drawn(phone):
    phone.until(RESTS)
    phone.value(
        "calls = 0; for (const [owner, name] of [[worker, 'postMessage'], [gl, 'drawArraysInstanced']]) {"
        "const original = owner[name].bind(owner); owner[name] = (...args) => { calls++; original(...args); }; }"
    )
    phone.value("new Promise((done) => setTimeout(done, 200))")
    assert phone.value("calls") == 0
    phone.value("rotate(0.1, 0)")
    phone.until("calls >= 2")
