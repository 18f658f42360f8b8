"""Replayed calls equal eager ones; without a GPU, a replay is simulated by repeating the work."""

import dataclasses
import gc
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
import torch.utils.checkpoint

from tests.scenes import as_leaves, gradients, make_camera, make_splats, random_like, weighted_sum
from warpgs.config import RenderSettings
from warpgs.rendering import render
from warpgs.runtime import replay

SETTINGS = [RenderSettings(), RenderSettings(branches=True, depth=True, statistics=True, absgrad=True)]


@pytest.fixture
def recordings(monkeypatch):
    """A list of the graphs that were recorded, from an empty cache."""
    made = []

    def record(work, stream, pool):
        made.append(work)
        work()
        return work

    monkeypatch.setattr(replay, "record", record)
    monkeypatch.setattr(replay, "_stream_and_pool", lambda device: (None, None))
    monkeypatch.setattr(replay, "_stream", lambda device: 0)
    monkeypatch.setattr(replay, "_can_replay", lambda device: True)
    monkeypatch.setattr(replay, "_signatures", {})
    return made


def render_scene(seed=0, settings=SETTINGS[0], camera=None):
    """New splats, their rendering and all of its images."""
    splats = as_leaves(make_splats(seed=seed))
    result = render(splats, camera or make_camera(), torch.linspace(0.1, 0.8, 3), settings)
    layers = [layer for layer in (result.joint, result.static, result.dynamic) if layer is not None]
    return splats, result, [value for layer in layers for value in layer if value is not None]


def warm_up(**options):
    for _ in range(replay.EAGER_CALLS):
        _, _, images = render_scene(**options)
        weighted_sum(images, random_like(images)).backward()


def everything(scene):
    """Outputs and, after the backward pass, gradients."""
    splats, result, images = scene
    weighted_sum(images, random_like(images)).backward()
    given = (*images, result.radii, result.gradient_norms, result.contributed, result.weights)
    return [t.detach().clone() for t in (*given, *gradients(splats).values()) if t is not None]


def assert_same(actual, expected):
    for a, e in zip(actual, expected, strict=True):
        assert torch.equal(a, e)


@pytest.mark.parametrize("settings", SETTINGS)
def test_replayed_renders_equal_eager_ones(settings, recordings):
    plain = [everything(render_scene(seed, settings)) for seed in range(replay.EAGER_CALLS)]
    for _ in range(2):
        for seed, expected in enumerate(plain):
            assert_same(everything(render_scene(seed, settings)), expected)
    assert len(recordings) == 2  # forward and backward


@pytest.mark.parametrize(("num", "size"), [(0, (40, 30)), (5, (0, 8))])
def test_empty_renders_are_correct_when_repeated(num, size, recordings):
    for _ in range(2 * replay.EAGER_CALLS):
        splats = as_leaves(make_splats(num))
        image = render(splats, make_camera(*size), torch.full((3,), 0.5)).joint.image
        assert (image == 0.5).all()
        image.sum().backward()
        assert not any(g.any() for g in gradients(splats).values())


def test_renders_without_gradients_are_replayed(recordings):
    with torch.no_grad():
        plain = [render_scene(seed)[2] for seed in range(replay.EAGER_CALLS)]
        for seed, expected in enumerate(plain):
            assert_same(render_scene(seed)[2], expected)
    assert len(recordings) == 1


def test_a_recording_in_use_is_not_replayed(recordings):
    warm_up()
    scenes = [render_scene(seed) for seed in range(replay.MAX_RECORDINGS + 2)]
    assert len(recordings) == replay.MAX_RECORDINGS
    kept = [[image.clone() for image in images] for _, _, images in scenes]
    values = [everything(scene) for scene in scenes]
    for images, (_, _, still) in zip(kept, scenes, strict=True):
        assert_same(still, images)
    replay._signatures.clear()
    for seed, value in enumerate(values):
        assert_same(value, everything(render_scene(seed)))


def test_a_recording_is_released_with_the_graph_of_its_call(recordings):
    warm_up()
    gc.disable()
    try:
        for seed in range(10):
            render_scene(seed)  # without a backward pass
            everything(render_scene(seed))
    finally:
        gc.enable()
    assert len(recordings) == 2


def test_the_backward_pass_can_be_repeated(recordings):
    warm_up()
    for _ in range(3):
        splats, _, images = render_scene()
        v_outputs = random_like(images)
        weighted_sum(images, v_outputs).backward(retain_graph=True)
        once = {name: g.clone() for name, g in gradients(splats).items()}
        weighted_sum(images, v_outputs).backward()
        for name, gradient in gradients(splats).items():
            assert torch.equal(gradient, 2 * once[name])


def test_each_image_alone_propagates_its_gradient(recordings):
    warm_up(settings=SETTINGS[1])
    for _ in range(3):
        for k in range(9):
            splats, _, images = render_scene(settings=SETTINGS[1])
            images[k].sum().backward()
            plain, _, images = render_scene(settings=dataclasses.replace(SETTINGS[1], replay=False))
            images[k].sum().backward()
            for name, gradient in gradients(plain).items():
                assert torch.equal(gradients(splats)[name], gradient)


