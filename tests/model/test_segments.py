"""Segments of time: each has dynamic Gaussians and a deformation network of its own."""

import pytest
import torch

from tests import plain
from tests.scenes import as_gaussians, error, generator, make_camera, make_splats
from warpgs.model import segmented_deformation, segments
from warpgs.model.scene import SplitScene
from warpgs.rendering import render

NUM, NUM_STATIC, SEGMENTS = 3, 7, [2, 0, 1, 2, 0, 0]
EARLY, SEAM, MIDDLE = torch.tensor([0.1]), torch.tensor([1 / 3]), torch.tensor([0.5])


def make_scene(of_dynamic=SEGMENTS):
    """A scene of three segments, whose networks move what they deform."""
    config = plain.model(position_bands=2, time_bands=2, depth=3, width=8, skip=1, sh_degree=3, segments=NUM)
    dynamic = as_gaussians(make_splats(len(of_dynamic), 2))
    dynamic.segments = torch.tensor(of_dynamic)
    scene = SplitScene(as_gaussians(make_splats(NUM_STATIC, 1)), dynamic, config, torch.zeros(3), torch.full((3,), 3.0))
    values = scene.deformation.network.trunk.values
    values.data = 0.2 * torch.randn(values.shape, generator=generator())
    return scene


def test_whatever_segment_is_chosen_is_deformed():
    """Also near the ends of an overlap, where a weight is so small that the other one rounds to 1."""
    for distance in (0.0, 1e-6, 1e-4, 0.1):
        for end in (segments.window(1, NUM)[0], segments.window(0, NUM)[1]):
            for time in (torch.tensor([end - distance]), torch.tensor([end + distance])):
                active = segments.active(time, NUM)
                for choice in (-1.0, 0.0, 1.0):
                    shown = segments.weights(time, NUM, torch.tensor([choice])).nonzero()[:, 0]
                    assert torch.isin(shown, active).all()


def dynamic_opacities(scene, time):
    return scene.splats(time).opacities[NUM_STATIC:]


def test_weights_sum_to_one_and_are_those_of_one_segment_between_overlaps():
    for time in torch.linspace(0, 1, 301).split(1):
        found = segments.weights(time, NUM)
        assert error(found.sum(), torch.tensor(1.0)) < 1e-6
        assert int((found > 0).sum()) <= 2
        assert found[segments.nearest(time, NUM)] >= 0.49
    assert segments.weights(EARLY, NUM).tolist() == [1.0, 0.0, 0.0]
    assert segments.weights(MIDDLE, NUM).tolist() == [0.0, 1.0, 0.0]
    assert error(segments.weights(SEAM, NUM), torch.tensor([0.5, 0.5, 0.0])) < 1e-5


def test_many_opaque_layers_appear_little_by_little():
    """Ten of an opacity of 0.7, from the first to the 31st frame of an overlap of 30 frames."""
    fractions = torch.linspace(0.0, 1.0, 31).split(1)
    weights = [segments.weights((1.0 + segments.OVERLAP * (s - 0.5)) / NUM, NUM)[1] for s in fractions]
    logits = torch.logit(torch.full((10,), 0.7))
    alphas = torch.stack([1.0 - (1.0 - segments.faded(logits, w.expand(10))).prod() for w in weights])
    assert error(alphas[[0, -1]], torch.tensor([0.0, 1.0])) < 1e-4
    assert alphas.diff().max() < 0.15


def test_in_an_overlap_one_segment_alone_can_be_chosen():
    for time in (SEAM, SEAM - 0.4 * segments.OVERLAP / NUM, SEAM + 0.4 * segments.OVERLAP / NUM):
        found = [segments.weights(time, NUM, torch.tensor([choice])) for choice in (-1.0, 0.0, 1.0)]
        assert found[0].tolist() == [1.0, 0.0, 0.0]
        assert torch.equal(found[1], segments.weights(time, NUM))
        assert found[2].tolist() == [0.0, 1.0, 0.0]
    for time in (EARLY, MIDDLE, torch.tensor([1.0])):
        assert torch.equal(segments.weights(time, NUM, torch.tensor([1.0])), segments.weights(time, NUM))
        assert torch.equal(segments.weights(time, NUM, torch.tensor([-1.0])), segments.weights(time, NUM))


def test_windows_of_segments_are_where_their_weights_are():
    for segment in range(NUM):
        start, end = segments.window(segment, NUM)
        inside = segments.local_time(torch.tensor([start, end]), torch.tensor([segment]), NUM)
        assert error(inside, torch.tensor([0.0, 1.0])) < 1e-6
        for time in torch.linspace(0, 1, 101).split(1):
            assert bool(segments.weights(time, NUM)[segment] > 0) == (start < float(time) < end)


