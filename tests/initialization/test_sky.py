"""The sky is found where depth is beyond all points, and nowhere else; no Gaussian starts in it."""

import dataclasses

import pytest
import torch

from tests import plain, tiny
from tests.lens_captures import changed
from warpgs.captures.opening import load_capture
from warpgs.initialization.plan import make_plan, mean_color
from warpgs.initialization.prepare_start import prepare_again, prepare_start
from warpgs.initialization.sky import find_sky
from warpgs.model.dome import Dome
from warpgs.synthetic.studio import StudioSize, studio_capture, trace

SIZE = StudioSize(width=64, height=36, num_frames=6, num_samples=2, num_points=600)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def opened(cache, depth="exact", sky=True):
    return load_capture(studio_capture(depth, cache, SIZE, quiet=True, sky=sky))


@pytest.fixture(scope="module")
def capture(cache):
    return opened(cache)


def background(capture, **changes):
    return make_plan(dataclasses.replace(tiny.CONFIG, background="auto", **changes), capture)[0].background


def test_the_sky_is_where_rays_hit_nothing(capture):
    sky = find_sky(capture)
    hits = [trace(k / 5, 0.0, SIZE, sky=True)[1] > 1e3 for k in range(6)]
    assert all((mask == hit).float().mean() > 0.98 for mask, hit in zip(sky.masks, hits, strict=True))
    assert sky.share == pytest.approx(float(torch.stack(hits).float().mean()), abs=0.02)


def test_large_frames_are_reduced_before_they_are_kept(capture, monkeypatch):
    whole = find_sky(capture)
    monkeypatch.setattr("warpgs.initialization.sky.MAX_SIDE", 32)
    sky = find_sky(capture)
    assert {frame.camera.size for frame in sky.frames} == {(32, 18)}
    kept = [tensor for frame in sky.frames for tensor in (frame.image, frame.static_mask, frame.inverse_depth)]
    assert all(tensor.untyped_storage().nbytes() == tensor.nbytes for tensor in kept)
    assert sky.share == pytest.approx(whole.share, abs=0.02)
    assert sky.far == pytest.approx(whole.far, rel=0.05)


def test_a_room_has_no_sky(cache):
    for depth in ("exact", "network", "none"):
        assert find_sky(opened(cache, depth, sky=False)) is None


def test_errors_of_a_depth_network_leave_a_sky(cache):
    assert find_sky(opened(cache, "network")).share > 0.1


def upside_down(frame):
    depth = frame.inverse_depth
    return frame if depth is None else dataclasses.replace(frame, inverse_depth=depth.flip(0))


@pytest.mark.parametrize("missing", ["depth", "points", "agreement"])
def test_without_depth_and_points_that_agree_there_is_no_sky(capture, missing):
    lacking = {
        "depth": changed(capture, lambda frame: dataclasses.replace(frame, inverse_depth=None)),
        "points": dataclasses.replace(capture, points=capture.points[:0], point_colors=None),
        "agreement": changed(capture, upside_down),
    }
    assert find_sky(lacking[missing]) is None


def test_a_run_has_a_sky_where_the_capture_shows_one(capture, cache):
    plan, notes, _ = make_plan(dataclasses.replace(tiny.CONFIG, background="auto"), capture)
    assert plan.background == "sky"
    assert any("the sky, 3" in note and "is behind all Gaussians" in note for note in notes)
    assert background(opened(cache, sky=False)) == mean_color(opened(cache, sky=False))
    assert background(capture, assume="dynamic") == mean_color(capture)
    assert background(capture.over("white")) == "white"


def test_no_gaussian_starts_in_the_sky(capture):
    distant = capture.cameras[capture.train[0]].unproject(torch.tensor([1]), torch.tensor([30]), torch.tensor([50.0]))
    points = torch.cat([capture.points, distant])
    start = prepare_start(
        plain.config(
            **vars(tiny.CONFIG)
            | {"background": "auto", "model": dataclasses.replace(tiny.MODEL, max_static_points=10_000)}
        ),
        dataclasses.replace(capture, points=points, point_colors=None),
    )
    means = start.scene.static.means
    assert len(means) > 500
    assert not (means == distant).all(1).any()


@pytest.mark.parametrize("asked", ["auto", "sky"])
def test_the_sky_is_looked_for_once(capture, monkeypatch, asked):
    looked = []
    for module in ("plan", "prepare_start"):
        find = lambda seen: looked.append(seen) or find_sky(seen)  # noqa: E731
        monkeypatch.setattr(f"warpgs.initialization.{module}.find_sky", find)
    start = prepare_start(dataclasses.replace(tiny.CONFIG, background=asked, exposure=False), capture)
    assert (start.plan.background, len(looked)) == ("sky", 1)
    again = prepare_again(start.plan, capture)
    assert len(looked) == 2
    assert torch.equal(again.scene.dome.texels, start.scene.dome.texels)


def test_the_sky_begins_as_frames_show_it(capture):
    config = dataclasses.replace(tiny.CONFIG, background="auto", exposure=False)
    dome = prepare_start(config, capture).scene.dome
    assert isinstance(dome, Dome)
    assert dome.far > 0
    frame = capture.frame(capture.train[2])
    shown = find_sky(capture).masks[2]
    error = (dome(frame.camera) - frame.image / 255.0)[shown].square().mean().sqrt()
    assert error < 0.06
    assert error < 0.5 * (frame.image / 255.0)[shown].std()


def test_a_sky_that_no_depth_tells_begins_with_all_that_is_static(cache):
    config = dataclasses.replace(tiny.CONFIG, background="sky", depth=False)
    dome = prepare_start(config, opened(cache, "none")).scene.dome
    assert dome.far < 0
    assert 0.05 < dome.texels.std() < 0.4
