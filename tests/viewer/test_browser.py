"""The viewer in a real browser: the controls change the image."""

import json
import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")
sync_api = pytest.importorskip(
    "playwright.sync_api", reason="browser tests need playwright: pip install -e '.[browser]'"
)

from tests.viewer import watched  # noqa: E402
from tests.viewer.watched import until  # noqa: E402
from warpgs.runs.trained import TrainedScene  # noqa: E402
from warpgs.runtime import graphs  # noqa: E402
from warpgs.video.filmed import DRAG_LIMIT  # noqa: E402
from warpgs.viewer import source as source_module  # noqa: E402
from warpgs.viewer.layers import render_layer  # noqa: E402
from warpgs.viewer.pose import camera_of, pose_of  # noqa: E402
from warpgs.viewer.serve import training_cameras  # noqa: E402
from warpgs.viewer.server import Viewer  # noqa: E402
from warpgs.viewer.source import open_source  # noqa: E402

# viser warns of messages to browsers that have disconnected; the command ignores these warnings, too.
pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection:UserWarning")

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
ARGUMENTS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run"]
ARGUMENTS += [f"--disable-{part}" for part in ("background-networking", "component-update", "sync", "quic")]
SIZE = {"width": 900, "height": 700}
LEFT, ABOVE = 480, 560
"""Columns and rows of the image that are compared; the panel lies beside it, the timeline over its lower end [px]."""


CANVAS_WIDTH = "document.querySelector('canvas').getBoundingClientRect().width"


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        own = playwright.chromium.executable_path
        found = own if Path(own).exists() else next(filter(None, map(shutil.which, BROWSERS)), None)
        if found is None:
            pytest.skip("there is no Chromium: playwright install chromium, or apt-get install chromium")
        browser = playwright.chromium.launch(executable_path=found, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def viewer(run):
    source_module.POLL_SECONDS, before = 0.2, source_module.POLL_SECONDS
    source = open_source(run, "cpu", True)
    with Viewer(source, training_cameras(source, pytest.fail), "127.0.0.1", 0) as viewer:
        yield viewer
    source_module.POLL_SECONDS = before


@pytest.fixture(scope="module")
def visit(browser, viewer):
    """The page and the addresses that it requested."""
    page, asked = browser.new_page(viewport=SIZE), []
    page.set_default_timeout(60_000)
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"http://127.0.0.1:{viewer.port}")
    page.get_by_text("Training cameras").wait_for()
    until(lambda: viewer.sessions)
    page.locator(".mantine-Notification-closeButton").first.click()  # "software rendering"
    return page, asked


@pytest.fixture
def page(visit):
    return visit[0]


@pytest.fixture
def session(visit, viewer):
    """At rest, showing the joint layer at time 0.5."""
    session = next(iter(viewer.sessions.values()))
    session.panel.layer.value = "joint"
    session.panel.residual.value = True
    session.panel.time.value = 0.5
    session.panel.snap._impl.update_cb[0](None)
    settle(session)
    return session


def settle(session):
    """Waits for the image at full resolution that the controls ask for."""
    until(lambda: session._shown and session._shown == (session._request(), 1))


def handled(page, session):
    """Waits until the browser has handled all messages of the session, which arrive in their order."""
    mark = session._client.gui.add_html('<i class="mark"></i>')
    page.locator(".mark").wait_for(state="attached")
    mark.remove()
    page.locator(".mark").wait_for(state="detached")


def seen(page, session, seconds=60.0):
    """What the browser shows beside the panel, once it no longer changes."""
    settle(session)
    handled(page, session)
    before, end = None, time.monotonic() + seconds
    while time.monotonic() < end:
        now = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)[:ABOVE, :LEFT]
        if before is not None and np.array_equal(now, before):
            return now.astype(float)
        before = now
        time.sleep(0.2)
    raise AssertionError("the image keeps changing")


