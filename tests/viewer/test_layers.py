"""The layers that the viewer shows."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.scenes import along_z
from warpgs.cameras import Camera
from warpgs.model.splats import Splats
from warpgs.viewer.layers import LAYERS, render_layer

BLACK = [0, 0, 0]
CAMERA = along_z(40.0, (32, 24))


def splats(depths=(2.0, 4.0), is_dynamic=(False, True)):
    """An opaque red static Gaussian on the left and an opaque green dynamic one on the right."""
    N = len(depths)
    means = torch.tensor([[(-0.2 + 0.4 * k) * z, 0.0, z] for k, z in enumerate(depths)]).view(-1, 3)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(N, 4).contiguous()
    scales = torch.tensor(depths)[:, None].expand(N, 3) * 0.1
    dc = (torch.eye(3)[:N, None] - 0.5) / 0.28209479177387814
    return Splats(
        means, quats, scales, torch.full((N,), 0.99), sh=dc, is_dynamic=torch.tensor(is_dynamic, dtype=torch.bool)
    )


def sides(layer, scene=None):
    """The colours at the centres of both Gaussians."""
    image = render_layer(layer, scene or splats(), CAMERA)
    assert image.shape == (24, 32, 3)
    assert image.dtype == np.uint8
    return image[12, 8].tolist(), image[12, 24].tolist()


@pytest.mark.parametrize("layer", ["joint", "static", "dynamic"])
def test_a_layer_shows_the_gaussians_of_its_branch(layer):
    left, right = sides(layer)
    assert left == BLACK if layer == "dynamic" else left[0] > 200
    assert right == BLACK if layer == "static" else right[1] > 200


def test_alpha_is_white_where_the_image_is_opaque():
    image = render_layer("alpha", splats(), CAMERA)
    assert min(image[12, 8]) > 200
    assert image[0, 16].tolist() == BLACK


def test_the_dynamic_weight_is_white_on_dynamic_gaussians():
    left, right = sides("dynamic weight")
    assert left == BLACK
    assert min(right) > 200


def test_objects_have_colours_of_their_own_and_numbers():
    numbered = dataclasses.replace(splats(), objects=torch.tensor([2, 1]))
    left, right = sides("objects", numbered)
    assert left[1] > 2 * left[0]
    assert right[0] > 2 * right[1]
    image = render_layer("objects", numbered, along_z(400.0, (320, 240)))
    assert (image.min(2) > 230).sum() > 20  # of the numbers


def test_what_belongs_to_no_object_is_grey():
    for scene in (splats(), dataclasses.replace(splats(), objects=torch.tensor([0, 0]))):
        for color in sides("objects", scene):
            assert len({*color}) == 1
            assert 50 < color[0] < 100


def test_the_dynamic_weight_omits_hidden_gaussians():
    scene = splats()
    front = scene.means.clone()
    front[1] = 2.0 * front[0]  # the dynamic Gaussian is now behind the static one
    hidden = Splats(front, scene.quats, scene.scales, scene.opacities, sh=scene.sh, is_dynamic=scene.is_dynamic)
    assert max(sides("dynamic weight", hidden)[0]) < 20


def test_depth_is_red_near_blue_far_and_black_where_empty():
    (near_red, _, near_blue), (far_red, _, far_blue) = sides("depth")
    assert near_red > near_blue
    assert far_blue > far_red
    assert render_layer("depth", splats(), CAMERA)[0, 16].tolist() == BLACK


def test_a_scene_at_one_depth_has_a_depth_image():
    assert render_layer("depth", splats((2.0,), (False,)), CAMERA)[12, 8].any()


@pytest.mark.parametrize("layer", LAYERS)
def test_an_empty_scene_is_black(layer):
    assert not render_layer(layer, splats((), ()), CAMERA).any()


@pytest.mark.parametrize("layer", LAYERS)
def test_an_image_of_one_pixel_is_rendered(layer):
    camera = Camera(CAMERA.viewmat, torch.tensor([[1.0, 0, 0.5], [0, 1.0, 0.5], [0, 0, 1]]), 1, 1)
    assert render_layer(layer, splats(), camera).shape == (1, 1, 3)


def test_another_layer_takes_one_entry(monkeypatch):
    def inverted(splats, camera, settings):
        return 255 - LAYERS["joint"](splats, camera, settings)

    monkeypatch.setitem(LAYERS, "inverted", inverted)
    assert (render_layer("inverted", splats(), CAMERA) == 255 - render_layer("joint", splats(), CAMERA)).all()
