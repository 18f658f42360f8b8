"""The page in a browser: it shows what the renderer shows."""

import dataclasses

import cv2
import numpy as np
import pytest
import torch

from tests.export import scenes
from tests.export.browser import Browser, executable
from tests.export.test_page import FILMED, start
from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.export.baking import bake
from warpgs.export.page import write_page
from warpgs.rendering import render
from warpgs.video.camera_paths import evenly_spaced
from warpgs.video.filmed import DRAG_LIMIT
from warpgs.visualize.images import to_bytes

pytestmark = pytest.mark.skipif(executable() is None, reason="the test needs Chromium")

SIZE = (320, 240)  # five times the image size of the page's intrinsics
SETTLED = "document.body?.dataset.state === 'settled'"
FOLLOWS = "document.getElementById('follow').checked"
NOTED = "!document.getElementById('outside').hidden"
ENDED = "['settled', 'failed'].includes(document.body?.dataset.state)"


@pytest.fixture(scope="module")
def baked(clouds):
    weights = np.geomspace(1.0, 100.0, len(clouds.at(0.0)))  # different steps
    return bake(clouds.at, evenly_spaced(5), weights=weights.astype(np.float32))


@pytest.fixture(scope="module")
def page(tmp_path_factory, baked):
    path = tmp_path_factory.mktemp("page") / "scene.html"
    write_page(path, baked, start(track=True))
    return path


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile"), *SIZE) as browser:
        yield browser


def shown(browser, page, options):
    browser.open(f"file://{page}#play=0&controls=0&{options}")
    browser.until(ENDED)
    assert browser.value("document.body.dataset.state") == "settled"
    return browser.screenshot()


def expected(cloud):
    camera = scenes.camera(*SIZE)
    return to_bytes(scenes.image(cloud, camera))


def psnr(a, b):
    return 10 * np.log10(255**2 / np.square(a.astype(float) - b).mean())


@pytest.mark.parametrize("time", [0.0, 0.6, 1.0])
def test_the_page_shows_the_image_of_the_renderer(browser, page, baked, time):
    assert psnr(shown(browser, page, f"time={time}"), expected(baked.at(time))) > 40


def test_alphas_are_clamped_as_in_the_renderer(browser, baked, tmp_path):
    write_page(tmp_path / "scene.html", baked, dataclasses.replace(start(), max_alpha=0.3))
    image = shown(browser, tmp_path / "scene.html", "time=0.5")
    settings, cloud = RenderSettings(max_alpha=0.3), baked.at(0.5)
    wanted = render(cloud.splats(), scenes.camera(*SIZE), settings=settings).joint.image
    assert psnr(image, to_bytes(wanted)) > 40
    assert psnr(image, expected(cloud)) < 35


@pytest.mark.parametrize("layer", ["static", "dynamic"])
def test_the_page_shows_a_single_layer(browser, page, baked, layer):
    cloud = baked.at(0.25)
    alone = cloud.select(cloud.is_dynamic == (layer == "dynamic"))
    assert psnr(shown(browser, page, f"time=0.25&layers={layer}"), expected(alone)) > 40


def test_the_page_requests_nothing_and_reports_no_errors(browser, page):
    browser.events.clear()
    shown(browser, page, "time=0.5")
    browser.value("0")
    assert {address.split(":")[0] for address in browser.requests()} == {"file", "blob"}
    assert browser.errors() == []


def test_moving_the_camera_changes_the_image_and_reset_restores_it(browser, page):
    first = shown(browser, page, "time=0.5")
    for move in ("rotate(0.4, 0.2)", "pan(0.1, 0)", "zoom(0.7)"):
        browser.value(f"delete document.body.dataset.state, {move}")
        browser.until(SETTLED)
        assert psnr(browser.screenshot(), first) < 35
        assert not browser.value(FOLLOWS)
        browser.value("delete document.body.dataset.state, home()")
        browser.until(SETTLED)
        assert (browser.screenshot() == first).all()
        assert browser.value(FOLLOWS)