def test_the_page_requests_nothing_from_other_servers(visit, viewer):
    schemes = {url.split(":")[0] for url in visit[1] if not url.startswith(f"http://127.0.0.1:{viewer.port}/")}
    assert visit[1]
    assert schemes <= {"blob", "data"}


def test_the_image_shows_the_scene_through_the_camera(page, session):
    image = seen(page, session)
    request = session._shown.request
    camera = camera_of(request.pose, request.size, request.time)
    expected = render_layer(request.layer, request.scene.splats(request.time), camera)
    expected = cv2.resize(expected, session._canvas())[:ABOVE, :LEFT, ::-1]
    assert expected.std() > 10
    assert np.abs(image - expected).mean() < 4.0


def test_with_cuda_graphs_joint_images_at_full_resolution_are_replayed(page, session, monkeypatch):
    """A graph is a function here, which is called again; the rest is as on a GPU."""
    before = seen(page, session)
    trained = session._shown.request.scene
    monkeypatch.setattr(graphs, "capture", lambda work: work)
    monkeypatch.setattr(TrainedScene, "uses_graphs", True)
    for k in range(graphs.WARM_UPS + 1):
        session.panel.time.value = 0.9 - 0.05 * (graphs.WARM_UPS - k)
        settle(session)
    moved = seen(page, session)
    assert trained.is_captured(session._shown.request.size)
    assert np.abs(moved - before).max() > 10
    monkeypatch.undo()
    session.panel.time.value = 0.1
    settle(session)
    session.panel.time.value = 0.9
    assert np.abs(seen(page, session) - moved).max() < 3


def test_the_panel_has_the_name_of_the_run(page, run):
    page.get_by_text(run.name, exact=True).wait_for()


def test_the_panel_lies_beside_the_image(page, session):
    box = page.get_by_role("button", name="Screenshot", exact=True).bounding_box()
    assert session._canvas()[0] < box["x"]


def test_the_timeline_is_as_wide_as_the_image_also_in_another_window(page, session):
    def is_wide():
        box, width = page.get_by_role("button", name="Play", exact=True).bounding_box(), page.evaluate(CANVAS_WIDTH)
        return box["x"] > 0 and 0.9 * width < box["width"] <= width

    until(is_wide)
    page.set_viewport_size({"width": 800, "height": 700})
    until(lambda: session._canvas()[0] < 600)
    until(is_wide)
    page.set_viewport_size(SIZE)
    until(is_wide)
    settle(session)


def test_the_tab_has_the_name_of_the_run(page, run):
    until(lambda: page.title() == run.name)


def test_space_plays_and_pauses_also_after_a_click_on_a_button(page, session):
    page.mouse.click(200, 100)
    for playing in (True, False):
        page.keyboard.press("Space")
        until(lambda playing=playing: session._clock.playing is playing)
    page.get_by_role("button", name="Play", exact=True).click()
    until(lambda: session._clock.playing)
    page.keyboard.press("Space")
    until(lambda: not session._clock.playing)
    settle(session)


def test_the_view_follows_the_training_camera_until_the_mouse_moves_it(page, session, viewer):
    session.panel.follow.value = True
    session.panel.time.value = 0.1
    settle(session)
    aspect = session._canvas()[0] / session._canvas()[1]
    assert session._pose().position == pytest.approx(viewer._training.path.pose(0.1, aspect).position)
    until(lambda: np.allclose(session._client.camera.position, session._pose().position, atol=1e-5))
    page.get_by_role("button", name="Play", exact=True).click()
    until(lambda: not 0.08 < session.panel.time.value < 0.2)
    assert session.panel.follow.value
    page.mouse.move(200, 300)
    page.mouse.down()
    page.mouse.move(230, 300, steps=5)
    page.mouse.up()
    until(lambda: not session.panel.follow.value)
    page.get_by_role("button", name="Pause", exact=True).click()
    settle(session)


