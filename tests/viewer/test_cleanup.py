"""Edits in the browser."""

import html
import re
import shutil
import threading
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

pytest.importorskip("viser", reason="the viewer needs viser: pip install -e '.[viewer]'")

from tests.viewer.test_path_editor import Control
from tests.viewer.watched import advance
from warpgs.editing.edits_file import NAME, read_edits
from warpgs.editing.marked import Marked
from warpgs.editing.objects import NAME as OBJECTS
from warpgs.editing.objects import write_objects
from warpgs.editing.options import Editing, Edits
from warpgs.runs.run import Run
from warpgs.viewer import source as of_runs
from warpgs.viewer.cleanup import Cleanup, box_edges
from warpgs.viewer.cleanup_controls import (
    BRUSH,
    CLEAR,
    DELETE,
    FREEZE,
    INVERT,
    LASSO,
    OFF,
    ONLY,
    RECOLOR,
    RECTANGLE,
    REMOVE,
    RESET,
    SHIFT,
)
from warpgs.viewer.marks import LINE, NO_MARKS, Marks
from warpgs.viewer.pose import Pose
from warpgs.viewer.renderer import Renderer, RenderRequest
from warpgs.viewer.source import MAX_EDITED, open_source

pytestmark = pytest.mark.usefixtures("contracts_off", "quickly")


CANVAS = (320, 240)


class Corner:
    """Arrows of a corner that are dragged."""

    position = (0.0, 0.0, 0.0)

    def on_update(self, handler):
        self.moved = handler

    def on_drag_end(self, handler):
        self.ended = handler

    def drag(self, position):
        self.position = position
        self.moved(None)
        self.ended(None)


class Scene:
    """The scene of a browser, with the corners and the edges of the box."""

    def __init__(self):
        self.shown, self.heard = {}, {}

    def add_transform_controls(self, name, *_, **__):
        self.shown[name] = Corner()
        return self.shown[name]

    def add_line_segments(self, name, points, *_, **__):
        self.shown[name] = points

    def on_click(self, modifier):
        return partial(self.heard.__setitem__, ("click", modifier))

    def on_rect_select(self, modifier):
        return partial(self.heard.__setitem__, ("rect-select", modifier))

    def remove_click_callback(self):
        self.heard.clear()

    remove_rect_select_callback = remove_click_callback

    def remove_by_name(self, name):
        self.shown = {other: value for other, value in self.shown.items() if not other.startswith(name)}


@pytest.fixture
def run(finished_run, tmp_path):
    return shutil.copytree(finished_run, tmp_path / "run")


def opened(run, editing=None):
    """A browser that has opened a run, and its source."""
    source = open_source(run, "cpu", False)
    source.edit(editing or Editing(), Run.open(run, "cpu").open_corrected_capture(True))
    return visited(source)


def visited(source):
    names = (
        "crop",
        "opacity",
        "floaters",
        "find",
        "object",
        "choice",
        "change",
        "color",
        "shift",
        "undo",
        "save",
        "note",
    )
    names += ("tool", "radius", "seen", "selected", "name", "copy")
    controls = SimpleNamespace(**{name: Control() for name in names})
    controls.corners = [Control((0.0, 0.0, 0.0)) for _ in range(2)]
    woken = []
    panel = SimpleNamespace(cleanup=controls, current_time=0.25, layer=Control(), current_layer="joint")
    made = Cleanup(Scene(), panel, source, threading.Lock(), lambda: woken.append(1), lambda: asked(made, panel))
    made.controls, made.panel, made.woken, made.browser, made.source = controls, panel, woken, made._scene, source
    return made


def asked(cleanup, panel):
    """The image that a browser of 320 by 240 pixels asks for, which shows the whole scene."""
    pose = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -6.0), 1.0)
    return RenderRequest(cleanup.scene(), pose, CANVAS, 320, panel.current_layer, True, panel.current_time)


@pytest.fixture
def cleanup(run):
    return opened(run)


