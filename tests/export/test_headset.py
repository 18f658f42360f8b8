"""The page in an emulated headset; skipped without Chromium and the emulator.

``npm install --global iwer`` (Meta's Immersive Web Emulation Runtime). It draws both eyes side by side on the page.
"""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.export import node, scenes
from tests.export.browser import Browser, executable
from tests.export.test_page import FILMED, start
from warpgs.cameras import Camera
from warpgs.export.baking import bake
from warpgs.export.page import write_page
from warpgs.video.camera_paths import evenly_spaced
from warpgs.video.filmed import DRAG_LIMIT
from warpgs.visualize.images import to_bytes

pytestmark = [
    pytest.mark.skipif(executable() is None, reason="the test needs Chromium"),
    pytest.mark.skipif(not node.has("iwer"), reason="iwer is not installed"),
]

SIZE = (320, 160)  # of both eyes
EYE = 0.0315
"""Half the distance of the eyes [m]."""

SETUP = """
;window.device = new IWER.XRDevice(IWER.metaQuest3, {ipd: %g, fovy: %g, stereoEnabled: true});
device.installRuntime({forceInstall: true});
window.inScene = (place) => headset.stage.camera([1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, ...place, 1]).position;
window.between = () => inScene(headset.hands[0].map((v, k) => (v + headset.hands[1][k]) / 2));
window.apart = () => Math.hypot(...addScaled(headset.hands[0], headset.hands[1], -1));
"""
ENTERED = "headset.stage !== null && state.sorted && !state.sorting"
SETTLED = "new Promise((done) => setTimeout(() => done(!state.sorting && sortedFor), 50))"


@pytest.fixture(scope="module")
def baked(clouds):
    return bake(clouds.at, evenly_spaced(5))


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile"), *SIZE) as browser:
        yield browser


@pytest.fixture
def emulated(browser):
    """A browser with an emulated headset."""
    source = (node.packages() / "iwer/build/iwer.min.js").read_text() + SETUP % (2 * EYE, math.pi / 2)
    browser.on_open(source)
    yield browser
    browser.on_open(None)


def opened(browser, folder, baked, start, options="play=0&time=0.5"):
    write_page(folder / "scene.html", baked, start)
    browser.open(f"file://{folder / 'scene.html'}#{options}")
    browser.until("['settled', 'failed'].includes(document.body?.dataset.state)")


def entered(browser, folder, baked, start, options="play=0&time=0.5", button="vr"):
    opened(browser, folder, baked, start, options)
    enter(browser, button)


def enter(browser, button="vr"):
    browser.until(f"!element('{button}').hidden")
    browser.value(f"element('{button}').click()")
    browser.until(ENTERED)


def eyes(browser):
    """The images of the left and the right eye, once the order is that of the head."""
    while browser.value(SETTLED) != browser.value("sortedFor"):
        pass
    image = browser.screenshot()
    half = SIZE[0] // 2
    return image[:, :half], image[:, half:]


def expected(cloud, position, rotation=None):
    """The image of an eye in scene coordinates, of 90° in height."""
    side = SIZE[1]
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.eye(3) if rotation is None else rotation
    viewmat[:3, 3] = -viewmat[:3, :3] @ torch.tensor(position)
    K = torch.tensor([[side / 2, 0.0, side / 2], [0.0, side / 2, side / 2], [0.0, 0.0, 1.0]])
    return to_bytes(scenes.image(cloud, Camera(viewmat, K, side, side)))


def psnr(a, b):
    return 10 * np.log10(255**2 / np.square(a.astype(float) - b).mean())


def test_without_a_headset_the_page_offers_none(browser, baked, tmp_path):
    opened(browser, tmp_path, baked, start())
    assert browser.value("element('vr').hidden && element('ar').hidden")


@pytest.mark.parametrize(("metres", "size"), [(None, 0.5), (2.0, 2.0)])
def test_each_eye_sees_the_image_of_the_renderer(emulated, baked, tmp_path, metres, size):
    entered(emulated, tmp_path, baked, dataclasses.replace(start(), metres=metres))
    for image, side in zip(eyes(emulated), (-1, 1), strict=True):
        wanted = expected(baked.at(0.5), [side * EYE / size, 0.0, -3.0])
        assert psnr(image, wanted) > 38


def test_both_eyes_have_the_order_of_the_head_where_it_goes(emulated, baked, tmp_path):
    entered(emulated, tmp_path, baked, start())
    eyes(emulated)
    emulated.value("device.position.z -= 3, device.quaternion.set(0, 1, 0, 0)")  # 6 units ahead, and turned around
    for image, side in zip(eyes(emulated), (1, -1), strict=True):
        behind = expected(baked.at(0.5), [side * EYE / 0.5, 0.0, 3.0], torch.diag(torch.tensor([-1.0, 1.0, -1.0])))
        assert psnr(image, behind) > 38