def test_the_page_plays_along_the_training_cameras(browser, baked, tmp_path):
    first = start().viewmat
    last = [[*row[:3], row[3] - 1.0] if k == 0 else row for k, row in enumerate(first)]  # one unit to the right
    write_page(tmp_path / "moving.html", baked, dataclasses.replace(start(), track=[first, last]))
    shown(browser, tmp_path / "moving.html", "time=0")
    before = np.array(browser.value("orbit.camera.position"))
    browser.value("toggle()")
    browser.until("state.time > 0.2")
    browser.value("toggle()")
    time, position = browser.value("[state.time, currentCamera().position]")
    assert position - before == pytest.approx([time, 0.0, 0.0], abs=1e-4)
    shown(browser, tmp_path / "moving.html", "time=1&follow=0")
    assert browser.value("orbit.camera.position") == pytest.approx(before)


def test_a_view_that_leaves_what_was_filmed_says_so_and_stays_near(browser, baked, tmp_path):
    write_page(tmp_path / "filmed.html", baked, start(track=True, filmed=FILMED))
    shown(browser, tmp_path / "filmed.html", "time=0.5")
    assert not browser.value(NOTED)
    browser.value("for (let k = 0; k < 100; k++) rotate(0.05, 0)")
    browser.until(NOTED)
    assert 1 < browser.value("outsideOf(FILMED, orbit.camera)") <= DRAG_LIMIT
    browser.value("home()")
    browser.until(f"!({NOTED})")


def test_an_orbited_view_matches_the_renderer(browser, page, baked):
    shown(browser, page, "time=0.5")
    browser.value("delete document.body.dataset.state, rotate(0.7, -0.4)")
    browser.until(SETTLED)
    seen = browser.value("orbit.camera")
    rotation, position = torch.tensor(seen["rotation"]), torch.tensor(seen["position"])
    viewmat = torch.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    assert (rotation @ rotation.T - torch.eye(3)).abs().max() < 1e-5
    camera = Camera(viewmat, scenes.camera(*SIZE).K, *SIZE)
    assert psnr(browser.screenshot(), to_bytes(scenes.image(baked.at(0.5), camera))) > 40


def test_playing_advances_time_and_the_slider_stops_it(browser, page):
    shown(browser, page, "time=0.1")
    browser.value("toggle()")
    browser.until("state.time > 0.11 && document.getElementById('time').value > 0.11")
    browser.value("const slider = document.getElementById('time'); slider.value = 0.75; slider.oninput()")
    browser.until("!state.playing && state.time === 0.75")


