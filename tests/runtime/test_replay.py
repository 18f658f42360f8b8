"""What repeats is replayed, and nobody can tell. Without a GPU a graph is stood in for by doing the work again."""

import dataclasses
import gc
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import torch.utils.checkpoint

from tests.scenes import as_leaves, gradients, make_camera, make_splats, pulled, random_like
from warpgs.config import RenderSettings
from warpgs.rendering import render
from warpgs.runtime import replay

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
    monkeypatch.setattr(replay, "_kinds", {})
    return made


def draw(seed=0, settings=SETTINGS[0], camera=None):
    """A new scene's splats, what is rendered of them, and all images of that."""
    splats = as_leaves(make_splats(seed=seed))
    result = render(splats, camera or make_camera(), torch.linspace(0.1, 0.8, 3), settings)
    layers = [layer for layer in (result.joint, result.static, result.dynamic) if layer is not None]
    return splats, result, [value for layer in layers for value in layer if value is not None]


def warm_up(**options):
    for _ in range(replay.PLAIN_CALLS):
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
    plain = [everything(draw(seed, settings)) for seed in range(replay.PLAIN_CALLS)]
    for _ in range(2):
        for seed, expected in enumerate(plain):
            assert_same(everything(draw(seed, settings)), expected)
    assert len(recordings) == 2  # the way forth and the way back


@pytest.mark.parametrize(("num", "size"), [(0, (40, 30)), (5, (0, 8))])
def test_empty_renders_too(num, size, recordings):
    for _ in range(2 * replay.PLAIN_CALLS):
        splats = as_leaves(make_splats(num))
        image = render(splats, make_camera(*size), torch.full((3,), 0.5)).joint.image
        assert (image == 0.5).all()
        image.sum().backward()
        assert not any(g.any() for g in gradients(splats).values())


def test_without_gradients_too(recordings):
    with torch.no_grad():
        plain = [draw(seed)[2] for seed in range(replay.PLAIN_CALLS)]
        for seed, expected in enumerate(plain):
            assert_same(draw(seed)[2], expected)
    assert len(recordings) == 1


def test_what_is_in_use_is_not_replayed(recordings):
    warm_up()
    drawn = [draw(seed) for seed in range(replay.MAX_RECORDINGS + 2)]
    assert len(recordings) == replay.MAX_RECORDINGS
    kept = [[image.clone() for image in images] for _, _, images in drawn]
    values = [everything(d) for d in drawn]
    for images, (_, _, still) in zip(kept, drawn, strict=True):
        assert_same(still, images)
    replay._kinds.clear()
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


def test_a_recording_has_nothing_of_what_its_inputs_came_from(recordings):
    for _ in range(replay.PLAIN_CALLS + 2):
        everything(draw())
    (kind,) = replay._kinds.values()
    assert not any(t.requires_grad for t in kind.idle[0]._inputs._own_words)


def sizes_drawn(sizes):
    for size in sizes:
        everything(draw(camera=make_camera(*size)))


def test_kinds_and_recordings_that_are_called_are_kept(recordings):
    often = (40, 30)
    sizes_drawn([often] * (replay.PLAIN_CALLS + 2))
    others = [(20 + k, 10) for k in range(2 * replay.MAX_KEYS)]
    for other in others:
        sizes_drawn([other, often])
    assert [kind.recordings for kind in replay._kinds.values()] == [0] * (replay.MAX_KEYS - 1) + [1]
    made = len(recordings)
    for other in others[: replay.MAX_RECORDINGS + 1]:
        sizes_drawn([*[other] * (replay.PLAIN_CALLS + 2), often])
    sizes_drawn([often])
    assert len(recordings) == made + 2 * (replay.MAX_RECORDINGS + 1)


