"""The page in another page, by ``<iframe>``, and the options in its address."""

import pytest
import torch

from tests.export import scenes
from tests.export.browser import Browser, executable, served
from tests.export.test_page import start
from tests.export.test_player import click, expected, press, psnr, shown
from warpgs.cameras import Camera
from warpgs.export.baking import bake
from warpgs.export.page import write_page
from warpgs.video.camera_paths import evenly_spaced
from warpgs.visualize.images import to_bytes

pytestmark = pytest.mark.skipif(executable() is None, reason="the test needs Chromium")

SIZE = (320, 240)
OUTER = """<!doctype html><body style="margin: 0; height: 2000px">
<iframe src="scene.html?autoplay=0&controls=0&time=0.5" width="320" height="240" style="border: 0; display: block">
</iframe>
<script>keys = []; addEventListener('keydown', (event) => keys.push(event.key));</script>"""
INNER = "frames[0].document"
SETTLED = f"{INNER}.body?.dataset.state === 'settled'"
CLOCK = f"{INNER}.getElementById('clock').textContent"
PLAYING = f"{INNER}.getElementById('play').textContent === 'pause'"


@pytest.fixture(scope="module")
def baked(clouds):
    return bake(clouds.at, evenly_spaced(5))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, baked):
    folder = tmp_path_factory.mktemp("site")
    write_page(folder / "scene.html", baked, start(track=True))
    (folder / "outer.html").write_text(OUTER)
    return folder


@pytest.fixture(scope="module")
def address(folder):
    with served(folder) as address:
        yield address


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("profile"), *SIZE) as browser:
        yield browser


@pytest.fixture
def outer(browser, address):
    browser.open(f"{address}outer.html")
    browser.until(f"document.readyState === 'complete' && frames.length && ({SETTLED})")
    return browser


def wheel(browser):
    browser.call("Input.dispatchMouseEvent", type="mouseWheel", x=160, y=120, deltaX=0, deltaY=100)


def test_an_embedded_page_shows_the_time_of_its_address_alone(outer, baked):
    assert outer.value(CLOCK) == "2.00 / 4.0 s"
    assert psnr(outer.screenshot(), expected(baked.at(0.5))) > 40


def test_before_a_click_the_outer_page_has_the_keys_and_the_wheel(outer):
    press(outer, " ", " ")
    wheel(outer)
    outer.until("scrollY > 0")
    assert outer.value("keys.length === 1")
    assert not outer.value(PLAYING)


def test_after_a_click_the_embedded_page_has_them(outer):
    image = outer.screenshot()
    click(outer, "document.querySelector('iframe')")
    wheel(outer)
    outer.value(f"delete {INNER}.body.dataset.state")
    outer.until(SETTLED)
    assert psnr(outer.screenshot(), image) < 35
    press(outer, " ", " ")
    outer.until(PLAYING)
    assert outer.value("scrollY === 0 && keys.length === 0")


def test_the_outer_page_sets_the_time_by_the_address_without_loading_again(outer):
    outer.value(f"{INNER}.kept = true, document.querySelector('iframe').src += '#time=0.25'")
    outer.until(f"{CLOCK} === '1.00 / 4.0 s'")
    assert outer.value(f"{INNER}.kept")


@pytest.mark.parametrize("position", [[2.0, -1.0, -2.0], [0.1, -3.0, 0.1]])
def test_the_address_sets_the_camera(browser, folder, baked, position):
    target = [0.1, 0.0, 0.1]
    image = shown(browser, folder / "scene.html", f"time=0.5&camera={','.join(map(str, position + target))}")
    if position[0] == target[0]:  # straight down: as the first view, turned
        assert browser.value("orbit.camera.rotation[0]") == pytest.approx([1.0, 0.0, 0.0])
        return
    up = torch.tensor([0.0, -1.0, 0.0])
    camera = Camera.looking_at(torch.tensor(position), torch.tensor(target), up, 60.0 * SIZE[0] / 64, SIZE, 0.5)
    assert psnr(image, to_bytes(scenes.image(baked.at(0.5), camera))) > 40


@pytest.mark.parametrize("camera", ["1,2,3", "1,2,3,4,5,x", "1,2,3,1,2,3", ""])
def test_a_camera_that_is_none_is_ignored(browser, folder, baked, camera):
    assert psnr(shown(browser, folder / "scene.html", f"time=0.5&camera={camera}"), expected(baked.at(0.5))) > 40


def test_the_link_opens_the_same_view_and_time(browser, folder):
    shown(browser, folder / "scene.html", "time=0.3")
    browser.value("delete document.body.dataset.state, rotate(0.4, 0.2), pan(0.1, 0), zoom(0.7)")
    browser.until("document.body.dataset.state === 'settled'")
    first = browser.screenshot()
    browser.value("element('link').click()")
    options = browser.value("location.hash.slice(1)")
    assert "autoplay=0&time=0.3" in options
    assert psnr(shown(browser, folder / "scene.html", options), first) > 45
