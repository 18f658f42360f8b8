"""The scene that the viewer shows."""

import shutil
import threading

import pytest
import torch

from tests.viewer import watched
from warpgs.runs import checkpoint, preview
from warpgs.runs.run import Run
from warpgs.viewer import source as source_module
from warpgs.viewer.source import open_source


@pytest.fixture
def run(run, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(run, tmp_path / "run")


@pytest.fixture
def without_interval(monkeypatch):
    """Every call of ``current`` checks the folder."""
    monkeypatch.setattr(source_module, "POLL_SECONDS", 0.0)


@pytest.fixture
def source(run, without_interval):
    """The source of a run that is followed."""
    return open_source(run, "cpu", True)


def test_the_newest_checkpoint_is_shown(run):
    trained = open_source(run, "cpu", False).current()
    assert trained.metadata.iteration == 32
    newest = checkpoint.load(checkpoint.list_checkpoints(run)[-1]).tensors
    assert watched.same(trained.scene.static.means, newest["scene.static.means"])


def test_without_follow_newer_checkpoints_are_ignored_and_nothing_is_asked_for(run, without_interval):
    source = open_source(run, "cpu", False)
    before = source.current()
    watched.advance(run)
    assert source.current() is before
    assert not preview.is_requested(run)


def test_a_newer_checkpoint_is_followed(run, source):
    assert source.current().metadata.iteration == 32
    watched.advance(run)
    assert source.current().metadata.iteration == 33


def test_an_unchanged_checkpoint_is_not_read_again(source):
    assert source.current() is source.current()


def test_a_rewritten_checkpoint_is_read_again(run, source):
    before = source.current()
    path = checkpoint.list_checkpoints(run)[-1]
    loaded = checkpoint.load(path)
    checkpoint.save(path, loaded.tensors, loaded.metadata)
    assert source.current() is not before


def test_a_followed_run_is_not_read_before_the_first_call(run, monkeypatch):
    monkeypatch.setattr(Run, "trained_scene", lambda *_: pytest.fail("read"))
    monkeypatch.setattr(Run, "newest_checkpoint", lambda *_: pytest.fail("read"))
    open_source(run, "cpu", True)


def test_the_folder_is_not_checked_at_every_call(run, monkeypatch):
    source = open_source(run, "cpu", True)
    source.current()
    monkeypatch.setattr(Run, "newest_checkpoint", lambda _: pytest.fail("checked"))
    source.current()


def test_a_followed_run_may_have_no_checkpoint_yet(run, without_interval):
    shutil.move(run / "checkpoints", run / "away")
    source = open_source(run, "cpu", True)
    assert source.current() is None
    assert source.note == "waiting for the first checkpoint"
    shutil.move(run / "away", run / "checkpoints")
    assert source.current().metadata.iteration == 32
    assert source.note == ""


def test_a_damaged_checkpoint_keeps_the_scene_before_it(run, source):
    before = source.current()
    watched.advance(run).write_bytes(b"nonsense")
    assert source.current() is before
    assert "0000033.safetensors is damaged" in source.note


def test_a_checkpoint_deleted_while_it_is_read_is_ignored(run, source, monkeypatch):
    before = source.current()
    deleted = run / "checkpoints" / "0000099.safetensors"
    monkeypatch.setattr(Run, "newest_checkpoint", lambda _: deleted)
    assert source.current() is before
    assert source.note == ""


def test_nobody_waits_for_a_scene_that_another_thread_reads(run, source, monkeypatch):
    before = source.current()
    watched.advance(run)
    begun, read = threading.Event(), threading.Event()
    monkeypatch.setattr(Run, "trained_scene", lambda *_: (begun.set(), read.wait(60.0), before)[-1])
    reader = threading.Thread(target=source.current)
    reader.start()
    begun.wait(60.0)
    assert source.current() is before
    source.stop()
    assert reader.is_alive()
    assert not preview.is_requested(run)
    read.set()
    reader.join()
    source.current()
    assert not preview.is_requested(run)


def test_a_run_without_a_checkpoint_is_refused(run):
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(ValueError, match="has no checkpoint yet"):
        open_source(run, "cpu", False)


@pytest.mark.parametrize("follow", [False, True])
def test_a_folder_that_is_not_a_run_is_refused(tmp_path, follow):
    with pytest.raises(ValueError, match="is not a run folder"):
        open_source(tmp_path, "cpu", follow)


def test_a_damaged_run_is_refused(run):
    (run / "config.json").write_text("{")
    with pytest.raises(ValueError, match=r"config\.json is not valid JSON"):
        open_source(run, "cpu", True)


def test_a_followed_training_is_asked_for_its_scene_and_shows_it(run, source):
    source.current()
    assert preview.is_requested(run)
    scene = Run.open(run, "cpu").trained_scene()
    with torch.no_grad():
        scene.scene.static.means += 0.25
    preview.write(run, scene, preview.State(40, 96, 21.27, 3.0))
    assert watched.same(source.current().scene.static.means, scene.scene.static.means)
    assert source.progress == "training: 40 of 96 iterations, 21.3 dB, 3.0 it/s"
    watched.advance(run)
    assert source.current().metadata.iteration == 33  # a newer checkpoint wins
    preview.remove(run)
    source.current()
    assert source.progress == ""


def test_a_viewer_that_ends_leaves_no_request(run, source):
    source.current()
    assert preview.is_requested(run)
    source.stop()
    source.current()
    assert not (run / preview.REQUEST).exists()
