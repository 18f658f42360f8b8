"""The first Gaussians: from points, and from the depth of what moves."""

import dataclasses

import pytest
import torch

from tests.scenes import HEIGHT, WIDTH, error, generator, make_camera
from warpgs.config import ModelConfig, TrainConfig
from warpgs.data.capture import Capture, Frame
from warpgs.training import initialize
from warpgs.training import point_cloud as init
from warpgs.training.views import Views

CAMERA = make_camera()
NETWORK = ModelConfig(
    position_bands=1, time_bands=1, depth=1, width=2, max_static_points=20, dynamic_points=30
)  # networks play no part here
CONFIG = TrainConfig(model=NETWORK)
DEPTH = 2.5
BLOCK = (slice(10, 20), slice(15, 35))
"""Where something moves: 200 pixels."""


def grid(spacing):
    """Points of a cubic grid, three along each axis."""
    axis = spacing * torch.arange(3.0)
    return torch.cartesian_prod(axis, axis, axis)


def random_points(num):
    return torch.randn(num, 3, generator=generator())


def moving_mask():
    static = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    static[BLOCK] = False
    return static


def make_capture(points, colors=None, inverse_depth=None, num_frames=3):
    """Frames of one camera; the moving block is red, the rest green."""
    static = moving_mask()
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    image[..., 0], image[..., 1] = 255 * (~static), 255 * static
    names = [str(number) for number in range(num_frames)]
    cameras = {name: dataclasses.replace(CAMERA, time=int(name) / num_frames) for name in names}

    def read(name):
        return Frame(name, cameras[name], image, static, inverse_depth)

    return Capture("made up", cameras, names, [], points, colors, read)


def dynamic_gaussians(capture, alignments, config=CONFIG):
    views = Views(capture, torch.device("cpu"), 1 << 30)
    scene = initialize.first_scene(config, capture, generator())
    return initialize.dynamic_gaussians(config, capture, views, alignments, scene, generator())


def constant_depth():
    """Inverse depth in units of its own: DEPTH is at 2 · 0.3 − 0.2."""
    return torch.full((HEIGHT, WIDTH), 0.3)


ALIGNMENT = torch.tensor([[2.0, -0.2]] * 3)


# From points ---------------------------------------------------------------------------------------------------------


def test_the_size_of_a_gaussian_is_the_root_mean_square_distance_to_three_neighbours():
    points = random_points(40)
    distances = (points[:, None].double() - points[None].double()).norm(dim=2).sort(1).values
    expected = (distances[:, 1:4] ** 2).mean(1).sqrt()
    gaussians = init.from_points(points, torch.rand(40, 3))
    assert error(gaussians.scales.detach(), expected[:, None].expand(40, 3)) < 1e-6


def test_sizes_scale_with_the_points():
    small, large = (init.from_points(grid(spacing), torch.rand(27, 3)).scales for spacing in (0.1, 10.0))
    assert error(large, 100 * small) < 1e-4


def test_gaussians_lie_at_their_points_and_are_faint():
    points = random_points(20)
    gaussians = init.from_points(points, torch.rand(20, 3))
    assert torch.equal(gaussians.means, points)
    assert error(gaussians.opacities, torch.full((20,), 0.1)) < 1e-6


def test_points_at_one_place_have_a_size_all_the_same():
    points = torch.cat([random_points(20), torch.zeros(5, 3)])
    gaussians = init.from_points(points, torch.rand(25, 3))
    assert gaussians.log_scales.isfinite().all()
    assert (gaussians.scales > 0).all()


def test_a_far_point_does_not_get_the_size_of_the_scene():
    points = torch.cat([grid(0.1), torch.tensor([[1000.0, 0.0, 0.0]])])
    assert init.from_points(points, torch.rand(28, 3)).scales.max() <= 10.0 * 0.1 * 1.001


def test_all_points_at_one_place_give_gaussians_all_the_same():
    assert init.from_points(torch.ones(9, 3), torch.rand(9, 3)).log_scales.isfinite().all()