def test_the_mouse_stays_near_what_was_filmed_and_the_status_says_where_it_leaves_it(page, session, viewer):
    for _ in range(4):
        page.mouse.move(50, 300)
        page.mouse.down()
        page.mouse.move(450, 300, steps=20)
        page.mouse.up()
    page.get_by_text("outside of what was filmed").wait_for()
    settle(session)
    assert 1 < session._steering.outside() <= DRAG_LIMIT
    until(lambda: np.allclose(session._client.camera.position, session._pose().position, atol=1e-3))
    session.panel.snap._impl.update_cb[0](None)
    page.get_by_text("outside of what was filmed").wait_for(state="detached")


def test_truth_is_shown_left_of_the_border_until_the_camera_moves(page, session, viewer):
    before = seen(page, session)
    session.panel.wipe.value = 1.0
    image = seen(page, session)
    assert np.abs(image - before).mean() > 5
    session.panel.wipe.value = 0.0
    until(lambda: np.abs(seen(page, session) - before).max() < 10)
    session.panel.wipe.value = 1.0
    camera = session._client.camera
    camera.position = camera.position + 0.1
    until(lambda: session._request().truth is None)
    session.panel.wipe.value = 0.0


def test_camera_and_controls_survive_a_reload(page, session, viewer):
    session.panel.layer.value = "static"
    camera = session._client.camera
    target, told = camera.position + 0.05, []

    @camera.on_update
    async def _(camera):
        told.append(camera.position)

    camera.position = target
    handled(page, session)
    until(lambda: told and np.allclose(told[-1], target, atol=1e-5))  # before, it may still tell where it was
    settle(session)
    pose, time_shown = session._pose(), session.panel.time.value
    page.reload()
    page.get_by_text("Training cameras").wait_for()
    until(lambda: viewer.sessions and session not in viewer.sessions.values())
    (after,) = viewer.sessions.values()
    settle(after)
    until(lambda: after._pose().position == pytest.approx(pose.position, abs=1e-5))
    assert abs(np.dot(after._pose().wxyz, pose.wxyz)) == pytest.approx(1.0, abs=1e-5)
    assert (after.panel.layer.value, after.panel.time.value) == ("static", time_shown)


def test_a_screenshot_is_written(page, session, tmp_path_factory):
    seen(page, session)
    path = tmp_path_factory.getbasetemp() / "viewer.png"
    page.screenshot(path=path)
    assert cv2.imread(str(path)).shape == (SIZE["height"], SIZE["width"], 3)


def test_the_time_slider_changes_the_image(page, session):
    before = seen(page, session)
    box = page.locator("input[type=text]:visible:not([readonly])").last
    box.fill("0.95")
    box.press("Enter")
    until(lambda: session.panel.time.value == pytest.approx(0.95))
    assert np.abs(seen(page, session) - before).max() > 10


def test_keys_move_the_time_slider(page, session):
    thumb = page.get_by_role("slider").last
    thumb.focus()
    before = session.panel.time.value
    for _ in range(5):
        thumb.press("ArrowRight")
    until(lambda: session.panel.time.value == pytest.approx(before + 0.005))


@pytest.mark.parametrize("layer", ["static", "dynamic", "depth", "alpha", "dynamic weight"])
def test_the_menu_changes_the_layer(page, session, layer):
    before = seen(page, session)
    page.locator("input[role=combobox]:visible").first.click()
    page.get_by_role("option", name=layer, exact=True).click()
    until(lambda: session.panel.layer.value == layer)
    assert np.abs(seen(page, session) - before).mean() > 1.0


def test_the_appearance_network_can_be_switched_off(page, session):
    before = seen(page, session)
    page.get_by_role("checkbox").nth(1).click()
    until(lambda: session.panel.residual.value is False)
    assert np.abs(seen(page, session) - before).max() > 0


def test_time_plays_and_pauses(page, session):
    page.get_by_role("button", name="Play", exact=True).click()
    first = session.panel.time.value
    until(lambda: session.panel.time.value != first)
    page.get_by_role("button", name="Pause", exact=True).click()
    until(lambda: not session._clock.playing)
    settle(session)
    handled(page, session)
    assert page.get_by_role("button", name="Play", exact=True).is_visible()