def click(browser, selector):
    box = browser.value(
        f"(({{x, y, width, height}}) => [x + width / 2, y + height / 2])({selector}.getBoundingClientRect())"
    )
    for kind in ("mousePressed", "mouseReleased"):
        browser.call("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)


def press(browser, key, text=""):
    code = {"Tab": 9, " ": 32}[key]
    browser.call("Input.dispatchKeyEvent", type="keyDown", key=key, text=text, windowsVirtualKeyCode=code)
    browser.call("Input.dispatchKeyEvent", type="keyUp", key=key, windowsVirtualKeyCode=code)


@pytest.mark.parametrize("control", ["home", "static"])
def test_the_space_bar_plays_after_a_click_on_a_control_and_activates_one_that_was_reached_by_tab(
    browser, page, control
):
    browser.open(f"file://{page}#play=0")
    browser.until(SETTLED)
    click(browser, f"document.getElementById('{control}')")
    browser.until("document.activeElement === document.body")
    was_checked = browser.value("document.getElementById('static').checked")
    assert was_checked == (control != "static")
    press(browser, " ", " ")
    browser.until("state.playing")
    browser.value("document.getElementById('static').focus()")
    press(browser, " ", " ")
    browser.until(f"document.getElementById('static').checked !== {str(was_checked).lower()}")
    assert browser.value("state.playing && document.activeElement.id === 'static'")


def test_another_fragment_in_the_address_is_applied(browser, page):
    shown(browser, page, "time=0.25&layers=static")
    browser.value("location.hash = '#play=0&time=0.5&layers=dynamic'")
    browser.until("state.time === 0.5 && document.getElementById('dynamic').checked")
    assert not browser.value("document.getElementById('static').checked || state.playing")
    browser.value("location.hash = '#time=0.75&layers=mesh'")
    browser.until("state.playing")
    assert browser.value("document.getElementById('static').checked && document.getElementById('dynamic').checked")


def test_a_slow_frame_skips_times_instead_of_slowing_down(browser, page):
    shown(browser, page, "time=0.1")
    advanced = browser.value(
        "(() => { state.playing = true; const start = state.time; frame(before + 800); state.playing = false; "
        "return (state.time - start) * START.seconds; })()"
    )
    assert advanced == pytest.approx(0.8 * float(browser.value("document.getElementById('speed').value")), abs=1e-6)


@pytest.mark.parametrize("time", [0.25, 0.5, 0.75])
def test_a_page_shows_the_dynamic_gaussians_of_each_segment_in_its_time(browser, tmp_path, time):
    clouds = scenes.segmented()
    write_page(tmp_path / "segments.html", bake(clouds.at, evenly_spaced(5), precision=4.0), start())
    image = shown(browser, tmp_path / "segments.html", f"time={time}")
    assert psnr(image, expected(clouds.at(time))) > 36
    assert psnr(image, expected(clouds.at(1.0 - time if time != 0.5 else 0.0))) < 30


@pytest.mark.parametrize(("static", "dynamic"), [(30, 0), (0, 12)])
def test_a_scene_with_one_branch_and_one_key_time_is_shown(browser, tmp_path, static, dynamic):
    baked = bake(scenes.clouds(static, dynamic).at, [0.0])
    write_page(tmp_path / "one.html", baked, start())
    assert psnr(shown(browser, tmp_path / "one.html", "time=0.5"), expected(baked.at(0.0))) > 40


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_view_dependent_colours_match_the_renderer(browser, tmp_path, degree):
    cloud = scenes.cloud(60, degree)
    baked = bake(lambda time: cloud, [0.0])
    write_page(tmp_path / "sh.html", baked, start())
    assert psnr(shown(browser, tmp_path / "sh.html", ""), expected(baked.at(0.0))) > 40


@pytest.mark.parametrize(
    ("part", "value"),
    [("log_scales", -46.0), ("log_scales", 30.0), ("means", 1e3), ("means", 1e30), ("sh", 1e3), ("sh", -1e30)],
)
def test_the_page_shows_the_others_beside_an_extreme_gaussian(browser, tmp_path, clouds, part, value):
    def at(time):
        cloud = clouds.at(time)
        getattr(cloud, part)[[0, -1], 0] = value
        if part != "means":
            cloud.logit_opacities[[0, -1]] = -12.0  # itself it is not seen
        return cloud

    write_page(tmp_path / "extreme.html", bake(at, [0.0]), start())
    others = np.arange(1, len(clouds.at(0.0)) - 1)
    assert psnr(shown(browser, tmp_path / "extreme.html", ""), expected(clouds.at(0.0).select(others))) > 35


def test_a_damaged_page_shows_a_message(browser, page, tmp_path):
    text = page.read_text().replace('id="dynamic-colors">', 'id="dynamic-colors">AAAA')
    (tmp_path / "damaged.html").write_text(text)
    browser.open(f"file://{tmp_path / 'damaged.html'}#play=0")
    browser.until("document.body?.dataset.state === 'failed'")
    assert "could not be shown" in browser.value("document.getElementById('message').textContent")


def test_screenshots_have_the_requested_size(browser, page):
    image = shown(browser, page, "time=0")
    assert image.shape == (SIZE[1], SIZE[0], 3)
    assert cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).max() > 50
