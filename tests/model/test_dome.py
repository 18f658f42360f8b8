"""The sky: colours by the direction of a pixel, whatever the lens, behind everything."""

import dataclasses
import math

import pytest
import torch

from tests.lens_captures import CAMERAS, SIZE
from tests.scenes import along_z, make_splats
from warpgs.config import RenderSettings
from warpgs.distortion import Distortion
from warpgs.model.dome import Dome, seen_colors
from warpgs.rendering import Layer, render

ROWS, COLUMNS = 128, 256
TURNED = [[0.0, 0.6, 0.8, 0.3], [-1.0, 0.0, 0.0, -2.0], [0.0, -0.8, 0.6, 5.0], [0.0, 0.0, 0.0, 1.0]]
PANORAMA = dataclasses.replace(along_z(10.0, (64, 32)), distortion=Distortion.equirectangular())
LENSES = {"pinhole": along_z(30.0, SIZE), **CAMERAS, "equirectangular": PANORAMA}


def smooth(directions):
    """A smooth colour of directions of any length."""
    unit = torch.nn.functional.normalize(directions, dim=-1)
    return 0.5 + 0.4 * torch.stack([unit.sum(-1) / 2, unit[..., 2], unit[..., 0] * unit[..., 1]], -1)


def smooth_dome():
    around = (torch.arange(COLUMNS) + 0.5) * 2.0 * math.pi / COLUMNS
    up = math.pi / 2 - (torch.arange(ROWS) + 0.5) * math.pi / ROWS
    up, around = torch.meshgrid(up, around, indexing="ij")
    directions = torch.stack([up.cos() * around.cos(), up.cos() * around.sin(), up.sin()], -1)
    return Dome(smooth(directions).permute(2, 0, 1).contiguous())


@pytest.fixture
def dome():
    return smooth_dome()


@pytest.mark.parametrize("lens", LENSES)
def test_a_pixel_shows_the_colour_of_its_direction_in_the_world(dome, lens):
    camera = dataclasses.replace(LENSES[lens], viewmat=torch.tensor(TURNED))
    rotation, rays = camera.viewmat[:3, :3], camera.rays(camera.pixel_centers)
    expected = smooth(rays @ rotation).view(camera.height, camera.width, 3)
    seen = rays.isfinite().all(1).view(camera.height, camera.width)
    assert seen.float().mean() > 0.5
    assert (dome(camera) - expected)[seen].abs().max() < 2e-3
    assert dome(camera).isfinite().all()


def test_directions_of_a_rolling_shutter_are_those_of_distant_points():
    motion = torch.tensor([[0.2, -0.3, 0.1], [0.5, 0.0, 0.4]])
    camera = dataclasses.replace(along_z(30.0, SIZE), viewmat=torch.tensor(TURNED), motion=motion, duration=0.1)
    row, column = (
        index.flatten() for index in torch.meshgrid(torch.arange(SIZE[1]), torch.arange(SIZE[0]), indexing="ij")
    )
    far = camera.unproject(row, column, torch.full((len(row),), 1e6)) / 1e6
    assert torch.allclose(far, camera.directions(), atol=1e-4)
    assert not torch.allclose(far, dataclasses.replace(camera, motion=None, duration=0.0).directions(), atol=1e-2)


@pytest.mark.parametrize("lens", ["pinhole", "equirectangular"])
def test_what_gaussians_let_through_shows_the_sky_in_every_image(dome, lens):
    settings, splats = RenderSettings(branches=True), make_splats()
    camera = LENSES[lens]
    under = render(dataclasses.replace(splats, background=dome), camera, settings=settings)
    for layer, plain in zip(under[:3], render(splats, camera, settings=settings)[:3], strict=True):
        assert torch.allclose(layer.image, plain.image + (1.0 - plain.alpha[..., None]) * dome(camera))
        assert torch.equal(layer.alpha, plain.alpha)
        assert not torch.equal(layer.image, plain.image)


def test_a_sky_is_not_behind_features_of_another_number(dome):
    colors = torch.rand(len(make_splats().means), 5)
    splats = dataclasses.replace(make_splats(), colors=colors, sh=None, sh_degree=None, background=dome)
    plain = dataclasses.replace(splats, background=None)
    assert torch.equal(render(splats, LENSES["pinhole"]).joint.image, render(plain, LENSES["pinhole"]).joint.image)


def test_gradients_of_what_is_under_a_sky_are_exact():
    image, sky = (torch.rand(4, 5, 3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    alpha = (0.4 * torch.rand(4, 5, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda *t: Layer(t[0], t[1], None).under(t[2]).image, (image, alpha, sky))


def test_what_walls_let_through_leaves_the_sky_as_it_is(dome):
    alpha = torch.zeros(SIZE[::-1])
    alpha[:, :20] = 0.9
    camera = LENSES["pinhole"]
    layer = Layer(torch.zeros(*alpha.shape, 3), alpha, None)
    layer.under(dome(camera)).image.sum().backward()
    opened = torch.where(alpha < 0.5, 1.0, 0.0)
    (expected,) = torch.autograd.grad((dome(camera) * opened[..., None]).sum(), dome.texels)
    assert torch.equal(dome.texels.grad, expected)
    assert expected.abs().sum() > 0


def test_only_known_depth_hides_the_sky():
    depth = torch.tensor([[0.1, 0.5, torch.nan]])
    assert Dome(far=0.1).hidden(depth).tolist() == [[False, True, False]]
    assert Dome().hidden(depth).tolist() == [[False, False, False]]


def test_colours_begin_as_frames_show_them_and_go_on_around_them(dome):
    mask = torch.zeros(32, 64, dtype=torch.bool)
    mask[10:20] = True
    camera = dataclasses.replace(PANORAMA, viewmat=torch.tensor(TURNED))
    colors = seen_colors([(camera, dome(camera).detach(), mask)], 32, 64)
    found = Dome(colors)(camera)
    assert (found - dome(camera))[12:18].abs().mean() < 0.03
    assert colors.min() > 0.0
    assert colors.max() < 1.0
    turns = (colors - colors.roll(1, 2)).abs().amax()  # no seam where columns begin again
    assert (colors[..., 0] - colors[..., -1]).abs().amax() <= turns
    assert torch.equal(seen_colors([], 4, 8), torch.full((3, 4, 8), 0.5))


def test_pixels_in_which_the_lens_sees_nothing_tell_no_colour():
    camera = dataclasses.replace(
        CAMERAS["fisheye"], distortion=dataclasses.replace(CAMERAS["fisheye"].distortion, circle=0.5)
    )
    shown = camera.shown
    assert not shown.all()
    image = torch.where(shown[..., None], torch.ones(*shown.shape, 3), 0.0)
    colors = seen_colors([(camera, image, torch.ones_like(shown))], 16, 32)
    assert torch.allclose(colors, torch.ones(3, 16, 32))


def test_a_camera_that_is_not_finite_sees_finite_colours(dome):
    camera = dataclasses.replace(CAMERAS["fisheye"], viewmat=torch.full((4, 4), torch.nan))
    assert dome(camera).isfinite().all()


def test_splats_move_to_another_device_with_their_sky(dome):
    moved = dataclasses.replace(make_splats(), background=dome).to("cpu")
    assert isinstance(moved.background, Dome)
    assert torch.equal(moved.background.texels, dome.texels)