def test_dragging_orbits(page, session):
    before, image_before = session._pose(), seen(page, session)
    page.mouse.move(200, 400)
    page.mouse.down()
    page.mouse.move(260, 420, steps=5)
    page.mouse.up()
    until(lambda: session._pose() != before)
    assert np.abs(seen(page, session) - image_before).mean() > 1.0


def test_dragging_orbits_the_target_of_the_training_camera(page, session, viewer):
    """The target stays in the middle of the image, at its distance."""
    target = viewer._training.target(int(session.panel.view.value) - 1)
    distance = np.linalg.norm(target - np.array(session._pose().position))
    page.mouse.move(200, 400)
    page.mouse.down()
    page.mouse.move(260, 400, steps=5)
    page.mouse.up()
    until(lambda: np.linalg.norm(np.array(session._pose().position) - target) == pytest.approx(distance, rel=1e-3))
    row, column, _, inside = session.current_camera().project(torch.tensor(target[None]).float())
    middle = session.current_camera()
    assert bool(inside)
    assert abs(int(column) - middle.width / 2) < 3
    assert abs(int(row) - middle.height / 2) < 3


def test_keys_move_the_camera(page, session):
    page.mouse.click(200, 400)
    before = np.array(session._pose().position)
    page.keyboard.down("w")
    until(lambda: np.linalg.norm(np.array(session._pose().position) - before) > 1e-3)
    page.keyboard.up("w")
    settle(session)


def test_looking_through_a_training_camera_takes_its_pose_and_time(page, session, viewer):
    view = viewer._training.views[2]
    session.panel.view.value = 3
    until(lambda: session.panel.time.value == pytest.approx(view.time))
    until(lambda: session._pose().position == pytest.approx(view.pose.position, abs=1e-4))
    settle(session)
    width, height = session._canvas()
    across = height * view.aspect * np.tan(view.pose.fov / 2) / np.tan(session._pose().fov / 2)
    assert across == pytest.approx(min(width, height * view.aspect))  # exactly the whole image of the camera
    assert np.abs(np.array(session._pose().wxyz) @ np.array(view.pose.wxyz)) == pytest.approx(1.0, abs=1e-6)


def test_training_cameras_are_shown_and_removed(page, session):
    camera = session._client.camera
    camera.position = camera.position - (camera.look_at - camera.position)
    before = seen(page, session)
    session.panel.show_cameras.value = True
    until(lambda: np.abs(seen(page, session) - before).max() > 50)
    session.panel.show_cameras.value = False
    until(lambda: np.abs(seen(page, session) - before).max() < 10)


def test_training_cameras_are_hidden_while_the_browser_looks_through_one(page, session):
    before = seen(page, session)
    session.panel.show_cameras.value = True
    page.get_by_text("training cameras are hidden").wait_for()
    assert np.abs(seen(page, session) - before).max() < 10
    session.panel.show_cameras.value = False


@pytest.fixture
def path_folder(page):
    """The folder of camera paths is open."""
    if not page.get_by_role("button", name="Add keyframe").is_visible():
        page.get_by_text("Camera path").click()


def click_until_there_are(count, page, session, button):
    """Clicks a button that adds or removes one keyframe; each click is handled on its own thread."""
    page.get_by_role("button", name=button).click()
    until(lambda: len(session.path.cameras) == count)
    handled(page, session)