@pytest.mark.parametrize("num", range(5))
def test_few_points_are_enough(num):
    gaussians = init.from_points(random_points(num), torch.rand(num, 3))
    assert len(gaussians) == num
    assert gaussians.log_scales.isfinite().all()


def test_the_first_static_gaussians_take_the_colours_of_the_points():
    points, colors = random_points(9), torch.randint(0, 256, (9, 3), generator=generator(), dtype=torch.uint8)
    static = initialize.first_scene(CONFIG, make_capture(points, colors), generator()).static
    assert torch.equal(static.means, points)
    assert error(0.5 + 0.28209479 * static.sh_dc[:, 0].double(), colors.double() / 255.0) < 1e-6


def test_of_many_points_a_random_share_becomes_static_gaussians():
    points = random_points(500)
    static = initialize.first_scene(CONFIG, make_capture(points), generator()).static
    assert len(static) == NETWORK.max_static_points
    assert (static.means[:, None] == points).all(2).any(1).all()
    assert len(static.means.unique(dim=0)) == NETWORK.max_static_points


def test_without_points_static_gaussians_begin_anywhere_in_the_unit_box():
    static = initialize.first_scene(CONFIG, make_capture(torch.zeros(0, 3)), generator()).static
    assert len(static) == NETWORK.max_static_points
    assert static.means.abs().max() <= 1.0
    assert static.means.std(0).min() > 0.3


def test_a_scene_begins_without_dynamic_gaussians():
    assert len(initialize.first_scene(CONFIG, make_capture(random_points(9)), generator()).dynamic) == 0


def test_the_first_networks_depend_on_the_seed_alone():
    capture = make_capture(random_points(9))
    weights = []
    for seed, disturbance in ((1, 0), (1, 1), (2, 1)):
        torch.manual_seed(disturbance)
        scene = initialize.first_scene(dataclasses.replace(CONFIG, seed=seed), capture, generator())
        weights.append(scene.deformation.trunk.values)
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_a_subsample_is_in_order_and_without_repetition():
    chosen = init.subsample(random_points(100), 30, generator())
    assert len(chosen) == 30
    assert (chosen.diff() > 0).all()
    assert 0 <= chosen.min() <= chosen.max() < 100


def test_few_points_are_all_taken():
    assert init.subsample(random_points(5), 5, generator()).tolist() == [0, 1, 2, 3, 4]


# The box -------------------------------------------------------------------------------------------------------------


def test_the_box_holds_the_points_with_a_margin():
    points = torch.rand(1001, 3, generator=generator()) * torch.tensor([2.0, 4.0, 1.0]) + torch.tensor([5.0, 0, -3.0])
    center, half_size = init.scene_box(points)
    assert error(center, torch.tensor([6.0, 2.0, -2.5])) < 0.1
    assert ((points - center).abs() <= half_size).all()
    assert half_size.max() < 1.25 * 2.0


def test_the_box_is_as_long_along_every_axis():
    _, half_size = init.scene_box(random_points(100) * torch.tensor([1.0, 5.0, 0.1]))
    assert half_size[0] == half_size[1] == half_size[2]


@pytest.mark.parametrize("distance", [1e6, -1e6])
def test_a_few_points_far_away_do_not_widen_the_box(distance):
    points = torch.rand(1000, 3, generator=generator())
    far = points.clone()
    far[:3] = distance
    for plain, widened in zip(init.scene_box(points), init.scene_box(far), strict=True):
        assert error(widened, plain) < 0.01


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.ones(1, 3), torch.ones(50, 3)])
def test_the_box_is_never_flat(points):
    assert (init.scene_box(points)[1] > 0).all()


# Colours from the views ----------------------------------------------------------------------------------------------


def points_at(row, column, depth=DEPTH):
    size = (len(row),)
    return CAMERA.unproject(torch.tensor(row), torch.tensor(column), torch.full(size, depth))