def count(cleanup):
    scene = cleanup.scene().scene
    return len(scene.static) + len(scene.dynamic)


def note(cleanup):
    return html.unescape(re.sub("<[^>]*>", "", cleanup.controls.note.content))


def test_without_edits_the_scene_is_the_one_of_the_run(cleanup):
    assert cleanup.scene() is cleanup.source.current()
    assert note(cleanup) == "no edits"


def test_the_crop_box_begins_around_most_of_the_scene(cleanup):
    whole = count(cleanup)
    cleanup.controls.crop.value = True
    assert 0.5 * whole < count(cleanup) < whole
    means = cleanup.source.current().splats(0.5).means.numpy()
    box = np.array(cleanup.edits.crop).reshape(2, 3)
    inside = ((means >= box[0]) & (means <= box[1])).mean(0)
    assert inside == pytest.approx(0.98, abs=0.03)
    assert len(cleanup.woken) == 1


def test_a_corner_that_is_dragged_moves_the_box_and_its_edges(cleanup):
    cleanup.controls.crop.value = True
    before = cleanup.edits.crop
    corner = tuple(np.array(before[3:]) - 0.3)
    cleanup.browser.shown["/crop/to"].drag(corner)
    assert cleanup.edits.crop == (*before[:3], *corner)
    edges = cleanup.browser.shown["/crop/edges"].reshape(-1, 3)
    assert edges.max(0) == pytest.approx(np.float32(corner))
    assert edges.min(0) == pytest.approx(np.float32(before[:3]))


def test_a_corner_that_is_typed_moves_the_box(cleanup):
    cleanup.controls.crop.value = True
    before = cleanup.edits.crop
    assert [corner.value for corner in cleanup.controls.corners] == [before[:3], before[3:]]
    cleanup.controls.corners[0].value = (-0.5, -0.25, 0.0)
    assert cleanup.edits.crop == (-0.5, -0.25, 0.0, *before[3:])
    assert cleanup.browser.shown["/crop/from"].position == pytest.approx([-0.5, -0.25, 0.0])
    assert cleanup.controls.corners[0].visible
    cleanup.controls.undo.click()
    assert cleanup.edits.crop == before


def test_without_its_checkbox_the_box_is_gone(cleanup):
    whole = count(cleanup)
    cleanup.controls.crop.value = True
    cleanup.controls.crop.value = False
    assert not cleanup.controls.corners[0].visible
    assert count(cleanup) == whole
    assert cleanup.browser.shown == {}


def test_opacity_and_floaters_are_edits(cleanup):
    opacities = torch.cat([g.opacities for g in (cleanup.scene().scene.static, cleanup.scene().scene.dynamic)])
    cleanup.controls.opacity.value = round(float(opacities.median()), 2)
    cleanup.controls.floaters.value = True
    assert cleanup.edits == Edits(min_opacity=cleanup.controls.opacity.value, drop_floaters=True)
    assert note(cleanup) == "min_opacity, drop_floaters"
    assert count(cleanup) < len(opacities)


def test_undo_goes_back_edit_by_edit_and_a_slider_is_one(cleanup):
    cleanup.controls.floaters.value = True
    for value in (0.1, 0.2, 0.3):
        cleanup.controls.opacity.value = value
    cleanup.controls.undo.click()
    assert cleanup.edits == Edits(drop_floaters=True)
    assert cleanup.controls.opacity.value == 0.0
    cleanup.controls.undo.click()
    cleanup.controls.undo.click()
    assert cleanup.edits == Edits()
    assert cleanup.controls.floaters.value is False


def test_edits_that_leave_nothing_are_undone_with_a_reason(cleanup):
    before = cleanup.scene()
    cleanup.controls.opacity.value = 1.0
    assert cleanup.scene() is before
    assert cleanup.edits == Edits()
    assert note(cleanup).startswith("edits leave no Gaussian")