@pytest.mark.usefixtures("path_folder")
def test_a_camera_path_is_saved(page, session, run):
    click_until_there_are(1, page, session, "Add keyframe")
    session.panel.view.value = 5
    settle(session)
    click_until_there_are(2, page, session, "Add keyframe")
    page.get_by_role("button", name="Save path").click()
    until((run / "paths" / "path.json").exists)
    page.get_by_text("2 keyframes saved as").wait_for()
    last = json.loads((run / "paths" / "path.json").read_text())["keyframes"][1]
    assert last["width"] == session.panel.width.value
    width, height = session._canvas()
    assert last["width"] / last["height"] == pytest.approx(width / height, rel=0.01)
    assert last["time"] == pytest.approx(session.panel.time.value)
    assert session.current_camera().viewmat.tolist() == [pytest.approx(row, abs=1e-5) for row in last["viewmat"]]


@pytest.mark.usefixtures("path_folder")
def test_keyframes_can_be_removed(page, session):
    click_until_there_are(len(session.path.cameras) + 1, page, session, "Add keyframe")
    for count in reversed(range(len(session.path.cameras))):
        click_until_there_are(count, page, session, "Remove keyframe")
    page.get_by_text("no keyframes").wait_for()
    page.get_by_role("button", name="Save path").click()
    page.get_by_text("a path needs at least one keyframe").wait_for()


def test_the_status_shows_counts_and_fps(page, session):
    scene = session._shown.request.scene.scene
    page.get_by_text(f"{len(scene.static)} static, {len(scene.dynamic)} dynamic Gaussians").wait_for()
    page.get_by_text("FPS").wait_for()


def test_the_time_of_a_slow_image_moves_no_control(page, session, monkeypatch):
    """Otherwise a click may hit the button beside the one that was aimed at."""
    seen(page, session)
    boxes = [page.get_by_role("button", name=name, exact=True) for name in ("Play", "Screenshot", "Look through it")]
    before = [box.bounding_box() for box in boxes]
    monkeypatch.setattr(session, "_cost", ("1920 × 1306 in 12345 ms", 0.1))
    session._status_at = 0.0
    session._update_status()
    page.get_by_text("12345 ms").wait_for()
    monkeypatch.setattr(session, "_note", "a long note " * 20)
    session._status_at = 0.0
    session._update_status()
    page.get_by_text("a long note").wait_for()
    assert [box.bounding_box() for box in boxes] == before
    monkeypatch.setattr(session, "_note", "")


def test_newer_checkpoints_are_shown(page, session, run):
    before = seen(page, session)
    iteration = session._shown.request.scene.metadata.iteration
    watched.advance(run, 7)
    page.get_by_text(f"iteration {iteration + 7}").wait_for()
    assert np.abs(seen(page, session) - before).max() > 0


def test_each_browser_has_its_own_controls(browser, viewer, session):
    other = browser.new_page(viewport=SIZE)
    other.goto(f"http://127.0.0.1:{viewer.port}")
    until(lambda: len(viewer.sessions) == 2)
    second = list(viewer.sessions.values())[1]
    second.panel.time.value = 0.125
    settle(second)
    assert session.panel.time.value == pytest.approx(pose_time(viewer, session))
    thread = second._thread
    other.close()
    until(lambda: len(viewer.sessions) == 1)
    until(lambda: not thread.is_alive())


def pose_time(viewer, session):
    """Time of the training view that the session looks through."""
    return viewer._training.views[int(session.panel.view.value) - 1].time


def test_the_pose_of_the_camera_is_exact(session):
    assert pose_of(session.current_camera()).fov == pytest.approx(session._pose().fov)


def test_the_screenshot_button_downloads_the_image(page, session, tmp_path):
    """Last, because a note about the download lies over the image for a while."""
    session.panel.width.value = 1280  # more than the canvas has
    settle(session)
    with page.expect_download() as download:
        page.get_by_role("button", name="Screenshot").click()
    download.value.save_as(tmp_path / "shot.png")
    assert download.value.suggested_filename == f"run-joint-{session.panel.current_time:.3f}.png"
    request = session._request()
    width, height = request.canvas
    request = request._replace(canvas=(1280, round(height * 1280 / width)))
    expected = session._renderer.render(request, 1.0).image
    assert np.array_equal(cv2.imread(str(tmp_path / "shot.png"))[..., ::-1], expected)
