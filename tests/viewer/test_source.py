"""Where the viewer's scene comes from."""

import shutil

import pytest

from tests.viewer import watched
from warpgs.runs import checkpoint
from warpgs.viewer import source as source_module
from warpgs.viewer.source import open_source


@pytest.fixture(scope="module")
def made(finished_run, tmp_path_factory):
    return watched.copy(finished_run, tmp_path_factory.mktemp("made"))


@pytest.fixture
def run(made, tmp_path):
    return shutil.copytree(made, tmp_path / "run")


@pytest.fixture
def at_once(monkeypatch):
    """Every look at the source is a look at the folder."""
    monkeypatch.setattr(source_module, "LOOK_EVERY", 0.0)


def test_a_run_is_shown_as_its_newest_checkpoint_has_it(run):
    player = open_source(run, "cpu", False).current()
    assert player.metadata.iteration == 32
    newest = checkpoint.load(checkpoint.list_checkpoints(run)[-1]).tensors
    assert watched.same(player.scene.static.means, newest["scene.static.means"])


def test_a_finished_run_is_not_looked_at_again(run, at_once):
    source = open_source(run, "cpu", False)
    before = source.current()
    watched.advance(run)
    assert source.current() is before


def test_a_newer_checkpoint_is_followed(run, at_once):
    source = open_source(run, "cpu", True)
    assert source.current().metadata.iteration == 32
    watched.advance(run)
    assert source.current().metadata.iteration == 33


def test_a_checkpoint_that_did_not_change_is_not_read_again(run, at_once):
    source = open_source(run, "cpu", True)
    assert source.current() is source.current()


def test_a_checkpoint_written_again_is_read_again(run, at_once):
    source = open_source(run, "cpu", True)
    before = source.current()
    path = checkpoint.list_checkpoints(run)[-1]
    loaded = checkpoint.load(path)
    checkpoint.save(path, loaded.tensors, dict(loaded.facts))
    assert source.current() is not before


def test_a_followed_run_is_not_read_before_somebody_looks(run, monkeypatch):
    def read(*_):
        raise AssertionError("read")

    monkeypatch.setattr(source_module.runs, "newest_scene", read)
    open_source(run, "cpu", True)


def test_the_folder_is_not_looked_at_all_the_time(run, monkeypatch):
    source = open_source(run, "cpu", True)
    source.current()
    monkeypatch.setattr(source_module.checkpoint, "saved", lambda _: pytest.fail("looked"))
    source.current()


def test_a_followed_run_may_be_without_a_checkpoint_yet(run, at_once):
    shutil.move(run / "checkpoints", run / "away")
    source = open_source(run, "cpu", True)
    assert source.current() is None
    assert source.note == "waiting for the first checkpoint"
    shutil.move(run / "away", run / "checkpoints")
    assert source.current().metadata.iteration == 32
    assert source.note == ""


def test_a_damaged_newest_checkpoint_leaves_the_scene_before_it(run, at_once):
    source = open_source(run, "cpu", True)
    before = source.current()
    watched.advance(run).write_bytes(b"nonsense")
    assert source.current() is before
    assert "0000033.safetensors is damaged" in source.note


def test_a_checkpoint_that_is_deleted_meanwhile_is_no_error(run, at_once, monkeypatch):
    source = open_source(run, "cpu", True)
    before = source.current()
    gone = [run / "checkpoints" / "0000099.safetensors"]
    monkeypatch.setattr(source_module.checkpoint, "saved", lambda _: gone)
    assert source.current() is before
    assert source.note == ""


def test_a_run_without_a_checkpoint_is_refused(run):
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(ValueError, match="has no checkpoint yet"):
        open_source(run, "cpu", False)


@pytest.mark.parametrize("follow", [False, True])
def test_what_is_no_run_is_refused(tmp_path, follow):
    with pytest.raises(ValueError, match="is no run folder"):
        open_source(tmp_path, "cpu", follow)


def test_a_damaged_run_is_refused(run):
    (run / "config.json").write_text("{")
    with pytest.raises(ValueError, match=r"config\.json is damaged"):
        open_source(run, "cpu", True)


def test_the_residual_can_be_left_out(run):
    player = open_source(run, "cpu", False).current()
    plain, relit = (player.splats(0.5, residual) for residual in (False, True))
    num = len(player.scene.static)
    assert watched.same(plain.sh[:num], player.scene.static.sh)
    assert not watched.same(relit.sh[:num], player.scene.static.sh)