def test_an_edit_that_is_made_while_another_is_refused_stays(cleanup, monkeypatch):
    edited = cleanup.source.edited

    def slowly(edits):
        if edits.min_opacity == 1.0:
            cleanup.controls.opacity.value = 0.2
        return edited(edits)

    monkeypatch.setattr(cleanup.source, "edited", slowly)
    cleanup.controls.opacity.value = 1.0
    cleanup.scene()
    assert cleanup.edits == Edits(min_opacity=0.2)
    assert note(cleanup).startswith("edits leave no Gaussian")
    cleanup.controls.undo.click()
    assert cleanup.edits == Edits()


def test_undo_does_not_return_to_edits_that_were_refused(cleanup, monkeypatch):
    edited = cleanup.source.edited

    def slowly(edits):
        if edits == Edits(min_opacity=1.0):
            cleanup.controls.crop.value = True
            cleanup.controls.opacity.value = 0.2
        return edited(edits)

    monkeypatch.setattr(cleanup.source, "edited", slowly)
    cleanup.controls.opacity.value = 1.0
    cleanup.scene()
    undone = []
    while cleanup.edits != Edits():
        cleanup.controls.undo.click()
        undone.append(cleanup.edits)
    assert len(undone) == 2
    assert Edits(min_opacity=1.0) not in undone


@pytest.fixture
def with_objects(run):
    """A browser of a run whose dynamic Gaussians are two objects."""
    two_objects(run)
    return opened(run)


def two_objects(run):
    scene = Run.open(run, "cpu").trained_scene()
    write_objects(scene, run, 1 + np.arange(len(scene.scene.dynamic), dtype=np.int32) % 2)


def choose(cleanup, name, choice):
    cleanup.controls.object.value = name
    cleanup.controls.choice.value = choice
    cleanup.controls.choice.click()


def test_an_object_is_shown_alone_or_removed(with_objects):
    assert with_objects.controls.object.options == ("1", "2")
    whole, dynamic = count(with_objects), len(with_objects.scene().scene.dynamic)
    choose(with_objects, "2", REMOVE)
    assert with_objects.edits == Edits(remove="2")
    assert count(with_objects) == whole - dynamic // 2
    choose(with_objects, "1", REMOVE)
    assert count(with_objects) == whole - dynamic
    with_objects.controls.undo.click()
    with_objects.controls.undo.click()
    choose(with_objects, "1", ONLY)
    assert with_objects.edits == Edits(objects="1")
    assert count(with_objects) == dynamic - dynamic // 2


def test_an_object_is_frozen_at_the_current_time(with_objects):
    choose(with_objects, "1", FREEZE)
    choose(with_objects, "2", FREEZE)
    choose(with_objects, "1", FREEZE)
    assert with_objects.edits == Edits(freeze=(("2", 0.25), ("1", 0.25)))
    early, late = (with_objects.scene().splats(time).means for time in (0.0, 1.0))
    assert torch.equal(early, late)


def change(cleanup, name, what):
    cleanup.controls.object.value = name
    cleanup.controls.change.value = what
    cleanup.controls.change.click()


def test_an_object_is_recoloured_shifted_and_reset(with_objects):
    with_objects.controls.color.value, with_objects.controls.shift.value = (255, 51, 0), 0.25
    change(with_objects, "1", RECOLOR)
    choose(with_objects, "1", FREEZE)
    change(with_objects, "1", SHIFT)
    choose(with_objects, "2", REMOVE)
    assert with_objects.edits == Edits(recolor=(("1", 1.0, 0.2, 0.0),), shift=(("1", 0.25),), remove="2")
    choose(with_objects, "1", FREEZE)
    assert with_objects.edits.shift == ()
    change(with_objects, "1", RESET)
    assert with_objects.edits == Edits(remove="2")
    change(with_objects, "2", RESET)
    assert with_objects.edits == Edits()


