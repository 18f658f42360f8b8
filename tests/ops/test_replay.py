"""What repeats is replayed, and nobody can tell. Without a GPU a graph is stood in for by doing the work again."""

import dataclasses
import gc

import pytest
import torch

from tests.scenes import as_leaves, gradients, make_camera, make_splats, pulled, random_like
from warpgs.config import RenderSettings
from warpgs.ops import replay, tiles
from warpgs.ops.graph import WARM_UPS
from warpgs.render import render

SETTINGS = [RenderSettings(), RenderSettings(branches=True, depth=True, statistics=True, absgrad=True)]


@pytest.fixture
def recordings(monkeypatch):
    """How many graphs were recorded; and a new memory of what was called."""
    made = []

    def record(work, stream, pool):
        made.append(work)
        work()
        return work

    monkeypatch.setattr(replay, "record", record)
    monkeypatch.setattr(replay, "_stream_and_pool", lambda device: (None, None))
    monkeypatch.setattr(replay, "_stream", lambda device: 0)
    monkeypatch.setattr(replay, "_can_replay", lambda device: True)
    replay._kinds.__dict__.clear()
    yield made
    replay._kinds.__dict__.clear()


def draw(seed=0, settings=SETTINGS[0]):
    """A new scene's splats, what is rendered of them, and all images of that."""
    splats = as_leaves(make_splats(seed=seed))
    result = render(splats, make_camera(), torch.linspace(0.1, 0.8, 3), settings)
    layers = [layer for layer in (result.joint, result.static, result.dynamic) if layer is not None]
    return splats, result, [value for layer in layers for value in layer if value is not None]


def warm_up(**options):
    for _ in range(WARM_UPS):
        _, _, images = draw(**options)
        pulled(images, random_like(images)).backward()


def everything(drawn):
    """Outputs and, after the way back, gradients."""
    splats, result, images = drawn
    pulled(images, random_like(images)).backward()
    given = (*images, result.radii, result.gradient_norms, result.contributed, result.weights)
    return [t.detach().clone() for t in (*given, *gradients(splats).values()) if t is not None]


def assert_same(actual, expected):
    for a, e in zip(actual, expected, strict=True):
        assert torch.equal(a, e)


@pytest.mark.parametrize("settings", SETTINGS)
def test_replayed_renders_are_the_plain_ones(settings, recordings):
    plain = [everything(draw(seed, settings)) for seed in range(4)]
    assert WARM_UPS == 3
    for _ in range(2):
        for seed, expected in enumerate(plain):
            assert_same(everything(draw(seed, settings)), expected)
    assert len(recordings) == 2  # the way forth and the way back


@pytest.mark.parametrize(("num", "size"), [(0, (40, 30)), (5, (0, 8))])
def test_empty_renders_too(num, size, recordings):
    for _ in range(2 * WARM_UPS):
        splats = as_leaves(make_splats(num))
        image = render(splats, make_camera(*size), torch.full((3,), 0.5)).joint.image
        assert (image == 0.5).all()
        image.sum().backward()
        assert not any(g.any() for g in gradients(splats).values())


def test_without_gradients_too(recordings):
    with torch.no_grad():
        plain = [draw(seed)[2] for seed in range(WARM_UPS)]
        for seed, expected in enumerate(plain):
            assert_same(draw(seed)[2], expected)
    assert len(recordings) == 1


def test_what_is_in_use_is_not_replayed(recordings):
    warm_up()
    drawn = [draw(seed) for seed in range(replay.MOST_RECORDINGS + 2)]
    assert len(recordings) == replay.MOST_RECORDINGS
    kept = [[image.clone() for image in images] for _, _, images in drawn]
    values = [everything(d) for d in drawn]
    for images, (_, _, still) in zip(kept, drawn, strict=True):
        assert_same(still, images)
    replay._kinds.__dict__.clear()
    for seed, value in enumerate(values):
        assert_same(value, everything(draw(seed)))


def test_a_recording_is_free_again_with_the_graph_of_its_call(recordings):
    warm_up()
    gc.disable()
    try:
        for seed in range(10):
            draw(seed)  # nobody goes its way back
            everything(draw(seed))
    finally:
        gc.enable()
    assert len(recordings) == 2


def test_the_way_back_can_be_gone_again(recordings):
    warm_up()
    for _ in range(3):
        splats, _, images = draw()
        cotangents = random_like(images)
        pulled(images, cotangents).backward(retain_graph=True)
        once = {name: g.clone() for name, g in gradients(splats).items()}
        pulled(images, cotangents).backward()
        for name, gradient in gradients(splats).items():
            assert torch.equal(gradient, 2 * once[name])


def test_every_image_alone_can_be_gone_back_from(recordings):
    warm_up(settings=SETTINGS[1])
    for _ in range(3):
        for k in range(9):
            splats, _, images = draw(settings=SETTINGS[1])
            images[k].sum().backward()
            plain, _, images = draw(settings=dataclasses.replace(SETTINGS[1], replay=False))
            images[k].sum().backward()
            for name, gradient in gradients(plain).items():
                assert torch.equal(gradients(splats)[name], gradient)


def test_inputs_may_change_before_the_way_back(recordings):
    warm_up()
    expected = everything(draw())
    drawn = draw()
    with torch.no_grad():
        drawn[0].means.add_(1.0)
    assert_same(everything(drawn), expected)


def test_more_intersections_than_there_is_room_for_are_learned_anew(recordings, monkeypatch):
    warm_up()
    everything(draw())
    assert len(recordings) == 1
    budget = tiles._budget(torch.device("cpu"), *make_camera().size)
    budget.demand.fill_(10**6)
    warm_up()
    assert len(recordings) == 1
    everything(draw())
    assert len(recordings) == 2


def test_other_shapes_settings_and_threads_have_recordings_of_their_own(recordings):
    warm_up()
    everything(draw())
    everything(draw(settings=RenderSettings(antialias=True)))
    with torch.no_grad():
        draw()
    assert len(recordings) == 1
    assert len(replay._kinds.known) == 3


def test_large_work_is_not_replayed(recordings, monkeypatch):
    monkeypatch.setattr(replay, "LARGEST", 1000)
    for _ in range(2):
        warm_up()
    assert not recordings


def test_only_so_many_kinds_of_calls_are_remembered(recordings):
    for width in range(1, replay.MOST_KINDS + 10):
        render(make_splats(3), make_camera(width, 8))
    assert len(replay._kinds.known) == replay.MOST_KINDS


def test_replaying_can_be_switched_off(recordings):
    for _ in range(2):
        warm_up(settings=RenderSettings(replay=False))
    assert not recordings
    assert not replay._kinds.__dict__
