"""Which cameras the steps of a preparation accept."""

import dataclasses

import numpy as np
import pytest

from warpgs.data.lens import Lens
from warpgs.prepare import steps as module
from warpgs.prepare.cameras.recovered import Cameras, NoCamerasError
from warpgs.prepare.frames.take import Frames, SourceFrame
from warpgs.prepare.journal import Journal
from warpgs.prepare.masks.files import Masks
from warpgs.prepare.options import Options
from warpgs.prepare.steps import Steps

NAMES = [f"frame_{k:06d}" for k in range(10)]
FIRST = Cameras(NAMES, Lens.centered(500.0, (64, 48)), np.tile(np.eye(4)[:3], (10, 1, 1)), np.ones((9, 3)), 1.0, 5.0)


@pytest.fixture
def steps(tmp_path):
    frames = Frames(tmp_path, [SourceFrame(name, f"{name}.jpg", k, k) for k, name in enumerate(NAMES)], 64, 48, 1.0)
    return Steps([frames], Options(), Journal(tmp_path / "made", {}, force=False, log=None))


def with_frames(count):
    return dataclasses.replace(FIRST, names=NAMES[:count], poses=FIRST.poses[:count])


@pytest.mark.parametrize(("kept", "used"), [(10, 10), (8, 8), (7, 10)])
def test_a_second_pass_is_used_unless_it_omits_many_frames(steps, monkeypatch, kept, used):
    monkeypatch.setattr(module, "recover_cameras", lambda *job: with_frames(kept))
    assert len(steps.refine("cameras", [FIRST], Masks())[0].names) == used
    reason = f"only {kept} of 10 frames have a camera"
    assert [note.endswith(reason) for note in steps.journal.notes] == [True] * (used != kept)


def test_the_video_that_loses_many_frames_in_the_second_pass_is_named(steps, monkeypatch):
    videos = [dataclasses.replace(steps.videos[0], source=f"{name}.mp4") for name in "ab"]
    monkeypatch.setattr(module, "recover_several", lambda *job: [with_frames(10), with_frames(7)])
    dataclasses.replace(steps, videos=videos).refine("cameras", [FIRST, FIRST], Masks())
    assert steps.journal.notes[0].endswith(r"only 7 of 10 frames of b.mp4 have a camera")


@pytest.mark.parametrize("found", [4, 5])
def test_half_of_all_frames_need_a_camera_even_if_some_were_omitted_before(steps, monkeypatch, found):
    monkeypatch.setattr(module, "recover_cameras", lambda *job: with_frames(found))
    if found == 5:
        assert len(steps.recover("cameras", [NAMES[:7]])[0].names) == 5
        return
    with pytest.raises(NoCamerasError, match=r"found for only 4 of 10 frames"):
        steps.recover("cameras", [NAMES[:7]])
