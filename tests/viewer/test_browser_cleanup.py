"""Cleaning a scene up in a real browser."""

import shutil

import numpy as np
import pytest

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")
pytest.importorskip("playwright.sync_api", reason="browser tests need playwright: pip install -e '.[browser]'")

from tests.viewer.test_browser import SIZE, browser  # noqa: F401  # a fixture
from tests.viewer.watched import until
from warpgs.editing.edits_file import NAME, read_edits
from warpgs.editing.objects import write_objects
from warpgs.editing.options import Editing, Edits
from warpgs.runs.run import Run
from warpgs.viewer.serve import training_cameras
from warpgs.viewer.server import Viewer
from warpgs.viewer.source import open_source

pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection:UserWarning")


def test_what_is_clicked_is_removed_undone_and_saved(browser, run, tmp_path):  # noqa: F811
    copy = shutil.copytree(run, tmp_path / "run")
    scene = Run.open(copy, "cpu").trained_scene()
    write_objects(scene, copy, np.ones(len(scene.scene.dynamic), np.int32))
    source = open_source(copy, "cpu", False)
    training = training_cameras(source, pytest.fail)
    source.edit(Editing(), training.capture)
    whole = len(source.current().scene.static)
    with Viewer(source, training, "127.0.0.1", 0) as viewer:
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(60_000)
        page.goto(f"http://127.0.0.1:{viewer.port}")
        page.get_by_text("Clean up").click()
        until(lambda: viewer.sessions)
        cleanup = next(iter(viewer.sessions.values())).cleanup
        page.get_by_label("crop box").check()
        until(lambda: cleanup.edits.crop is not None)
        until(lambda: len(cleanup.scene().scene.static) < whole)
        page.get_by_text("Remove", exact=True).click()
        until(lambda: len(cleanup.scene().scene.dynamic) == 0)
        page.get_by_text("Undo", exact=True).click()
        until(lambda: cleanup.edits.remove is None)
        page.get_by_label("drop floaters").check()
        until(lambda: cleanup.edits.drop_floaters)
        page.get_by_text("Undo", exact=True).click()
        until(lambda: not cleanup.edits.drop_floaters)
        page.get_by_text("Save as edits").click()
        until((copy / NAME).exists)
        assert read_edits(copy / NAME)[0] == cleanup.edits == Edits(crop=cleanup.edits.crop)
        page.close()