@pytest.mark.parametrize("num_before", [0, replay.PLAIN_CALLS])
def test_mistakes_are_noticed_as_ever(num_before, recordings):
    for _ in range(num_before):
        everything(draw())
    _, result, images = draw()
    result.radii.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        images[0].sum().backward()
    changed = draw()
    with torch.no_grad():
        changed[0].means.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        everything(changed)
    twice = draw()
    everything(twice)
    with pytest.raises(RuntimeError, match="second time"):
        everything(twice)


def test_what_is_computed_again_for_the_way_back_may_be_replayed(recordings):
    for _ in range(2 * replay.PLAIN_CALLS):
        values = []
        for again in (False, True):
            splats = as_leaves(make_splats())

            def image(means, splats=splats):
                return render(dataclasses.replace(splats, means=means), make_camera()).joint.image

            if again:
                drawn = torch.utils.checkpoint.checkpoint(image, splats.means, use_reentrant=False)
            else:
                drawn = image(splats.means)
            drawn.square().sum().backward()
            values.append(splats.means.grad)
        assert torch.equal(*values)


def test_the_camera_has_no_gradient(recordings):
    for _ in range(2 * replay.PLAIN_CALLS):
        camera = make_camera()
        camera.viewmat.requires_grad_()
        assert not render(make_splats(), camera).joint.image.requires_grad
        splats = as_leaves(make_splats())
        render(splats, camera).joint.image.sum().backward()
        assert camera.viewmat.grad is None


def test_a_recording_that_does_not_fit_any_more_is_dropped(recordings, monkeypatch):
    warm_up()
    everything(draw())
    monkeypatch.setattr(replay.Recording, "is_valid", lambda self: False)
    everything(draw())
    (kind,) = replay._kinds.values()
    assert (kind.recordings, kind.calls) == (0, 1)
    warm_up()
    assert len(recordings) == 2


def test_other_shapes_and_settings_have_recordings_of_their_own(recordings):
    warm_up()
    everything(draw())
    everything(draw(settings=RenderSettings(antialias=True)))
    render(as_leaves(make_splats(59)), make_camera(), torch.linspace(0.1, 0.8, 3))
    render(as_leaves(make_splats(60)), make_camera(32, 24), torch.linspace(0.1, 0.8, 3))
    render(as_leaves(make_splats(60)), make_camera())
    with torch.no_grad():
        draw()
    assert len(recordings) == 1
    assert len(replay._kinds) == 6


def test_so_many_recordings_are_kept_and_no_more(recordings):
    for num in range(20, 20 + 2 * replay.MAX_RECORDINGS):
        for _ in range(replay.PLAIN_CALLS + 2):
            splats = as_leaves(make_splats(num))
            render(splats, make_camera()).joint.image.sum().backward()
        kept = [len(kind.idle) for kind in replay._kinds.values()]
        assert sum(kept) == sum(kind.recordings for kind in replay._kinds.values()) <= replay.MAX_RECORDINGS
        assert kept[-1] == 1


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU to ask")
def test_only_the_main_thread_outside_of_inference_mode_replays(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    cuda = torch.device("cuda")
    assert replay._can_replay(cuda)
    assert not replay._can_replay(torch.device("cpu"))
    with ThreadPoolExecutor(max_workers=1) as thread:
        assert not thread.submit(replay._can_replay, cuda).result()
    with torch.inference_mode():
        assert not replay._can_replay(cuda)


def test_large_work_is_not_replayed(recordings, monkeypatch):
    monkeypatch.setattr(replay, "MAX_VALUE", 1000)
    for _ in range(2):
        warm_up()
    assert not recordings


def test_only_so_many_kinds_of_calls_are_remembered(recordings):
    for width in range(1, replay.MAX_KEYS + 10):
        render(make_splats(3), make_camera(width, 8))
    assert len(replay._kinds) == replay.MAX_KEYS


def test_replaying_can_be_switched_off(recordings):
    for _ in range(2):
        warm_up(settings=RenderSettings(replay=False))
    assert not recordings
    assert not replay._kinds
