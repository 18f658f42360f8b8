"""A start is what remedies make of a capture, and a trainer takes it as it is."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch

from tests import plain, tiny
from warpgs.captures.opening import load_capture
from warpgs.initialization import prepare_start as module
from warpgs.initialization.prepare_start import prepare_start
from warpgs.initialization.start import Remedy
from warpgs.training.trainer import Trainer


@pytest.fixture(scope="module")
def capture(data):
    return load_capture(data)


def test_remedies_that_apply_change_the_start_in_their_order(capture, monkeypatch):
    remedies = {
        "a": Remedy(lambda start: True, lambda start: start.noted("first")),
        "b": Remedy(lambda start: "first" not in start.notes, lambda start: start.noted("unneeded")),
        "c": Remedy(lambda start: "first" in start.notes, lambda start: start.noted("last")),
    }
    monkeypatch.setattr(module, "REMEDIES", remedies)
    assert prepare_start(tiny.CONFIG, capture).notes == ("first", "last")


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_remedies_use_what_the_views_hold_instead_of_decoding_frames_again(data, resident_bytes):
    config = dataclasses.replace(tiny.CONFIG, resident_bytes=resident_bytes, loss=plain.loss(object_depth=True))
    start = prepare_start(config, load_capture(data))
    start.capture._cached = Mock()
    start.alignments.fill_(torch.nan)  # so that depth by size is looked for
    for name in ("exposure", "empty masks", "alignment of depth", "depth by size", "lack of motion"):
        module.REMEDIES[name].apply(start)
    start.capture._cached.assert_not_called()


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_frames_that_views_hold_are_not_kept_by_the_capture(data, resident_bytes):
    capture = load_capture(data)
    prepare_start(dataclasses.replace(tiny.CONFIG, resident_bytes=resident_bytes), capture)
    assert (capture._cached.cache_info().currsize == 0) == (resident_bytes > 0)


@pytest.mark.parametrize("assume", ["static", "dynamic"])
def test_masks_that_are_not_used_are_not_doubted(capture, assume):
    start = prepare_start(dataclasses.replace(tiny.CONFIG, assume=assume), capture)
    assert not module.REMEDIES["empty masks"].applies(start)


@pytest.mark.parametrize(("assume", "steps"), [("masks", tiny.SCHEDULE.fit_motion), ("dynamic", 0)])
def test_the_plan_fits_motion_only_where_masks_and_depth_show_it(capture, assume, steps):
    plan = prepare_start(dataclasses.replace(tiny.CONFIG, assume=assume), capture).plan
    assert plan.schedule.fit_motion == steps


def test_a_jump_of_exposure_is_divided_out_of_the_views_and_noted(capture, monkeypatch):
    gains = torch.ones(len(capture.train), 3)
    gains[1] = 2.0
    monkeypatch.setattr(module, "exposure_gains", lambda views: gains)
    plain, evened = (prepare_start(dataclasses.replace(tiny.CONFIG, exposure=on), capture) for on in (False, True))
    assert torch.allclose(evened.views[1].image, plain.views[1].image / 2.0, atol=1 / 255)
    assert torch.equal(evened.views[0].image, plain.views[0].image)
    sentence = "exposure jumps: 1 frame divided by 1.00 to 2.00"
    assert (sentence in evened.notes, sentence in plain.notes) == (True, False)


def test_a_trainer_reads_no_frame_before_it_trains(capture, tmp_path):
    start, read = prepare_start(tiny.CONFIG, capture), Mock()
    Trainer(dataclasses.replace(start, capture=dataclasses.replace(start.capture, read=read)), tmp_path)
    read.assert_not_called()
