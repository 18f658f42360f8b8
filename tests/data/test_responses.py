"""Gains of several cameras, and how they drift, from the colours of points."""

import dataclasses
import re
import threading

import pytest
import torch

from tests import tiny
from warpgs.captures.opening import load_capture
from warpgs.data.responses import Response, camera_responses, in_response
from warpgs.evaluation.evaluate import evaluate
from warpgs.initialization.prepare_start import prepare_start
from warpgs.rendering import Layer, Rendering
from warpgs.synthetic.rig import RigSize, rig_capture

SIZE = RigSize(width=160, height=90, num_frames=2, num_samples=4, num_points=1000)
GAINS = {2: torch.tensor([1.25, 1.0, 0.8]), 4: torch.tensor([0.7, 0.75, 0.8])}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return rig_capture(tmp_path_factory.mktemp("cache"), SIZE, quiet=True)


@pytest.fixture(scope="module")
def plain(folder):
    return load_capture(folder)


def with_gains(capture, gains):
    """The capture with frames of some cameras multiplied by factors."""

    def read(name):
        frame = capture.frame(name)
        gain = gains.get(frame.camera.id, torch.ones(3))
        gain = gain(frame.camera.time) if callable(gain) else gain
        return dataclasses.replace(frame, image=(frame.image * gain).round().clamp(0, 255).byte())

    return dataclasses.replace(capture, read=read)


def test_gains_of_cameras_are_found(plain):
    found = camera_responses(with_gains(plain, GAINS))
    assert {*found} == {*GAINS}
    for i, gain in GAINS.items():
        assert found[i].at(0.5).tolist() == pytest.approx(gain.tolist(), rel=0.03)


def test_frames_are_compared_in_threads(plain):
    threads = set()
    read = lambda name: threads.add(threading.get_ident()) or plain.frame(name)  # noqa: E731
    camera_responses(dataclasses.replace(plain, read=read))
    assert threads
    assert threading.get_ident() not in threads


def test_cameras_that_are_alike_have_no_gains(plain):
    assert camera_responses(plain) == {}


def test_one_camera_has_no_gain(plain):
    alone = with_gains(plain, {1: torch.full((3,), 0.5)}).split(plain.by_camera(plain.train)[1], ())
    assert camera_responses(alone) == {}


def test_without_points_there_are_no_gains(plain):
    bare = dataclasses.replace(with_gains(plain, GAINS), points=torch.zeros(0, 3))
    assert camera_responses(bare) == {}


def test_a_camera_that_shares_no_points_keeps_its_gain(plain):
    away = {}
    for name in plain.by_camera(plain.train)[4]:
        viewmat = plain.cameras[name].viewmat.clone()
        viewmat[2, 3] = -100.0
        away[name] = dataclasses.replace(plain.cameras[name], viewmat=viewmat)
    found = camera_responses(with_gains(plain, GAINS).with_cameras(away))
    assert {*found} == {2}


def test_saturated_pixels_do_not_count(plain):
    found = camera_responses(with_gains(plain, {3: torch.full((3,), 1.5)}))
    assert found[3].at(0.0).tolist() == pytest.approx([1.5] * 3, rel=0.04)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory):
    """Three cameras with 12 frames each, and one to evaluate."""
    size = dataclasses.replace(SIZE, num_frames=12, width=96, height=54)
    capture = load_capture(rig_capture(tmp_path_factory.mktemp("drift"), size, quiet=True))
    cameras = capture.by_camera([*capture.train, *capture.val])
    return capture.split([*cameras[1], *cameras[2], *cameras[3]], cameras[0])


def drift(time: float) -> torch.Tensor:
    """20 % over time, in red most at last."""
    return torch.tensor([0.9 + 0.2 * time**2, 0.9 + 0.2 * time, 0.9 + 0.2 * time])


def error_of(response: Response, expected) -> float:
    """Largest relative error at 24 times."""
    times = [k / 23 for k in range(24)]
    return max(float((response.at(time) / expected(time) - 1.0).abs().max()) for time in times)


def test_a_camera_that_drifts_is_found_whether_it_trains_or_evaluates(filmed):
    for i in (2, 0):
        found = camera_responses(with_gains(filmed, {i: drift}))
        assert {*found} == {i}
        assert error_of(found[i], drift) < 0.02


def test_light_that_changes_for_all_cameras_stays(filmed):
    assert camera_responses(with_gains(filmed, dict.fromkeys(range(4), drift))) == {}


def test_frames_of_one_camera_say_nothing_of_another(filmed):
    """Two cameras drift in opposite directions."""
    found = camera_responses(with_gains(filmed, {1: drift, 2: lambda time: 1.0 / drift(time)}))
    assert error_of(found[1], drift) < 0.02
    assert error_of(found[2], lambda time: 1.0 / drift(time)) < 0.02


def test_a_jump_is_not_part_of_a_drift(filmed):
    """It is divided out frame by frame."""

    def jumps(time: float) -> torch.Tensor:
        return drift(time) * (1.4 if 0.2 < time < 0.4 else 1.0)

    recorded = with_gains(filmed, {2: jumps})
    assert error_of(camera_responses(recorded)[2], drift) < 0.03
    start = prepare_start(dataclasses.replace(tiny.CONFIG, exposure=True), recorded)
    assert any(
        re.match(r"camera 2 is divided by its gain of 0\.\d\d, .* at first to 1\.\d\d, ", n) for n in start.notes
    )
    for k, name in enumerate(filmed.train):
        truth = filmed.frame(name).image.float() / 255.0
        known = (truth > 0.1) & (truth < 0.6)
        assert float((start.views[k].image / truth)[known].median()) == pytest.approx(1.0, abs=0.03)


def test_training_divides_gains_out_and_says_so(folder, plain):
    config = dataclasses.replace(tiny.CONFIG, data=folder, exposure=True)
    start = prepare_start(config, with_gains(plain, GAINS | {0: torch.full((3,), 0.8)}))
    told = [note for note in start.notes if "its gain of" in note]
    assert [note.split(" is ")[0] for note in told] == ["camera 2", "camera 4"]
    text = "camera 0 trains nothing: its own frames tell the gain that it is evaluated with, 0.8"
    assert [note[: len(text)] for note in start.notes if note.startswith("camera 0")] == [text]
    for k, name in enumerate(plain.train):
        expected = plain.frame(name).image.float() / 255.0
        assert float((start.views[k].image - expected).abs().median()) < 0.02


def test_a_rendering_is_compared_as_its_camera_records_it(plain):
    recorded = with_gains(plain, GAINS)
    capture = recorded.split(recorded.by_camera(recorded.train)[1], recorded.by_camera(recorded.train)[2])

    class Perfect:
        device = torch.device("cpu")

        def render(self, camera, *, branches=False):
            names = (name for name, c in plain.cameras.items() if (c.id, c.time) == (camera.id, camera.time))
            frame = plain.frame(next(names))
            layer = Layer(frame.image.float() / 255.0, torch.ones(frame.image.shape[:2]), None)
            return Rendering(layer, layer, layer, torch.zeros(0, 2, dtype=torch.int32), None, None, None)

        def play(self, camera):
            return self.render(camera).joint.image

    frame, responses = capture.frame(capture.val[0]), {i: Response.constant(gain) for i, gain in GAINS.items()}
    assert torch.allclose(in_response(torch.ones(2, 2, 3), frame, responses), GAINS[2].expand(2, 2, 3))
    without, with_gain = (
        evaluate(Perfect(), capture, quiet=True, responses=r).summary()["psnr"] for r in ({}, responses)
    )
    assert without < 25.0
    assert with_gain > 35.0