@pytest.mark.parametrize("sent", [(1e9, -5, np.nan), (300, 0, -1)])
def test_colours_and_times_that_a_browser_sends_are_clamped(with_objects, sent):
    with_objects.controls.color.value, with_objects.controls.shift.value = sent, 99.0
    change(with_objects, "1", RECOLOR)
    change(with_objects, "1", SHIFT)
    assert with_objects.edits == Edits(recolor=(("1", 1.0, 0.0, 0.0),), shift=(("1", 1.0),))


def drag(cleanup, low, high, modifier=None):
    """Draws a rectangle."""
    cleanup.controls.tool.value = RECTANGLE
    event = SimpleNamespace(screen_min=low, screen_max=high, modifier=modifier)
    cleanup.browser.heard["rect-select", modifier](event)


def click(cleanup, *points, modifier=None):
    for point in points:
        cleanup.browser.heard["click", modifier](SimpleNamespace(screen_pos=point, modifier=modifier))


def placed(cleanup):
    """[N, 2] positions on the screen of all Gaussians that are shown, in [0, 1]."""
    request = asked(cleanup, cleanup.panel)
    seen = request.seen
    means = request.scene.splats(request.time).means
    positions, *_ = seen.place(means @ seen.viewmat[:3, :3].T + seen.viewmat[:3, 3])
    return positions.numpy() / CANVAS


def selected(cleanup):
    return cleanup.selection.selected.mask


def test_a_rectangle_selects_the_centres_inside(cleanup):
    drag(cleanup, (0.25, 0.25), (0.5, 0.75))
    at = placed(cleanup)
    near = np.abs(at - [[0.5, 0.75]]).min(1) < 0.02
    near |= np.abs(at - 0.25).min(1) < 0.02
    expected = ((at > [0.25, 0.25]) & (at < [0.5, 0.75])).all(1)
    assert np.array_equal(selected(cleanup)[~near], expected[~near])
    assert 5 < expected.sum() < len(expected) - 5
    assert note(cleanup) == f"{selected(cleanup).sum():,} of {len(at):,} Gaussians are selected"


def test_control_removes_from_the_selection_and_others_add_to_it(cleanup):
    drag(cleanup, (0.0, 0.0), (0.5, 1.0))
    left = selected(cleanup)
    drag(cleanup, (0.5, 0.0), (1.0, 1.0))
    whole = selected(cleanup)
    assert left.sum() < whole.sum()
    drag(cleanup, (0.5, 0.0), (1.0, 1.0), "cmd/ctrl")
    assert not (selected(cleanup) & ~left).any()
    drag(cleanup, (0.0, 0.0), (1.0, 1.0), "cmd/ctrl")
    assert cleanup.selection.selected is None


def test_a_lasso_is_closed_at_its_first_corner(cleanup):
    cleanup.controls.tool.value = LASSO
    corners = (0.0, 0.0), (1.0, 0.0), (0.0, 1.0)
    click(cleanup, *corners)
    assert cleanup.selection.marks.outline == corners
    assert cleanup.selection.selected is None
    click(cleanup, (0.01, 0.01))
    assert cleanup.selection.marks.outline == ()
    total = placed(cleanup).sum(1)
    assert selected(cleanup)[total < 0.98].all()
    assert not selected(cleanup)[total > 1.02].any()
    assert 5 < selected(cleanup).sum() < len(total) - 5


def test_a_brush_selects_around_a_click(cleanup):
    cleanup.controls.radius.value = 40.0
    cleanup.controls.tool.value = BRUSH
    click(cleanup, (0.5, 0.5))
    distances = np.linalg.norm((placed(cleanup) - 0.5) * CANVAS, axis=1)
    assert selected(cleanup)[distances < 38].all()
    assert not selected(cleanup)[distances > 42].any()
    assert 0 < selected(cleanup).sum() < len(distances)


