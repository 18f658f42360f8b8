"""The viewer's address, and what keeps it from starting: one line each."""

import importlib.util
import shutil
import socket
import urllib.request
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from tests.viewer import watched
from warpgs.cli import main
from warpgs.viewer import command, server
from warpgs.viewer.command import View, training_cameras
from warpgs.viewer.server import Viewer, check_address
from warpgs.viewer.source import open_source
from warpgs.viewer.training_cameras import MAX_FRUSTUMS


@pytest.fixture(scope="module")
def run(finished_run, tmp_path_factory):
    return watched.copy(finished_run, tmp_path_factory.mktemp("made"))


@pytest.fixture
def taken():
    """A port that somebody listens on."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


def refusal(capsys, *arguments):
    """The one line that a command ends with."""
    assert main(["view", *map(str, arguments)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    return said


def test_only_this_machine_can_connect_unless_told_otherwise(run):
    with Viewer(open_source(run, "cpu", False), None, View(run).host, 0) as viewer:
        listening = viewer._server._websock_server
        assert listening._host == "127.0.0.1"
        with urllib.request.urlopen(f"http://127.0.0.1:{viewer.port}", timeout=30) as page:
            assert page.status == 200


def test_no_browser_can_ask_for_a_public_address(run):
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        assert viewer._server.request_share_url() is None


class Watched:
    """A session that only says whether it was stopped; the browser leaves while it is being made, if it does."""

    leaves = None

    def __init__(self, client, *_):
        self.stopped = False
        made.append(self)
        if Watched.leaves is not None:
            Watched.leaves(client)

    def stop(self):
        self.stopped = True

    def join(self):
        pass


made: list[Watched] = []


@pytest.fixture
def viewer(run, monkeypatch, contracts_off):
    made.clear()
    monkeypatch.setattr(server, "Session", Watched)
    monkeypatch.setattr(server, "aim", lambda *_: None)
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        yield viewer


def test_a_browser_that_leaves_while_its_session_is_made_leaves_no_session(viewer, monkeypatch):
    monkeypatch.setattr(Watched, "leaves", viewer._end)  # viser forgets a client before it says that it left
    viewer._begin(SimpleNamespace(client_id=7, camera=None))
    assert viewer.sessions == {}
    assert [session.stopped for session in made] == [True]


def test_a_session_that_is_made_while_the_viewer_stops_is_stopped_too(viewer, monkeypatch):
    client = SimpleNamespace(client_id=7, camera=None)
    monkeypatch.setattr(viewer._server, "get_clients", lambda: {7: client})
    viewer._begin(client)
    assert list(viewer.sessions) == [7]
    assert [session.stopped for session in made] == [False]
    viewer._take_all()
    viewer._begin(client)
    assert viewer.sessions == {}
    assert made[1].stopped


def test_a_port_is_free_again_after_the_viewer(run):
    with Viewer(open_source(run, "cpu", False), None, "127.0.0.1", 0) as viewer:
        port = viewer.port
    check_address("127.0.0.1", port)


def test_a_port_in_use_is_one_line(run, taken, capsys):
    assert f"can't listen on 127.0.0.1, port {taken}: Address already in use" in refusal(capsys, run, "--port", taken)


@pytest.mark.parametrize("host", ["192.0.2.1", "no such host", ""])
def test_a_host_that_is_not_ours_is_one_line(run, capsys, host):
    if host:
        assert f"can't listen on {host}, port 8080" in refusal(capsys, run, "--host", host)
    else:
        with pytest.raises(OSError, match="port 70000"):
            check_address(host, 70000)


@pytest.mark.parametrize("port", [-1, 65536, 99999])
def test_a_port_that_there_is_not_is_one_line(run, capsys, port):
    assert f"can't listen on port {port}: choose a --port from 0 to 65535" in refusal(capsys, run, "--port", port)


def test_a_missing_package_is_one_line_that_says_how_to_get_it(run, capsys, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    assert "pip install -e '.[viewer]'" in refusal(capsys, run)


def test_what_is_no_run_is_one_line(tmp_path, capsys):
    assert f"{tmp_path} is no run folder" in refusal(capsys, tmp_path, "--port", 0)


def test_a_run_of_another_version_is_one_line(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "run")
    text = (copy / "config.json").read_text()
    (copy / "config.json").write_text(text.replace('"seed"', '"sead"'))
    assert "config.json has fields of another version: sead" in refusal(capsys, copy, "--port", 0)


def test_a_damaged_checkpoint_is_one_line(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "run")
    next((copy / "checkpoints").iterdir()).write_bytes(b"nonsense")
    for path in (copy / "checkpoints").iterdir():
        path.write_bytes(b"nonsense")
    assert "is damaged" in refusal(capsys, copy, "--port", 0)


def test_a_run_whose_capture_is_gone_is_shown_without_its_cameras(run, tmp_path, capsys):
    copy = shutil.copytree(run, tmp_path / "run")
    text = (copy / "config.json").read_text()
    (copy / "config.json").write_text(text.replace("/capture", "/gone"))
    source = open_source(copy, "cpu", False)
    assert training_cameras(source) is None
    assert "without training cameras: " in capsys.readouterr().err
    with Viewer(source, None, "127.0.0.1", 0) as viewer:
        assert viewer.port > 0


def test_the_command_says_where_to_look(run, capsys, monkeypatch):
    monkeypatch.setattr(command, "_wait", lambda: None)
    monkeypatch.setattr(command.os, "nice", lambda _: pytest.fail("a finished run has no trainer to give way to"))
    assert main(["view", str(run), "--port", "0", "--device", "cpu"]) == 0
    assert f"{run}: http://127.0.0.1:" in capsys.readouterr().out


def test_a_viewer_beside_a_trainer_lets_it_go_first(run, monkeypatch):
    given = []
    monkeypatch.setattr(command, "_wait", lambda: None)
    monkeypatch.setattr(command.os, "nice", given.append)
    View(run, port=0, while_training=True, device="cpu").run()
    assert given == [command.NICENESS]


def test_training_cameras_are_in_order_of_time_and_not_too_many(run):
    training = training_cameras(open_source(run, "cpu", False))
    times = [view.time for view in training.views]
    assert times == sorted(times)
    training.views = training.views * 40
    chosen = training.spread()
    assert len(chosen) <= MAX_FRUSTUMS
    assert (chosen[0], chosen[-1]) == (0, len(training.views) - 1)


def test_a_picture_that_cannot_be_read_is_left_out(run, monkeypatch):
    training = training_cameras(open_source(run, "cpu", False))

    def read(_):
        raise ValueError("damaged")

    monkeypatch.setattr(training._capture, "frame", read)
    assert training.picture(0) is None