def test_the_scene_stands_upright_whatever_the_pitch_of_the_first_view(emulated, baked, tmp_path):
    pitched = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.8, -0.6, 0.0], [0.0, 0.6, 0.8, 3.0], [0.0, 0.0, 0.0, 1.0]]
    opened(emulated, tmp_path, baked, dataclasses.replace(start(), viewmat=pitched))
    emulated.value("device.quaternion.set(0, Math.SQRT1_2, 0, Math.SQRT1_2)")  # to the left when it enters
    enter(emulated)
    rotation, position = emulated.value("Object.values(headset.stage.camera(headset.head))")
    assert np.allclose(rotation, np.eye(3), atol=1e-6)
    assert np.allclose(position, [0.0, -1.8, -2.4], atol=1e-6)


@pytest.mark.parametrize("lying", ["camera", "head"])
def test_the_scene_stands_upright_if_the_first_view_or_the_head_lies_on_its_side(emulated, baked, tmp_path, lying):
    rolled = [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]
    first = dataclasses.replace(start(), viewmat=rolled) if lying == "camera" else start()
    opened(emulated, tmp_path, baked, first)
    if lying == "head":
        emulated.value("device.quaternion.set(0, 0, Math.SQRT1_2, Math.SQRT1_2)")
    enter(emulated)
    level = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
    assert np.allclose(emulated.value(f"headset.stage.camera({level}).rotation"), np.eye(3), atol=1e-6)


def test_a_headset_is_offered_once_there_is_something_to_show(emulated, baked, tmp_path):
    write_page(tmp_path / "scene.html", baked, start())
    setup = emulated._first
    emulated.on_open(
        setup + ";window.read = Response.prototype.arrayBuffer; Response.prototype.arrayBuffer = "
        "function () { return new Promise((done) => { window.go = () => done(read.call(this)); }); };"
    )
    emulated.open(f"file://{tmp_path / 'scene.html'}#play=0")
    emulated.until("typeof window.go === 'function'")
    assert emulated.value("new Promise((done) => setTimeout(() => done(element('vr').hidden), 300))")
    emulated.value("Response.prototype.arrayBuffer = read, go()")
    emulated.until("!element('vr').hidden")
    emulated.on_open(setup)


def test_the_frustum_of_an_eye_need_not_be_symmetric(browser, baked, tmp_path):
    opened(browser, tmp_path, baked, start())
    left, right, bottom, top = -0.9, 0.7, -0.8, 1.1  # at a distance of 1
    projection = np.zeros((4, 4))
    projection[0, [0, 2]] = 2 / (right - left), (right + left) / (right - left)
    projection[1, [1, 2]] = 2 / (top - bottom), (top + bottom) / (top - bottom)
    fx, fy, cx, cy = browser.value(f"intrinsicsOf({projection.T.ravel().tolist()}, {{width: 160, height: 190}})")
    assert [(0 - cx) / fx, (160 - cx) / fx] == pytest.approx([left, right])
    assert [(190 - cy) / fy, (0 - cy) / fy] == pytest.approx([-bottom, -top])


def hold(browser, hand, button, value):
    browser.value(f"device.controllers.{hand}.updateButtonValue('{button}', {value})")


def tilt(browser, hand, right, down):
    browser.value(f"device.controllers.{hand}.updateAxes('thumbstick', {right}, {down})")


def test_the_trigger_plays_and_pauses(emulated, baked, tmp_path):
    entered(emulated, tmp_path, baked, start())
    for playing in ("state.playing", "!state.playing"):
        hold(emulated, "right", "trigger", 1)
        emulated.until(playing)
        hold(emulated, "right", "trigger", 0)
        emulated.value(SETTLED)
    assert emulated.value("state.time") > 0.5


@pytest.mark.parametrize(("right", "reached"), [(1, "state.time === 1"), (-1, "state.time === 0")])
def test_the_right_thumbstick_scrubs_to_the_ends(emulated, baked, tmp_path, right, reached):
    entered(emulated, tmp_path, baked, start())
    emulated.value("toggle()")
    tilt(emulated, "right", right, 0)
    emulated.until(reached)
    assert not emulated.value("state.playing")