def test_a_point_takes_the_mean_colour_of_the_pixels_it_falls_on():
    dark, bright = torch.zeros(2, HEIGHT, WIDTH, 3, dtype=torch.uint8)
    dark[5, 7] = torch.tensor([0, 51, 102])
    bright[5, 7] = torch.tensor([255, 51, 0])
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    views = [(CAMERA, image, everywhere) for image in (dark, bright)]
    colors = init.color_points(points_at([5, 6], [7, 7]), views)
    assert error(colors, torch.tensor([[0.5, 0.2, 0.2], [0.0, 0.0, 0.0]])) < 1e-6


def test_moving_pixels_lend_points_no_colour():
    image = torch.full((HEIGHT, WIDTH, 3), 255, dtype=torch.uint8)
    black = torch.zeros_like(image)
    views = [(CAMERA, image, moving_mask()), (CAMERA, black, torch.ones(HEIGHT, WIDTH, dtype=torch.bool))]
    colors = init.color_points(points_at([12, 2], [20, 20]), views)
    assert error(colors, torch.tensor([[0.0] * 3, [0.5] * 3])) < 1e-6


def test_points_that_no_view_sees_are_grey():
    image = torch.full((HEIGHT, WIDTH, 3), 255, dtype=torch.uint8)
    views = [(CAMERA, image, torch.ones(HEIGHT, WIDTH, dtype=torch.bool))]
    assert (init.color_points(points_at([12], [20], depth=-DEPTH), views) == 0.5).all()


# From masked depth ---------------------------------------------------------------------------------------------------


def test_lifted_pixels_project_back_to_their_places_and_depths():
    depth = 1.0 + torch.rand(HEIGHT, WIDTH, generator=generator())
    points, _ = init.lift(depth, ~moving_mask(), torch.rand(HEIGHT, WIDTH, 3), CAMERA)
    viewed = points.double() @ CAMERA.viewmat[:3, :3].T.double() + CAMERA.viewmat[:3, 3].double()
    pixels = viewed @ CAMERA.K.T.double()
    row, column = (~moving_mask()).nonzero(as_tuple=True)
    assert error(viewed[:, 2], depth[BLOCK].flatten()) < 1e-5
    assert error(pixels[:, 0] / pixels[:, 2], column + 0.5) < 1e-4
    assert error(pixels[:, 1] / pixels[:, 2], row + 0.5) < 1e-4


def test_lifted_pixels_keep_their_colours():
    image = torch.rand(HEIGHT, WIDTH, 3, generator=generator())
    _, colors = init.lift(torch.ones(HEIGHT, WIDTH), ~moving_mask(), image, CAMERA)
    assert torch.equal(colors, image[BLOCK].reshape(-1, 3))


def test_pixels_without_depth_are_not_lifted():
    depth = torch.ones(HEIGHT, WIDTH)
    depth[12, 15:35] = torch.nan
    depth[13, 15:35] = torch.inf
    points, colors = init.lift(depth, ~moving_mask(), torch.rand(HEIGHT, WIDTH, 3), CAMERA)
    assert len(points) == len(colors) == 200 - 40


def test_dynamic_gaussians_begin_where_something_moves_at_the_aligned_depth():
    gaussians = dynamic_gaussians(make_capture(random_points(9), inverse_depth=constant_depth()), ALIGNMENT)
    row, column, depth, inside = CAMERA.project(gaussians.means.detach())
    assert len(gaussians) == NETWORK.dynamic_points
    assert inside.all()
    assert not moving_mask()[row, column].any()
    assert error(depth, torch.full_like(depth, DEPTH)) < 5e-3  # depth is kept in half precision


def test_dynamic_gaussians_take_the_colour_of_what_moves():
    gaussians = dynamic_gaussians(make_capture(random_points(9), inverse_depth=constant_depth()), ALIGNMENT)
    colors = 0.5 + 0.28209479 * gaussians.sh_dc[:, 0]
    assert error(colors, torch.tensor([1.0, 0.0, 0.0]).expand_as(colors)) < 1e-6


def test_frames_that_could_not_be_aligned_give_no_dynamic_gaussians():
    alignments = ALIGNMENT.clone()
    alignments[1:] = torch.nan
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(NETWORK, dynamic_points=10_000))
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    assert len(dynamic_gaussians(capture, alignments, config)) == 200
    assert len(dynamic_gaussians(capture, ALIGNMENT, config)) == 600