def test_two_segments_that_show_the_same_are_as_opaque_as_one():
    logits = torch.linspace(-9.0, 9.0, 19)
    halves = [segments.faded(logits, torch.full_like(logits, weight)) for weight in (0.3, 0.7)]
    assert error(1.0 - (1.0 - halves[0]) * (1.0 - halves[1]), logits.sigmoid()) < 1e-6
    assert error(segments.faded(logits, torch.ones_like(logits)), logits.sigmoid()) < 1e-6


def test_only_gaussians_of_the_segment_at_a_time_are_seen():
    scene, own = make_scene(), make_scene().dynamic.opacities
    for time, segment in ((EARLY, 0), (MIDDLE, 1)):
        is_there = torch.tensor(SEGMENTS) == segment
        found = dynamic_opacities(scene, time)
        assert error(found[is_there], own[is_there]) < 1e-6
        assert not found[~is_there].any()
        radii = render(scene.splats(time), make_camera()).radii[NUM_STATIC:]
        assert not radii[~is_there].any()


@pytest.mark.parametrize("of_dynamic", [SEGMENTS, [1, 1, 1, 1, 1, 0]])
@pytest.mark.parametrize("time", [EARLY, SEAM, MIDDLE])
def test_each_gaussian_is_deformed_by_the_network_of_its_segment(time, of_dynamic):
    scene = make_scene(of_dynamic)
    found = scene.offsets(time)
    active = segments.weights(time, NUM) > 0
    for k, segment in enumerate(of_dynamic):
        local = segments.local_time(time, torch.tensor([segment]), NUM)
        expected = scene.deformation.of(segment)(scene.dynamic.means[k : k + 1], local)[0]
        assert expected.any()
        assert error(found[k], expected if active[segment] else torch.zeros(10)) < 1e-6


def test_noise_of_each_gaussian_reaches_its_network():
    scene, noise = make_scene(), torch.tensor([0.0, 0.01, 0.0, 0.0, 0.0, 0.0])
    changed = (scene.offsets(EARLY, noise) != scene.offsets(EARLY)).any(1)
    assert changed.nonzero().tolist() == [[1]]


def test_gradients_of_a_network_are_those_of_its_gaussians_alone():
    """Segment 2 has fewer Gaussians than segment 0, so that its rows are repeated."""
    scene, late = make_scene(), torch.tensor([0.9])
    scene.offsets(late).square().sum().backward()
    alone = scene.deformation.of(2)
    local = segments.local_time(late, torch.tensor([2]), NUM)
    alone(scene.dynamic.means[[0, 3]], local).square().sum().backward()
    gradient = scene.deformation.network.trunk.values.grad
    assert error(gradient[2], alone.trunk.values.grad) < 1e-5 * float(gradient.abs().max())
    assert not gradient[:2].any()


def test_segments_follow_their_gaussians():
    gaussians = make_scene().dynamic
    kept = torch.tensor([True, False, True, True, False, False])
    assert gaussians.select(kept).segments.tolist() == [2, 1, 2]
    gaussians.gather(torch.tensor([1, 1, 0]))
    gaussians.append(make_scene([1, 2]).dynamic)
    assert gaussians.segments.tolist() == [0, 0, 2, 1, 2]


def test_a_scene_follows_gaussians_that_are_replaced():
    scene = make_scene()
    scene.offsets(EARLY)
    scene.dynamic.gather(torch.tensor([3, 1]))
    found = scene.offsets(EARLY)
    assert found.shape == (2, 10)
    assert found[1].any()
    assert not found[0].any()


def test_gaussians_around_a_time_are_those_of_its_segment():
    scene = make_scene()
    means, deformation = scene.around(MIDDLE)
    assert (means == scene.dynamic.means[2]).all()
    assert error(deformation(means[:1], MIDDLE), scene.offsets(MIDDLE)[2:3]) < 1e-6


@pytest.mark.parametrize(("num_times", "num"), [(1, 1), (160, 1), (899, 1), (901, 2), (5_400, 9)])
def test_long_captures_have_several_segments(num_times, num):
    assert segments.default_number(num_times) == num


@pytest.mark.parametrize("time", [EARLY, SEAM, torch.tensor([0.9])])
def test_a_segment_that_is_evaluated_without_being_seen_changes_nothing(time, monkeypatch):
    """As on CUDA, where two are evaluated at all times."""
    later = (time * NUM).round().long().clamp(1, NUM - 1)
    scene, results = make_scene(), []
    for is_evaluated in (False, True):
        if is_evaluated:
            monkeypatch.setattr(segmented_deformation, "active", lambda *_: torch.cat([later - 1, later]))
        scene.zero_grad()
        image = render(scene.splats(time), make_camera()).joint.image
        image.square().sum().backward()
        results.append((image.detach(), *(parameter.grad for parameter in scene.parameters())))
    assert all(a is b is None or torch.equal(a, b) for a, b in zip(*results, strict=True))
