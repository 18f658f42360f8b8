"""Doubts about masks and lenses that a preparation has found."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.prepare import boards
from warpgs.captures.check import check_capture
from warpgs.prepare.cameras.posed_frames import PosedFrames
from warpgs.prepare.cameras.recovered import Cameras
from warpgs.prepare.doubts import doubts_of_lens, doubts_of_masks, doubts_of_motion
from warpgs.prepare.options import Options
from warpgs.prepare.pipeline import prepare


def columns(*counts: int) -> list[np.ndarray]:
    """[4, 100] masks of this many columns on the left."""
    return [np.tile(np.arange(100) < count, (4, 1)) for count in counts]


@pytest.mark.parametrize(("crowded", "noted"), [(1, False), (2, True)])
def test_masks_of_which_a_quarter_mark_much_are_doubtful(crowded, noted):
    masks = columns(*[35] * crowded, *[5] * (8 - crowded))
    found = doubts_of_masks(masks, True)
    assert [text.split(": ")[1] for text in found] == ["look at masks.png"] * noted
    assert not noted or f"in {crowded} of 8 frames" in found[0]
    assert doubts_of_masks(masks, False) == []


@pytest.mark.parametrize(("held", "noted"), [(3, True), (5, False)])
def test_masks_without_what_does_not_move_with_the_background_are_doubtful(held, noted):
    found = doubts_of_masks(columns(held, held), True, columns(20, 20))
    assert len(found) == noted
    assert not noted or "the masks hold only 15% of what does not move with the background" in found[0]


def test_hardly_anything_that_does_not_move_with_the_background_says_nothing_of_masks():
    off = columns(1, 0, 0)
    assert doubts_of_masks(columns(0, 5, 5), True, off) == []


@pytest.mark.parametrize(("factor", "noted"), [(0.3, True), (0.5, False), (2.9, False), (3.1, True)])
def test_a_focal_length_that_few_lenses_have_is_doubtful(factor, noted):
    lens = dataclasses.replace(boards.lens(), focal=(factor * boards.SIZE[0],) * 2)
    cameras = Cameras(["a"], lens, boards.poses(2)[:1], boards.points(), 0.1, 10.0)
    found = [text.split(" times")[0] for text in doubts_of_lens(cameras)]
    assert found == [f"the focal length that was found is {factor}"] * noted


def test_a_wide_fisheye_lens_is_not_doubtful():
    lens = dataclasses.replace(boards.lens(), focal=(0.3 * boards.SIZE[0],) * 2, model="fisheye")
    assert doubts_of_lens(Cameras(["a"], lens, boards.poses(2)[:1], boards.points(), 0.1, 10.0)) == []


def test_a_focal_length_that_was_held_for_the_second_pass_is_noted(tmp_path, monkeypatch):
    images, masks = boards.record(12)
    shots, held = boards.write_folder(tmp_path / "shots", images), []

    def recover(folder, names, work, settings, *rest):
        held.append(settings.focal)
        found = boards.true_cameras(folder, names)
        return dataclasses.replace(found, has_held_focal=not settings.refine)

    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", recover)
    monkeypatch.setattr("warpgs.prepare.steps.off_background", lambda images, quiet: masks)
    monkeypatch.setattr("warpgs.prepare.masks.methods.find_dynamic", lambda *rest: masks)
    notes = prepare(shots, tmp_path / "made", Options(depth="none"))["notes"]
    assert held == [None, boards.FOCAL]
    ratio = boards.FOCAL / boards.SIZE[0]
    assert [note.split(" of the frames")[0] for note in notes] == [
        f"the focal length is a guess, {ratio:.1f} times the longer side"
    ]


@pytest.mark.parametrize(("num_wrong", "noted"), [(0, False), (6, True)])
def test_cameras_that_do_not_explain_the_motion_in_the_images_are_doubtful(num_wrong, noted):
    images, _ = boards.record(12)
    poses, roll = boards.poses(12), Rotation.from_rotvec((0.0, 0.0, 0.1)).as_matrix()
    poses[: 2 * num_wrong : 2] = roll @ poses[: 2 * num_wrong : 2]  # every second one
    found = doubts_of_motion(PosedFrames(images, boards.lens(), poses, boards.points()))
    assert len(found) == noted
    assert not noted or found[0].endswith("or most of the image moves; look at masks.png")


def mark_left(frames: object, *rest: object) -> list[np.ndarray]:
    """Takes the place of ``find_dynamic``: some columns where nothing moves."""
    return [np.tile(np.arange(image.shape[1]) < 20, (image.shape[0], 1)) for image in frames.images]


def test_doubts_are_noted_and_the_check_warns_of_them(tmp_path, monkeypatch):
    """The masks miss the board, which does not move with the background."""
    images, masks = boards.record(12)
    shots = boards.write_folder(tmp_path / "shots", images)
    monkeypatch.setattr(
        "warpgs.prepare.steps.recover_cameras", lambda folder, names, *rest: boards.true_cameras(folder, names)
    )
    monkeypatch.setattr("warpgs.prepare.steps.off_background", lambda images, quiet: masks)
    monkeypatch.setattr("warpgs.prepare.masks.methods.find_dynamic", mark_left)
    notes = prepare(shots, tmp_path / "made", Options(depth="none"))["notes"]
    assert len(notes) == 1
    assert "what does not move with the background" in notes[0]
    warnings = [f.text for f in check_capture(tmp_path / "made").findings if f.level == "warning"]
    assert f"warpgs prepare noted: {notes[0]}" in warnings