def test_a_recording_holds_no_graph_of_its_inputs(recordings):
    for _ in range(replay.EAGER_CALLS + 2):
        everything(render_scene())
    (signature,) = replay._signatures.values()
    assert not any(t.requires_grad for t in signature.idle[0]._inputs._own_words)


def render_sizes(sizes):
    for size in sizes:
        everything(render_scene(camera=make_camera(*size)))


def test_recently_used_signatures_and_recordings_are_kept(recordings):
    often = (40, 30)
    render_sizes([often] * (replay.EAGER_CALLS + 2))
    others = [(20 + k, 10) for k in range(2 * replay.MAX_SIGNATURES)]
    for other in others:
        render_sizes([other, often])
    numbers = [signature.recordings for signature in replay._signatures.values()]
    assert numbers == [0] * (replay.MAX_SIGNATURES - 1) + [1]
    made = len(recordings)
    for other in others[: replay.MAX_RECORDINGS + 1]:
        render_sizes([*[other] * (replay.EAGER_CALLS + 2), often])
    render_sizes([often])
    assert len(recordings) == made + 2 * (replay.MAX_RECORDINGS + 1)


@pytest.mark.parametrize("num_before", [0, replay.EAGER_CALLS])
def test_misuse_is_detected_with_and_without_replay(num_before, recordings):
    for _ in range(num_before):
        everything(render_scene())
    _, result, images = render_scene()
    result.radii.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        images[0].sum().backward()
    changed = render_scene()
    with torch.no_grad():
        changed[0].means.add_(1.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        everything(changed)
    twice = render_scene()
    everything(twice)
    with pytest.raises(RuntimeError, match="second time"):
        everything(twice)


def test_checkpointed_renders_may_be_replayed(recordings):
    for _ in range(2 * replay.EAGER_CALLS):
        values = []
        for again in (False, True):
            splats = as_leaves(make_splats())

            def image(means, splats=splats):
                return render(dataclasses.replace(splats, means=means), make_camera()).joint.image

            if again:
                rendered = torch.utils.checkpoint.checkpoint(image, splats.means, use_reentrant=False)
            else:
                rendered = image(splats.means)
            rendered.square().sum().backward()
            values.append(splats.means.grad)
        assert torch.equal(*values)


def test_the_camera_has_the_same_gradient_in_a_replay(recordings):
    found = []
    for _ in range(2 * replay.EAGER_CALLS):
        camera = make_camera()
        camera.viewmat.requires_grad_()
        render(make_splats(), camera).joint.image.sum().backward()
        found.append(camera.viewmat.grad)
    assert len(recordings) == 2  # forward and backward
    assert found[0].abs().sum() > 0
    assert all(torch.equal(gradient, found[0]) for gradient in found)


def test_an_invalid_recording_is_dropped(recordings, monkeypatch):
    warm_up()
    everything(render_scene())
    monkeypatch.setattr(replay.Recording, "is_valid", lambda self: False)
    everything(render_scene())
    (signature,) = replay._signatures.values()
    assert (signature.recordings, signature.calls) == (0, 1)
    warm_up()
    assert len(recordings) == 2


def test_other_shapes_and_settings_have_their_own_signatures(recordings):
    warm_up()
    everything(render_scene())
    everything(render_scene(settings=RenderSettings(antialias=True)))
    render(as_leaves(make_splats(59)), make_camera(), torch.linspace(0.1, 0.8, 3))
    render(as_leaves(make_splats(60)), make_camera(32, 24), torch.linspace(0.1, 0.8, 3))
    render(as_leaves(make_splats(60)), make_camera())
    with torch.no_grad():
        render_scene()
    assert len(recordings) == 1
    assert len(replay._signatures) == 6


def test_the_number_of_recordings_is_limited(recordings):
    for num in range(20, 20 + 2 * replay.MAX_RECORDINGS):
        for _ in range(replay.EAGER_CALLS + 2):
            splats = as_leaves(make_splats(num))
            render(splats, make_camera()).joint.image.sum().backward()
        signatures = replay._signatures.values()
        kept = [len(signature.idle) for signature in signatures]
        assert sum(kept) == sum(signature.recordings for signature in signatures) <= replay.MAX_RECORDINGS
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


def test_large_calls_are_not_replayed(recordings, monkeypatch):
    monkeypatch.setattr(replay, "MAX_BYTES", 1000)
    for _ in range(2):
        warm_up()
    assert not recordings


def test_the_number_of_signatures_is_limited(recordings):
    for width in range(1, replay.MAX_SIGNATURES + 10):
        render(make_splats(3), make_camera(width, 8))
    assert len(replay._signatures) == replay.MAX_SIGNATURES


def test_replaying_can_be_switched_off(recordings):
    for _ in range(2):
        warm_up(settings=RenderSettings(replay=False))
    assert not recordings
    assert not replay._signatures