def test_dynamic_gaussians_are_selected_where_they_are_shown(cleanup):
    for time in (0.0, 1.0):
        cleanup.panel.current_time = time
        cleanup.selection.clear()
        drag(cleanup, (0.0, 0.0), (0.5, 1.0))
        left = placed(cleanup)[:, 0]
        sure = np.abs(left - 0.5) > 0.01
        assert np.array_equal(selected(cleanup)[sure], left[sure] < 0.5)


def test_a_layer_selects_only_what_it_shows(cleanup):
    cleanup.panel.current_layer = "dynamic"
    drag(cleanup, (0.0, 0.0), (1.0, 1.0))
    static = len(cleanup.source.current().scene.static)
    assert not selected(cleanup)[:static].any()
    assert selected(cleanup)[static:].all()


def test_what_is_hidden_can_be_left_out(cleanup, monkeypatch):
    size = len(placed(cleanup))
    weights = torch.arange(size) % 2
    monkeypatch.setattr("warpgs.viewer.selection.blend_weights_in", lambda *_: weights.float())
    cleanup.controls.seen.value = True
    drag(cleanup, (0.0, 0.0), (1.0, 1.0))
    assert np.array_equal(selected(cleanup), weights.numpy() == 1)


def test_what_is_selected_is_inverted_cleared_deleted_and_undone(cleanup):
    whole, woken = count(cleanup), len(cleanup.woken)
    drag(cleanup, (0.0, 0.0), (0.5, 1.0))
    left = selected(cleanup)
    use(cleanup, INVERT)
    assert np.array_equal(selected(cleanup), ~left)
    use(cleanup, CLEAR)
    assert cleanup.selection.selected is None
    drag(cleanup, (0.0, 0.0), (0.5, 1.0))
    use(cleanup, DELETE)
    assert cleanup.edits == Edits(erased=Marked.of(left))
    assert cleanup.selection.selected is None
    assert count(cleanup) == whole - left.sum()
    drag(cleanup, (0.5, 0.0), (1.0, 0.5))  # rows of the scene without edits, also after some are gone
    more = selected(cleanup)
    assert not (more & left).any()
    use(cleanup, DELETE)
    assert count(cleanup) == whole - (left | more).sum()
    cleanup.controls.undo.click()
    cleanup.controls.undo.click()
    assert count(cleanup) == whole
    assert len(cleanup.woken) > woken


def use(cleanup, choice):
    cleanup.controls.selected.value = choice
    cleanup.controls.selected.click()


def test_inverting_leaves_out_what_is_gone(cleanup):
    drag(cleanup, (0.0, 0.0), (0.5, 1.0))
    left = selected(cleanup)
    use(cleanup, DELETE)
    use(cleanup, INVERT)
    assert np.array_equal(selected(cleanup), ~left)


def test_without_a_tool_clicks_are_not_heard(cleanup):
    cleanup.controls.tool.value = LASSO
    click(cleanup, (0.5, 0.5))
    cleanup.controls.tool.value = OFF
    assert cleanup.browser.heard == {}
    assert cleanup.selection.marks.outline == ()


@pytest.mark.parametrize("position", [(np.nan, 0.5), (0.5, np.inf), (0.5,), ("a", 0.5), None])
def test_positions_that_no_screen_has_are_ignored(cleanup, position):
    cleanup.controls.tool.value = LASSO
    click(cleanup, position)
    drag(cleanup, position, (1.0, 1.0))
    assert cleanup.selection.marks == NO_MARKS


def test_what_is_selected_is_tinted_in_the_image(cleanup):
    drag(cleanup, (0.0, 0.0), (0.5, 1.0))
    plain = asked(cleanup, cleanup.panel)
    marked = plain._replace(marks=cleanup.selection.marks)
    renderer = Renderer(threading.Lock())
    before, after = (renderer.render(request, 1.0).image.astype(int) for request in (plain, marked))
    changed = np.abs(after - before).sum(2)
    assert changed[:, :160].sum() > 2 * changed[:, 160:].sum()
    outline = renderer.render(plain._replace(marks=Marks(None, ((0.25, 0.5), (0.75, 0.5)))), 1.0).image
    assert np.abs(outline[120, 80] - np.array(LINE)).max() < 3


