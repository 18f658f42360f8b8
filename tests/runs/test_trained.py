"""Playing a scene: frames that are recorded are those that are rendered. (On a real GPU: test_cuda_training.)"""

import dataclasses

import pytest
import torch

from tests.export import scenes
from warpgs.runs import trained as playback
from warpgs.runs.trained import MAX_RECORDINGS, Player


@pytest.fixture
def recorded(monkeypatch):
    """Sizes in the order of their recording; without a GPU a graph is a function that is called again."""
    sizes = []

    def capture(step):
        sizes.append(tuple(step()[0].shape[1::-1]))
        return step

    monkeypatch.setattr(playback, "capture", capture)
    monkeypatch.setattr(Player, "records", True)
    return sizes


@pytest.fixture
def player():
    moments = scenes.moments()
    return Player(moments.scene, moments.config, moments.facts)


def shifted(camera, by, time):
    viewmat = camera.viewmat.clone()
    viewmat[0, 3] += by
    return dataclasses.replace(camera, viewmat=viewmat, time=time)


def test_every_camera_of_a_size_is_played_from_one_recording(player, recorded):
    for k in range(3):
        camera = shifted(scenes.camera(), 0.2 * k, 0.3 * k)
        assert torch.equal(player.play(camera), player(camera, False).joint.image)
    assert recorded == [(64, 48)]


def test_each_size_is_recorded_once(player, recorded):
    sizes = [(64, 48), (32, 24)]
    assert not player.is_recorded(sizes[0])
    for size in sizes * 2:
        assert player.play(scenes.camera(*size)).shape == (size[1], size[0], 3)
    assert recorded == sizes
    assert player.is_recorded(sizes[0])


def test_the_oldest_of_many_recordings_goes(player, recorded):
    sizes = [(32 + 2 * k, 24) for k in range(MAX_RECORDINGS + 1)]
    for size in sizes:
        player.play(scenes.camera(*size))
    assert [player.is_recorded(size) for size in sizes] == [False] + [True] * MAX_RECORDINGS


def test_on_the_cpu_nothing_is_recorded(player):
    camera = scenes.camera(time=0.4)
    assert torch.equal(player.play(camera), player(camera, False).joint.image)
    assert not player.is_recorded(camera.size)


def test_without_the_residual_static_gaussians_have_their_own_colours(player):
    plain, relit = player.splats(0.5, residual=False), player.splats(0.5)
    num = len(player.scene.static)
    assert torch.equal(plain.sh[:num, 0], player.scene.static.sh[:, 0])
    assert not torch.equal(relit.sh[:num, 0], plain.sh[:num, 0])
    assert torch.equal(relit.means, plain.means)