def mostly_unknown():
    """What depth from motion leaves of what moves: a few pixels at its border."""
    plane = torch.full((HEIGHT, WIDTH), torch.nan)
    plane[BLOCK[0], BLOCK[1].start] = 0.3
    return plane


def points_around_the_block(depth):
    row = torch.tensor([8, 8, 22, 22, 15, 15, 8, 22])
    column = torch.tensor([13, 37, 13, 37, 13, 37, 25, 25])
    return CAMERA.unproject(row, column, depth)


@pytest.mark.parametrize("inverse_depth", [None, mostly_unknown()])
def test_without_depth_dynamic_gaussians_begin_before_the_points_around_them(inverse_depth):
    points = points_around_the_block(torch.linspace(2.0, 3.0, 8))
    gaussians = dynamic_gaussians(make_capture(points, inverse_depth=inverse_depth), ALIGNMENT)
    row, column, depth, _ = CAMERA.project(gaussians.means.detach())
    assert len(gaussians) == NETWORK.dynamic_points
    assert not moving_mask()[row, column].any()
    assert error(depth, torch.full_like(depth, 2.0 * initialize.BEFORE)) < 1e-4


def test_only_the_points_around_a_moving_pixel_count():
    around, corner = points_around_the_block(torch.full((8,), 3.0)), torch.zeros(1, dtype=torch.long)
    points = torch.cat([around, around, CAMERA.unproject(corner, corner, torch.ones(1))])
    depth = CAMERA.project(dynamic_gaussians(make_capture(points), ALIGNMENT).means.detach())[2]
    assert error(depth, torch.full_like(depth, 3.0 * initialize.BEFORE)) < 1e-4


@pytest.mark.parametrize("inverse_depth", [None, torch.full((HEIGHT, WIDTH), torch.nan)])
def test_without_depth_and_points_in_sight_dynamic_gaussians_begin_anywhere_in_the_box(inverse_depth):
    points = random_points(200) + CAMERA.position + 50.0 * (CAMERA.position / CAMERA.position.norm())
    gaussians = dynamic_gaussians(make_capture(points, inverse_depth=inverse_depth), ALIGNMENT)
    center, half_size = init.scene_box(points)
    assert len(gaussians) == NETWORK.dynamic_points
    assert ((gaussians.means - center).abs() <= half_size).all()


def test_where_nothing_moves_there_are_no_dynamic_gaussians():
    config = dataclasses.replace(CONFIG, assume="static")
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    assert len(dynamic_gaussians(capture, ALIGNMENT, config)) == 0


def test_where_masks_say_that_nothing_moves_there_are_no_dynamic_gaussians():
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    views = Views(capture, torch.device("cpu"), 1 << 30, assume="static")
    scene = initialize.first_scene(CONFIG, capture, generator())
    assert len(initialize.dynamic_gaussians(CONFIG, capture, views, ALIGNMENT, scene, generator())) == 0


def test_gaussians_of_unknown_place_are_small_enough_to_stay():
    gaussians = dynamic_gaussians(capture := make_capture(100.0 * random_points(50)), ALIGNMENT)
    assert gaussians.scales.max() < CONFIG.densify.max_size * capture.extent


def test_where_everything_moves_the_points_become_dynamic_gaussians():
    config, capture = dataclasses.replace(CONFIG, assume="dynamic"), make_capture(random_points(9))
    assert len(initialize.first_scene(config, capture, generator()).static) == 0
    assert torch.equal(dynamic_gaussians(capture, ALIGNMENT, config).means, capture.points)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("assume", ["masks", "static", "dynamic"])
def test_the_first_gaussians_hold_the_coefficients_of_the_model(degree, assume):
    config = dataclasses.replace(CONFIG, assume=assume, model=dataclasses.replace(NETWORK, sh_degree=degree))
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    scene = initialize.first_scene(config, capture, generator())
    for gaussians in (scene.static, scene.dynamic, dynamic_gaussians(capture, ALIGNMENT, config)):
        assert gaussians.sh.shape[1] == (degree + 1) ** 2