def test_deleted_gaussians_are_gone_in_all_commands(cleanup, run):
    drag(cleanup, (0.0, 0.0), (0.5, 1.0))
    left = selected(cleanup)
    use(cleanup, DELETE)
    cleanup.controls.save.click()
    assert read_edits(run / NAME)[0] == cleanup.edits
    later, whole = opened(run), Run.open(run, "cpu").trained_scene()
    assert torch.equal(later.scene().splats(0.3).means, whole.splats(0.3).means[~torch.from_numpy(left)])


def test_a_new_run_has_the_checkpoint_and_the_edits(cleanup, run):
    drag(cleanup, (0.0, 0.0), (0.5, 1.0))
    use(cleanup, DELETE)
    cleanup.controls.name.value = "cleaned"
    cleanup.controls.copy.click()
    assert note(cleanup) == "saved as cleaned, beside this run"
    copy = run.parent / "cleaned"
    assert not (run / NAME).exists()
    assert count(opened(copy)) == count(cleanup)
    assert torch.equal(Run.open(copy, "cpu").trained_scene().splats(0.3).means, cleanup.whole.splats(0.3).means)
    cleanup.controls.copy.click()
    assert "exists already: choose another name" in note(cleanup)


def test_images_are_rendered_while_a_new_run_is_written(cleanup, run, monkeypatch):
    was_locked = []
    save = of_runs.save_edits

    def watched(*arguments):
        was_locked.append(cleanup._rendering.locked())
        return save(*arguments)

    monkeypatch.setattr(of_runs, "save_edits", watched)
    cleanup.controls.name.value = "cleaned"
    cleanup.controls.copy.click()
    assert note(cleanup) == "saved as cleaned, beside this run"
    assert was_locked == [False]


@pytest.mark.parametrize("name", ["", "../other", ".hidden", "a/b"])
def test_a_new_run_needs_a_name_of_a_folder(cleanup, run, name):
    before = sorted(run.parent.iterdir())
    cleanup.controls.name.value = name
    cleanup.controls.copy.click()
    assert "the name of a run must have" in note(cleanup)
    assert sorted(run.parent.iterdir()) == before


def test_a_run_that_was_trained_further_is_not_copied(cleanup, run):
    advance(run)
    cleanup.controls.name.value = "later"
    cleanup.controls.copy.click()
    assert "open it again" in note(cleanup)
    assert not (run.parent / "later").exists()


def test_the_layer_of_objects_needs_no_edits(with_objects):
    assert {*with_objects.scene().splats(0.5).objects.tolist()} == {0, 1, 2}


def test_objects_are_found_when_they_are_first_asked_for_and_then_for_all_browsers(run, monkeypatch):
    monkeypatch.setattr(
        "warpgs.editing.objects.find_objects", lambda scene: np.ones(len(scene.scene.dynamic), np.int32)
    )
    cleanup = opened(run)
    other = visited(cleanup.source)
    assert not (run / OBJECTS).exists()
    assert not cleanup.controls.object.visible
    assert other.scene().splats(0.5).objects is None
    cleanup.panel.current_layer = "objects"
    cleanup.panel.layer.value = "objects"
    assert (run / OBJECTS).exists()
    for browser in (cleanup, other):
        assert 1 in browser.scene().splats(0.5).objects
        assert browser.controls.object.options == ("1",)
        assert not browser.controls.find.visible
    assert note(cleanup).startswith("objects: 1 (")


def test_the_button_finds_objects(run):
    cleanup = opened(run)
    assert cleanup.controls.find.visible
    cleanup.controls.find.click()
    assert (run / OBJECTS).exists()
    assert cleanup.scene().splats(0.5).objects is not None


