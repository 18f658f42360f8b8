"""The server of the viewer, its sessions, and one-line errors."""

import gc
import importlib.util
import json
import random
import shutil
import socket
import threading
import urllib.request
import weakref
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install 'warpgs[viewer]'")

from tests.campaign.browser import Browser
from tests.errors import error_line
from tests.viewer.watched import until
from warpgs.cli import main
from warpgs.command_line.version import install_command
from warpgs.viewer import command, serve, server
from warpgs.viewer.options import View
from warpgs.viewer.renderer import Renderer
from warpgs.viewer.serve import training_cameras
from warpgs.viewer.server import Viewer, check_address
from warpgs.viewer.source import open_source
from warpgs.viewer.training_cameras import MAX_FRUSTUMS


@pytest.fixture
def taken():
    """A port in use."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


def test_only_this_machine_can_connect_by_default_and_no_browser_can_request_a_public_address(run):
    with Viewer(open_source(run, "cpu", False), None, View(run).host, 0) as viewer:
        assert viewer._server._websock_server._host == "127.0.0.1"
        assert viewer._server.request_share_url() is None
        with urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}", timeout=30) as page:
            assert page.status == 200
    check_address("127.0.0.1", viewer.port)  # it is free again


class FakeSession:
    """A session that only records whether it was stopped; it calls ``on_create`` when it is created."""

    on_create = None

    def __init__(self, client, *_):
        self.stopped = False
        sessions.append(self)
        if FakeSession.on_create is not None:
            FakeSession.on_create(client)

    def stop(self):
        self.stopped = True

    def join(self):
        pass


sessions: list[FakeSession] = []


@pytest.fixture
def viewer(run, monkeypatch, contracts_off):
    sessions.clear()
    monkeypatch.setattr(server, "Session", FakeSession)
    monkeypatch.setattr(server, "set_camera", lambda *_: None)
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        yield viewer


def test_a_browser_that_disconnects_while_its_session_is_created_has_no_session(viewer, monkeypatch):
    monkeypatch.setattr(FakeSession, "on_create", viewer._remove_session)  # viser drops a client before it reports it
    viewer._add_session(SimpleNamespace(client_id=7, camera=None))
    assert viewer.sessions == {}
    assert [session.stopped for session in sessions] == [True]


def test_a_session_created_while_the_viewer_stops_is_stopped(viewer, monkeypatch):
    client = SimpleNamespace(client_id=7, camera=None)
    monkeypatch.setattr(viewer._server, "get_clients", lambda: {7: client})
    viewer._add_session(client)
    assert list(viewer.sessions) == [7]
    assert [session.stopped for session in sessions] == [False]
    viewer._remove_all()
    viewer._add_session(client)
    assert viewer.sessions == {}
    assert sessions[1].stopped


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection:UserWarning")
def test_images_are_rendered_by_threads_that_end_with_their_browsers(run, monkeypatch):
    """Each thread keeps what it learns of the sizes of images, also of screenshots."""
    rendered, render = [], Renderer.render

    def recorded(renderer, request, scale):
        rendered.append((threading.current_thread(), request, scale))
        return render(renderer, request, scale)

    monkeypatch.setattr(Renderer, "render", recorded)
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        with Browser(viewer.port, random.Random(0)) as browser:
            browser.look()
            until(lambda: viewer.sessions)
            (session,) = viewer.sessions.values()
            until(lambda: session._shown == (session._request(), 1))
            del rendered[:]
            browser.set("Screenshot", True)
            until(lambda: rendered)
        assert [thread for thread, *_ in rendered] == [session._thread]
        until(lambda: not session._thread.is_alive())


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection:UserWarning")
def test_gaussians_are_deleted_by_a_rectangle_and_a_lasso_on_the_screen(run):
    with (
        Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer,
        Browser(viewer.port, random.Random(0)) as browser,
    ):
        browser.look()
        until(lambda: viewer.sessions)
        (session,) = viewer.sessions.values()
        cleanup = session.cleanup
        browser.set("select", "rectangle")
        until(lambda: cleanup._controls.tool.value == "rectangle")
        until(lambda: session._client.scene._scene_pointer_cb)
        browser.point("rect-select", (0.0, 0.0), (0.6, 1.0))
        until(lambda: cleanup.selection.selected)
        first = cleanup.selection.selected
        until(lambda: session._shown.request.marks.selected == first)
        browser.set("selected", "Delete")
        until(lambda: cleanup.edits.erased == first)
        browser.set("select", "lasso")
        until(lambda: any(entry.event_type == "click" for entry in session._client.scene._scene_pointer_cb))
        for k, corner in enumerate([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)], 1):
            browser.point("click", corner)
            until(lambda k=k: len(cleanup.selection.marks.outline) == k % 5)
        until(lambda: cleanup.selection.selected)
        assert not (cleanup.selection.selected.mask & first.mask).any()
        browser.set("Undo", True)
        until(lambda: cleanup.edits.erased is None)


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection:UserWarning")
def test_nothing_is_left_of_a_browser_when_the_next_one_has_left(run):
    """Python by itself finds what viser's handles refer to so late that memory grows over a hundred visits."""
    gc.collect()
    gc.disable()
    try:
        with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
            left = []
            for k in range(2):
                with Browser(viewer.port, random.Random(k)) as browser:
                    browser.look()
                    until(lambda: viewer.sessions)
                    (session,) = viewer.sessions.values()
                left.append((weakref.ref(session), weakref.ref(session._client)))
                until(lambda session=session: not session._thread.is_alive())
                del session
            until(lambda: [ref() for ref in left[0]] == [None, None])
    finally:
        gc.enable()


@pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection:UserWarning")
@pytest.mark.parametrize(("seconds", "shown"), [(60.0, 0.25), (0.0, 0.0)])
def test_only_a_page_that_connects_at_once_continues_the_one_that_has_left(run, monkeypatch, seconds, shown):
    monkeypatch.setattr(server, "RELOAD_SECONDS", seconds)
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        with Browser(viewer.port, random.Random(0)) as browser:
            browser.set("time", 0.25)
            until(lambda: [s for s in list(viewer.sessions.values()) if s.panel.time.value == 0.25])
            (first,) = viewer.sessions.values()
        until(lambda: viewer._left is not None)
        with Browser(viewer.port, random.Random(1)) as browser:
            browser.look()
            until(lambda: viewer.sessions)
            (second,) = viewer.sessions.values()
            assert second.panel.time.value == shown
        until(lambda: not first._thread.is_alive() and not second._thread.is_alive())


def test_a_port_in_use_is_refused_in_one_line(run, taken, capsys):
    error = error_line(capsys, "view", run, "--port", taken)
    assert f"cannot listen on 127.0.0.1, port {taken}: Address already in use; choose another --port" in error


@pytest.mark.parametrize("host", ["192.0.2.1", "no such host"])
def test_a_host_of_another_machine_is_refused_in_one_line(run, capsys, host):
    assert f"cannot listen on {host}, port 8080" in error_line(capsys, "view", run, "--host", host)


@pytest.mark.parametrize("port", [-1, 65536, 99999])
def test_an_invalid_port_is_refused_in_one_line(run, capsys, port):
    with pytest.raises(OSError, match=f"port {port}"):
        check_address("", port)
    error = error_line(capsys, "view", run, "--port", port)
    assert f"cannot listen on port {port}: choose a --port from 0 to 65535" in error


def test_a_missing_package_is_reported_in_one_line_with_the_remedy(run, capsys, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert f"the viewer needs viser: {install_command('viewer')}" in error_line(capsys, "view", run)


def test_a_run_without_its_capture_is_shown_without_training_cameras(run, tmp_path):
    copy, warnings = shutil.copytree(run, tmp_path / "run"), []
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "data": str(tmp_path / "gone")}))
    source = open_source(copy, "cpu", False)
    assert training_cameras(source, warnings.append) is None
    assert warnings[0].startswith("without training cameras: ")
    with Viewer(source, None, "127.0.0.1", 0) as viewer:
        assert viewer.port > 0


def test_the_command_prints_the_address(run, capsys, monkeypatch):
    monkeypatch.setattr(serve, "_wait", lambda: None)
    monkeypatch.setattr(serve, "lower_priority", lambda _: pytest.fail("lowered the priority without training"))
    assert main(["view", str(run), "--port", "0", "--device", "cpu"]) == 0
    assert f"{run}: http://127.0.0.1:" in capsys.readouterr().out


def test_a_viewer_waits_for_a_training_that_has_not_created_its_run(run, tmp_path, monkeypatch, capsys):
    def create(seconds):
        (tmp_path / "later").mkdir(exist_ok=True)  # the trainer writes config.json after it
        waited.append(seconds)
        if len(waited) > 1:
            shutil.copytree(run, tmp_path / "later", dirs_exist_ok=True)

    waited = []
    monkeypatch.setattr(serve, "_wait", lambda: None)
    monkeypatch.setattr(serve, "lower_priority", lambda _: None)
    monkeypatch.setattr(serve.time, "sleep", create)
    command.run(View(tmp_path / "later", port=0, while_training=True, device="cpu"))
    assert f"waiting for a training to create {tmp_path}/later (press Ctrl-C to stop)" in capsys.readouterr().out
    assert len(waited) == 2


def test_a_wrong_folder_is_reported_before_a_port_in_use(tmp_path, taken, capsys):
    assert "does not exist" in error_line(capsys, "view", tmp_path / "nosuch", "--port", taken)


def test_a_viewer_of_a_run_in_training_has_a_low_priority(run, monkeypatch):
    given = []
    monkeypatch.setattr(serve, "_wait", lambda: None)
    monkeypatch.setattr(serve, "lower_priority", given.append)
    command.run(View(run, port=0, while_training=True, device="cpu"))
    assert given == [serve.NICENESS]


def test_training_cameras_are_in_the_order_of_their_times_and_limited_in_number(run):
    training = training_cameras(open_source(run, "cpu", False), pytest.fail)
    times = [view.time for view in training.views]
    assert times == sorted(times)
    training.views = training.views * 40
    chosen = training.frustums()
    assert len(chosen) <= MAX_FRUSTUMS
    assert (chosen[0], chosen[-1]) == (0, len(training.views) - 1)


def test_an_image_that_cannot_be_read_has_no_thumbnail(run, monkeypatch):
    training = training_cameras(open_source(run, "cpu", False), pytest.fail)

    def read(_):
        raise ValueError("damaged")

    monkeypatch.setattr(training.capture, "frame", read)
    assert training.thumbnail(0) is None
