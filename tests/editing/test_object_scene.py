"""Edits of objects change the Gaussians of these objects at all times, and no others."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.editing import moving
from tests.export import scenes
from warpgs.editing.edited_scene import edited, with_edits, with_ids
from warpgs.editing.marked import Marked
from warpgs.editing.object_scene import with_objects
from warpgs.editing.objects import Objects
from warpgs.editing.options import Editing, Edits
from warpgs.model.gaussians import SH_C0

STATIC, FIRST, SECOND = slice(0, 40), slice(40, 240), slice(240, 390)
TIMES = (0.0, 0.3, 0.75, 1.0)
GEOMETRY = ("means", "quats", "scales", "opacities")


@pytest.fixture(scope="module")
def scene():
    return moving.scene()


def rows_equal(a, b, rows, names=(*GEOMETRY, "sh")):
    return all(torch.equal(getattr(a, name)[rows], getattr(b, name)[rows]) for name in names)


@pytest.mark.parametrize(
    ("edits", "kept"),
    [
        (Edits(objects="2"), [SECOND]),
        (Edits(objects="2, 1"), [FIRST, SECOND]),
        (Edits(objects="0,1"), [STATIC, FIRST]),
        (Edits(remove="1"), [STATIC, SECOND]),
        (Edits(objects="1,2", remove="1"), [SECOND]),
    ],
)
def test_objects_are_kept_and_removed_by_their_numbers(scene, edits, kept):
    part = edited(scene, edits)
    for time in TIMES:
        assert torch.equal(part.splats(time).means, torch.cat([scene.splats(time).means[rows] for rows in kept]))


def test_a_frozen_object_is_as_at_its_time_while_others_move(scene):
    frozen = edited(scene, Edits(freeze=(("1", 0.3),)))
    for time in TIMES:
        assert rows_equal(frozen.splats(time), scene.splats(0.3), FIRST)
        assert rows_equal(frozen.splats(time), scene.splats(time), STATIC)
        assert rows_equal(frozen.splats(time), scene.splats(time), SECOND)


def test_a_rolling_shutter_sees_objects_at_the_times_of_its_rows_and_frozen_ones_at_theirs(scene):
    camera = dataclasses.replace(scenes.camera(), motion=torch.zeros(2, 3), duration=0.4)
    frozen = edited(scene, Edits(freeze=(("1", 0.3),))).splats(0.5, camera=camera)
    assert rows_equal(frozen, scene.splats(0.3), FIRST)
    assert rows_equal(frozen, scene.splats(0.5, camera=camera), SECOND)
    assert not rows_equal(frozen, scene.splats(0.5), SECOND, ["means"])


@pytest.mark.parametrize(("shift", "then"), [(0.5, 0.25), (-0.125, 0.875), (1.0, 0.0), (-1.0, 1.0)])
def test_a_shifted_object_moves_later_and_stands_still_beyond_its_ends(scene, shift, then):
    shifted = edited(scene, Edits(shift=(("2", shift),))).splats(0.75)
    assert rows_equal(shifted, scene.splats(then), SECOND)
    assert rows_equal(shifted, scene.splats(0.75), FIRST)


def test_objects_that_are_edited_can_be_cropped(scene):
    inside = (-0.85, -9.0, -9.0, 9.0, 9.0, 9.0)
    both = edited(scene, Edits(freeze=(("1", 0.0), ("2", 1.0)), objects="1,2", crop=inside))
    means = scene.splats(0.0).means[FIRST], scene.splats(1.0).means[SECOND]
    left = torch.cat([part[part[:, 0] >= -0.85] for part in means])
    assert 0 < len(left) < 300
    assert torch.equal(both.splats(0.6).means, left)


def test_erased_gaussians_are_gone_and_objects_keep_their_numbers(scene):
    mask = np.arange(390) % 3 == 0
    mask[FIRST] = True  # all of object 1
    part = edited(scene, Edits(erased=Marked.of(mask), freeze=(("2", 0.3),), min_opacity=0.0))
    left = np.flatnonzero(~mask)
    assert part.rows.tolist() == left.tolist()
    assert {*part.splats(0.5).objects.tolist()} == {0, 2}
    then = scene.splats(0.3).means
    assert torch.equal(part.splats(0.8).means[-100:], then[left[-100:]])
    cropped = edited(scene, Edits(erased=Marked.of(mask), crop=(-9.0, -9.0, -9.0, 0.0, 9.0, 9.0)))
    assert torch.equal(cropped.splats(0.5).means, scene.splats(0.5).means[cropped.rows])
    assert 0 < len(cropped.rows) < len(left)


def test_erased_gaussians_of_another_scene_are_refused(scene):
    with pytest.raises(ValueError, match="edits erase some of 9 Gaussians, but the scene has 390"):
        edited(scene, Edits(erased=Marked.of(np.arange(9) > 3)))


def brightness(sh):
    return (0.5 + SH_C0 * sh[:, 0]) @ torch.tensor([0.299, 0.587, 0.114])


def test_an_object_gets_shades_of_a_colour_by_the_brightness_of_its_gaussians(scene):
    before = scene.splats(0.3)
    after = edited(scene, Edits(recolor=(("1", 0.2, 0.4, 0.8),))).splats(0.3)
    colors = 0.5 + SH_C0 * after.sh[FIRST, 0]
    assert torch.allclose(colors / colors[:, 2:], torch.tensor([0.25, 0.5, 1.0]).expand(200, 3), atol=1e-4)
    ratio = brightness(after.sh[FIRST]) / brightness(before.sh[FIRST])
    assert torch.allclose(ratio, ratio.mean(), rtol=1e-3)
    assert rows_equal(after, before, SECOND)
    assert rows_equal(after, before, FIRST, GEOMETRY)


def test_the_mean_of_an_object_has_its_new_colour(scene):
    scene.scene.dynamic.sh_dc.clamp_(-1.0, 1.0)
    sh = edited(scene, Edits(recolor=(("2", 0.9, 0.1, 0.3),))).splats(0.0).sh
    assert (0.5 + SH_C0 * sh[SECOND, 0]).mean(0).tolist() == pytest.approx([0.9, 0.1, 0.3], abs=1e-3)


def of_later_segment():
    """A scene with two segments of time, and an object that only the second one has."""
    scene = scenes.trained_scene(segments=2)
    ids = np.concatenate([np.zeros(40, np.int32), scene.scene.dynamic.segments.numpy().astype(np.int32)])
    return scene, Objects(ids, ("1",), 20)


def test_an_object_of_a_later_segment_gets_its_new_colour():
    scene, objects = of_later_segment()
    sh = with_objects(scene, objects, Edits(recolor=(("1", 0.6, 0.2, 0.4),))).splats(1.0).sh
    colors = 0.5 + SH_C0 * sh[torch.from_numpy(objects.ids == 1), 0]
    assert colors.mean(0).tolist() == pytest.approx([0.6, 0.2, 0.4], abs=1e-3)


@pytest.mark.parametrize("edits", [Edits(freeze=(("1", 0.5),)), Edits(shift=(("1", 0.1),))])
def test_objects_of_several_segments_keep_their_times(edits):
    option = "freeze" if edits.freeze else "shift"
    expected = f"--{option}: this scene has 2 segments of time, expected one: train it with --model.segments 1"
    with pytest.raises(ValueError, match=expected):
        with_objects(*of_later_segment(), edits)


def test_lines_about_objects_of_several_segments_say_that_each_has_its_own(tmp_path):
    _, notes = with_ids(with_objects(*of_later_segment(), Edits()), tmp_path)
    assert notes[1:] == ["each segment of time has numbers of its own: name all that an object has"]


def test_recoloured_gaussians_keep_how_colours_depend_on_the_direction(scene):
    """In an image: the colour from every side is a shade of the new one."""
    alone = edited(scene, Edits(objects="1", recolor=(("1", 0.3, 0.6, 0.3),)))
    image = alone.render(scenes.camera(), time=0.5).joint.image
    shown = image[image[..., 1] > 0.1]
    assert len(shown) > 100
    assert torch.allclose(shown[:, 0], shown[:, 1] / 2, atol=1e-3)
    assert shown[:, 1].std() > 0.01


def test_a_box_makes_an_object_of_the_static_gaussians_inside(scene):
    box = ("table", 0.0, -9.0, -9.0, 9.0, 9.0, 9.0)
    inside = scene.scene.static.means[:, 0] >= 0.0
    alone = edited(scene, Edits(box=(box,), objects="table"))
    assert torch.equal(alone.splats(0.4).means, scene.scene.static.means[inside])
    without = edited(scene, Edits(box=(box,), remove="table"))
    assert torch.equal(without.splats(0.4).means[: (~inside).sum()], scene.scene.static.means[~inside])
    assert len(without.scene.dynamic) == 350


def test_splats_have_the_numbers_of_their_objects(scene):
    box = ("table", -9.0, -9.0, -9.0, 9.0, 9.0, 9.0)
    ids = edited(scene, Edits(box=(box,), remove="1")).splats(0.2).objects
    assert ids.tolist() == [3] * 40 + [2] * 150
    assert scene.splats(0.2).objects is None


def test_the_scene_whose_objects_are_edited_stays_as_it_is(scene):
    before = {name: tensor.clone() for name, tensor in scene.scene.state_dict().items()}
    edited(scene, Edits(freeze=(("1", 0.5),), recolor=(("2", 1.0, 0.0, 0.0),))).splats(0.2)
    assert isinstance(scene.scene.deformation, moving.Passing)
    assert all(torch.equal(tensor, before[name]) for name, tensor in scene.scene.state_dict().items())


def test_objects_to_remove_are_those_of_the_whole_scene(scene, tmp_path):
    """Numbers do not change when other edits have removed Gaussians."""
    known, notes = with_ids(scene, tmp_path)
    assert notes == ["objects: 1 (200 Gaussians), 2 (150 Gaussians)"]
    cropped = edited(known, Edits(crop=(-9.0, -9.0, -9.0, -1.1, 9.0, 9.0)))
    assert {1, 2} <= {*cropped.splats(0.0).objects.tolist()}


def test_lines_about_objects_name_those_in_boxes(scene, tmp_path):
    edits = Edits(box=(("table", -9.0, -9.0, -9.0, 9.0, 9.0, 9.0),), remove="1")
    _, notes = with_edits(scene, tmp_path, Editing(edits), lambda: None)
    listed = "objects: 1 (200 Gaussians), 2 (150 Gaussians), 3 table (40 Gaussians)"
    assert notes == [listed, "edits keep 190 of 390 Gaussians"]


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        (Edits(objects="3"), "--objects 3: there is no such object; the objects of this scene are: 1, 2"),
        (Edits(remove="1,tree"), "--remove tree: there is no such object"),
        (Edits(objects=""), "--objects : there is no such object"),
        (Edits(remove=""), "--remove : there is no such object"),
        (Edits(freeze=(("5", 0.5),)), "--freeze 5: there is no such object"),
        (Edits(freeze=(("0", 0.5),)), "--freeze 0: this object has no dynamic Gaussians"),
        (Edits(freeze=(("1", 1.5),)), r"--freeze 1 must be in \[0, 1\], got 1.5"),
        (Edits(shift=(("1", float("nan")),)), r"--shift 1 must be in \[-1, 1\]"),
        (Edits(freeze=(("1", 0.5),), shift=(("1", 0.5),)), "--freeze or --shift was given twice for 1"),
        (Edits(recolor=(("1", 0.5, 2.0, 0.0),)), r"--recolor 1 must be in \[0, 1\], got 0.5 2 0"),
        (Edits(box=(("a", 8.0, 8.0, 8.0, 9.0, 9.0, 9.0),)), "--box a has no static Gaussians inside"),
        (Edits(box=(("a", 8.0, 8.0, 8.0, 8.0, 9.0, 9.0),)), "--box a must be opposite corners"),
        (Edits(box=(("1", 0.0, 0.0, 0.0, 9.0, 9.0, 9.0),)), "--box must have a name that begins with a letter"),
        (Edits(remove="0,1,2"), "edits leave no Gaussian"),
    ],
)
def test_edits_of_objects_that_cannot_be_made_are_refused(scene, edits, message):
    with pytest.raises(ValueError, match=message):
        edited(scene, edits)


@pytest.mark.parametrize(
    ("count", "reason"),
    [(0, "nothing in this scene is dynamic"), (3, "no group of the 3 dynamic Gaussians stays together")],
)
def test_why_there_are_no_objects_is_said(count, reason):
    message = f"the objects of this scene are: none, because {reason}; --box makes one of static Gaussians"
    with pytest.raises(ValueError, match=message):
        edited(moving.scene(count, 0), Edits(remove="1"))