def test_objects_of_a_training_that_is_followed_are_not_found(run):
    cleanup = visited(open_source(run, "cpu", True))
    cleanup.controls.find.click()
    assert not cleanup.controls.find.visible
    assert not (run / OBJECTS).exists()
    assert note(cleanup).startswith("objects are found in finished runs")


def test_objects_that_there_are_not_cannot_be_chosen(with_objects):
    choose(with_objects, "7", REMOVE)
    assert with_objects.edits == Edits()


@pytest.mark.parametrize("position", [(np.nan, 0.0, 0.0), (1e30, 0.0, 0.0)])
def test_positions_that_no_box_has_are_refused(cleanup, position):
    cleanup.controls.crop.value = True
    before = cleanup.edits
    cleanup.browser.shown["/crop/to"].drag(position)
    assert cleanup.edits == before
    assert "--crop must be six numbers" in note(cleanup)
    assert cleanup.browser.shown["/crop/to"].position == pytest.approx(before.crop[3:])


def test_saved_edits_are_those_that_the_next_viewer_begins_with(cleanup, run):
    cleanup.controls.crop.value = True
    cleanup.controls.floaters.value = True
    cleanup.controls.save.click()
    assert read_edits(run / NAME)[0] == cleanup.edits
    assert note(cleanup) == "saved as edits.json"
    later = opened(run)
    assert later.edits == cleanup.edits
    assert later.controls.crop.value is True
    assert count(later) == count(cleanup)
    assert "/crop/from" in later.browser.shown


def test_edits_that_leave_nothing_are_not_saved(cleanup, run):
    cleanup.controls.opacity.value = 1.0
    cleanup.controls.save.click()
    assert note(cleanup).startswith("edits leave no Gaussian")
    assert not (run / NAME).exists()


def test_edits_of_the_command_can_be_changed_in_the_browser(run):
    cleanup = opened(run, Editing(Edits(max_gaussians=9)))
    assert count(cleanup) == 9
    cleanup.controls.floaters.value = True
    assert cleanup.edits == Edits(max_gaussians=9, drop_floaters=True)
    cleanup.controls.undo.click()
    cleanup.controls.undo.click()
    assert cleanup.edits == Edits(max_gaussians=9)


def test_browsers_share_the_scenes_of_the_last_edits(cleanup):
    other = visited(cleanup.source)
    for browser in (cleanup, other):
        browser.controls.floaters.value = True
    assert cleanup.scene() is other.scene()
    for k in range(5):
        cleanup.source.edited(Edits(max_gaussians=k + 1))
    assert len(cleanup.source._edited) == MAX_EDITED


def test_a_page_that_is_reloaded_keeps_its_edits(cleanup):
    cleanup.controls.crop.value = True
    other = visited(cleanup.source)
    other.restore(cleanup.edits)
    assert other.controls.crop.value is True
    assert count(other) == count(cleanup)


def test_a_training_that_is_followed_is_not_edited(run):
    cleanup = visited(open_source(run, "cpu", True))
    assert cleanup.controls.crop.disabled
    cleanup.controls.floaters.value = True
    cleanup.controls.save.click()
    assert cleanup.edits == Edits()
    assert not (run / NAME).exists()


def test_nothing_is_selected_in_a_training_that_is_followed_whatever_a_browser_sends(run):
    """Its Gaussians change with each checkpoint."""
    cleanup = visited(open_source(run, "cpu", True))
    cleanup.controls.tool.value = RECTANGLE
    drag(cleanup, (0.0, 0.0), (1.0, 1.0))
    assert cleanup.selection.selected is None


def test_a_box_has_twelve_edges_along_its_axes():
    edges = box_edges(np.zeros(3, np.float32), np.float32([1, 2, 3]))
    along = np.abs(edges[:, 1] - edges[:, 0])
    assert sorted(along.sum(1).tolist()) == [1] * 4 + [2] * 4 + [3] * 4
    assert ((along > 0).sum(1) == 1).all()
    assert len({tuple(sorted(map(tuple, edge.tolist()))) for edge in edges}) == 12