def test_a_bar_shows_the_time_while_it_is_changed(emulated, baked, tmp_path):
    entered(emulated, tmp_path, baked, start())
    before = eyes(emulated)
    emulated.value("headset.barUntil = Infinity")
    for image, without in zip(eyes(emulated), before, strict=True):
        rows, columns = np.nonzero((image != without).any(2))
        assert set(rows) <= {104, 105, 106}  # 0.32 m below the head, at a distance of 1 m, for which 80 px are 1 m
        assert np.ptp(columns) + 1 == pytest.approx(32, abs=1)  # 0.4 m wide
        first, last = image[rows[0], columns.min() + 3], image[rows[0], columns.max() - 3]
        assert first.tolist() == [255, 204, 102]  # half full
        assert last.tolist() == [51, 51, 51]
    emulated.value("headset.barUntil = 0")
    assert all((image == without).all() for image, without in zip(eyes(emulated), before, strict=True))


def test_the_left_thumbstick_walks_where_the_head_looks_until_the_view_leaves_what_was_filmed(
    emulated, baked, tmp_path
):
    entered(emulated, tmp_path, baked, start())
    tilt(emulated, "left", 0, -1)
    emulated.until("headset.stage.origin[2] > -2.9")  # forward
    tilt(emulated, "left", 0, 0)
    emulated.value("device.quaternion.set(0, -Math.SQRT1_2, 0, Math.SQRT1_2)")
    emulated.value(SETTLED)
    x, y, z = emulated.value("headset.stage.origin")
    tilt(emulated, "left", 0, -1)  # to the right
    emulated.until(f"headset.stage.origin[0] > {x} + 0.1")
    assert emulated.value("headset.stage.origin.slice(1)") == pytest.approx([y, z], abs=1e-6)


def test_the_thumbsticks_end_near_what_was_filmed(emulated, baked, tmp_path):
    entered(emulated, tmp_path, baked, start(filmed=FILMED))
    tilt(emulated, "left", 1, 0)
    seen = []  # a busy machine may draw no frame between two looks
    while len(seen) < 5 or len(set(seen[-5:])) > 1:
        seen.append(emulated.value(f"{SETTLED}.then(() => headset.stage.origin[0])"))
    assert 0.8 * DRAG_LIMIT < emulated.value("outsideOf(FILMED, headset.stage.camera(headset.head))") <= DRAG_LIMIT


def test_two_hands_that_grip_scale_the_scene_and_one_moves_it(emulated, baked, tmp_path):
    entered(emulated, tmp_path, baked, start())
    emulated.value(
        "device.controllers.left.position.set(-0.1, 1, -0.5), device.controllers.right.position.set(0.1, 1, -0.5)"
    )
    for hand in ("left", "right"):
        hold(emulated, hand, "squeeze", 1)
    emulated.until("headset.hands.length === 2")
    between, apart = emulated.value("between()"), emulated.value("apart()")
    emulated.value("device.controllers.left.position.x = -0.2, device.controllers.right.position.x = 0.2")
    emulated.until(f"apart() > {apart} + 0.15")
    assert emulated.value("headset.stage.metres") == pytest.approx(0.5 * emulated.value("apart()") / apart)
    assert emulated.value("between()") == pytest.approx(between, abs=1e-5)
    hold(emulated, "left", "squeeze", 0)
    emulated.until("headset.hands.length === 1")
    held = emulated.value("inScene(headset.hands[0])")
    emulated.value("device.controllers.right.position.y = 1.3")
    emulated.value(SETTLED)
    assert emulated.value("inScene(headset.hands[0])") == pytest.approx(held, abs=1e-5)
    hold(emulated, "right", "a-button", 1)  # back to the first place and size
    emulated.until("headset.stage.metres === METRES")


def test_leaving_the_headset_returns_to_the_page(emulated, baked, tmp_path):
    opened(emulated, tmp_path, baked, start(), "play=0&controls=0")
    first = emulated.screenshot()
    enter(emulated)
    assert emulated.value("element('vr').textContent") == "leave VR"
    emulated.value("delete document.body.dataset.state, element('vr').click()")
    emulated.until("document.body.dataset.state === 'settled' && !headset.session")
    assert (emulated.screenshot() == first).all()
    assert emulated.errors() == []


def test_behind_the_scene_is_the_background_but_in_ar_the_room(emulated, baked, tmp_path):
    white = dataclasses.replace(start(), background=(1.0, 1.0, 1.0))
    for button, corner in (("vr", 255), ("ar", 0)):
        entered(emulated, tmp_path, baked, white, button=button)
        assert (eyes(emulated)[0][0, 0] == corner).all()


def test_a_headset_that_refuses_leaves_a_message(emulated, baked, tmp_path):
    opened(emulated, tmp_path, baked, start())
    emulated.value("gl.makeXRCompatible = () => Promise.reject(new Error('no device'))")
    emulated.until("!element('vr').hidden")
    emulated.value("element('vr').click()")
    emulated.until("element('message').textContent === 'The headset could not be used: no device'")
    emulated.until("!headset.session && element('vr').textContent === 'enter VR'")
