"""Initial Gaussians: from points, and from the depth of dynamic pixels."""

import dataclasses
from unittest.mock import MagicMock, Mock

import pytest
import torch

from tests import plain, tiny
from tests.scenes import HEIGHT, WIDTH, error, generator, make_camera
from warpgs.data.capture import Capture, Frame
from warpgs.initialization import alignment, dynamic_points, initialize, motion_fit
from warpgs.initialization.point_cloud import (
    color_points,
    distinct,
    gaussians_at,
    scene_box,
    subsample,
    unproject,
)
from warpgs.model.fields import FIELDS, make_deformation
from warpgs.runs.logger import TrainingLogger
from warpgs.views import views as views_module
from warpgs.views.views import Views

CAMERA = make_camera()
NETWORK = plain.model(
    position_bands=1, time_bands=1, depth=1, width=2, max_static_points=20, dynamic_points=30
)  # networks do not matter here
CONFIG = plain.config(model=NETWORK)
DEGREE = NETWORK.sh_degree
DEPTH = 2.5
BLOCK = (slice(10, 20), slice(15, 35))
"""The dynamic region: 200 pixels."""


def grid(spacing):
    """Points of a cubic grid, three per axis."""
    axis = spacing * torch.arange(3.0)
    return torch.cartesian_prod(axis, axis, axis)


def random_points(num):
    return torch.randn(num, 3, generator=generator())


def static_mask():
    static = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    static[BLOCK] = False
    return static


def make_capture(points, colors=None, inverse_depth=None, num_frames=3):
    """Frames of one camera; the dynamic block is red, the rest green."""
    static = static_mask()
    image = torch.zeros(HEIGHT, WIDTH, 3, dtype=torch.uint8)
    image[..., 0], image[..., 1] = 255 * (~static), 255 * static
    names = [str(number) for number in range(num_frames)]
    cameras = {name: dataclasses.replace(CAMERA, time=int(name) / num_frames) for name in names}

    def read(name):
        return Frame(name, cameras[name], image, static, inverse_depth)

    return Capture("made up", cameras, names, [], points, colors, read)


def with_frames(capture, read):
    """The capture, with frames as ``read`` returns them."""
    return Capture("made up", capture.cameras, capture.train, [], capture.points, None, read)


def views_of(capture):
    return Views(capture, torch.device("cpu"), 1 << 30)


def initial_scene(config, capture):
    return initialize.initial_scene(config, capture, views_of(capture), generator())


def dynamic_start(capture, alignments, config=CONFIG, deformation=None):
    views, deformation = views_of(capture), deformation or torch.nn.Identity()
    return initialize.dynamic_gaussians(config, capture, views, alignments, deformation, generator())


def dynamic_gaussians(*arguments):
    return dynamic_start(*arguments).gaussians


def constant_depth():
    """Inverse depth before alignment: that of DEPTH is 2 · 0.3 − 0.2."""
    return torch.full((HEIGHT, WIDTH), 0.3)


ALIGNMENT = torch.tensor([[2.0, -0.2]] * 3)


def test_the_size_of_a_gaussian_is_the_root_mean_square_distance_to_three_neighbours():
    points = random_points(40)
    distances = (points[:, None].double() - points[None].double()).norm(dim=2).sort(1).values
    expected = (distances[:, 1:4] ** 2).mean(1).sqrt()
    gaussians = gaussians_at(points, torch.rand(40, 3), DEGREE)
    assert error(gaussians.scales.detach(), expected[:, None].expand(40, 3)) < 1e-6


def test_sizes_scale_with_the_points():
    small, large = (gaussians_at(grid(spacing), torch.rand(27, 3), DEGREE).scales for spacing in (0.1, 10.0))
    assert error(large, 100 * small) < 1e-4


def test_gaussians_start_at_their_points_with_an_opacity_of_a_tenth():
    points = random_points(20)
    gaussians = gaussians_at(points, torch.rand(20, 3), DEGREE)
    assert torch.equal(gaussians.means, points)
    assert error(gaussians.opacities, torch.full((20,), 0.1)) < 1e-6


def merged(points, copies, jitter=0.0):
    """The points several times, as merged clouds contain them, shuffled, and moved by a fraction of their position."""
    order = torch.randperm(copies * len(points), generator=generator())
    repeated = points.repeat(copies, 1)[order]
    return repeated * (1.0 + jitter * torch.randn(repeated.shape, generator=generator())), order % len(points)


@pytest.mark.parametrize("jitter", [0.0, 1e-7])
@pytest.mark.parametrize("copies", [2, 4, 30])
def test_points_that_occur_several_times_have_the_size_of_single_ones(copies, jitter):
    points = 5.0 + random_points(50)
    repeated, original = merged(points, copies, jitter)
    single, several = (gaussians_at(p, torch.rand(len(p), 3), DEGREE).scales.detach() for p in (points, repeated))
    assert error(several / single[original], torch.ones_like(several)) < 1e-4


@pytest.mark.parametrize("spread", [1e-6, 1e-4, 3e-3])
def test_clusters_closer_than_cameras_resolve_have_the_size_of_single_points(spread):
    points = 0.5 * random_points(200)
    repeated, original = merged(points, 6)
    repeated = repeated + spread * torch.randn(repeated.shape, generator=generator(1))
    single = gaussians_at(points, torch.rand(200, 3), DEGREE).scales.detach()[original]
    several = gaussians_at(repeated, torch.rand(1200, 3), DEGREE, resolution=0.02).scales.detach()
    assert several.min() >= 0.02
    assert (several / single).median().item() == pytest.approx(1.0, abs=0.15)
    assert (several / single).min() > 0.3


def test_the_resolution_changes_no_sizes_of_points_that_are_farther_apart():
    points, colors = grid(0.1), torch.rand(27, 3)
    plain, resolved = (gaussians_at(points, colors, DEGREE, resolution=r).scales for r in (0.0, 0.02))
    assert torch.equal(plain, resolved)


def test_static_gaussians_of_a_cloud_of_several_scans_are_visible():
    points = points_at([9, 12, 14, 20, 25, 30], [9, 20, 30, 7, 40, 25])
    capture = make_capture(points.repeat(20, 1) + 1e-4 * torch.randn(120, 3, generator=generator()))
    static = initial_scene(CONFIG, capture).static
    assert static.scales.min() > 0.25 * DEPTH / 46.0


@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_what_cameras_resolve_is_a_quarter_of_the_mean_side_of_a_pixel(monkeypatch, aspect):
    capture = make_capture(random_points(9))
    sides = torch.tensor([[1.0], [aspect], [1.0]])
    capture = capture.with_cameras({n: dataclasses.replace(c, K=c.K * sides) for n, c in capture.cameras.items()})
    start = Mock(wraps=gaussians_at)
    monkeypatch.setattr(initialize, "gaussians_at", start)
    initial_scene(CONFIG, capture)
    focal_x, focal_y, _ = capture.cameras["0"].K.diagonal().tolist()
    assert start.call_args.kwargs["resolution"] == pytest.approx(
        0.25 * capture.median_depth / (0.5 * (focal_x + focal_y)), rel=1e-5
    )


def test_a_place_that_holds_most_points_does_not_change_the_sizes_elsewhere():
    points = random_points(50)
    crowded = torch.cat([points, points[:1].expand(5_000, 3)])
    alone, among = (gaussians_at(p, torch.rand(len(p), 3), DEGREE).scales.detach() for p in (points, crowded))
    assert error(among[:50], alone) < 1e-6
    assert error(among[50:], alone[:1].expand(5_000, 3)) < 1e-6


def test_few_points_have_half_of_the_maximum_size():
    few = gaussians_at(torch.randn(3, 3), torch.zeros(3, 3), DEGREE, 8.0)
    assert few.scales.unique().tolist() == pytest.approx([4.0])


@pytest.mark.parametrize("places", [1, 2, 3])
def test_points_at_few_places_have_the_size_of_few_points(places):
    points = random_points(places)
    gaussians = gaussians_at(merged(points, 9)[0], torch.rand(9 * places, 3), DEGREE)
    assert torch.equal(gaussians.scales[0], gaussians_at(points, torch.rand(places, 3), DEGREE).scales[0])


def test_close_points_are_distinct_down_to_rounding():
    points = torch.tensor([[1.0, 1.0, 1.0], [1.0, 1.0, 1.0 + 4e-6], [1.0, 1.0, 1.0 + 2e-7], [0.0, 0.0, 0.0]])
    first, place = distinct(points)
    assert first.tolist() == [0, 1, 3]
    assert place.tolist() == [0, 1, 0, 2]


def test_the_size_of_a_distant_point_is_limited():
    points = torch.cat([grid(0.1), torch.tensor([[1000.0, 0.0, 0.0]])])
    assert gaussians_at(points, torch.rand(28, 3), DEGREE).scales.max() <= 10.0 * 0.1 * 1.001


@pytest.mark.parametrize("num", range(5))
def test_few_points_are_enough(num):
    gaussians = gaussians_at(random_points(num), torch.rand(num, 3), DEGREE)
    assert len(gaussians) == num
    assert gaussians.log_scales.isfinite().all()


def test_initial_static_gaussians_have_the_colours_of_the_points():
    points, colors = random_points(9), torch.randint(0, 256, (9, 3), generator=generator(), dtype=torch.uint8)
    static = initial_scene(CONFIG, make_capture(points, colors)).static
    assert torch.equal(static.means, points)
    assert error(0.5 + 0.28209479 * static.sh_dc[:, 0].double(), colors.double() / 255.0) < 1e-6


def test_many_points_are_subsampled_at_random():
    points = random_points(500)
    static = initial_scene(CONFIG, make_capture(points)).static
    assert len(static) == NETWORK.max_static_points
    assert (static.means[:, None] == points).all(2).any(1).all()
    assert len(static.means.unique(dim=0)) == NETWORK.max_static_points


def test_without_points_static_gaussians_start_at_random_in_the_unit_box():
    static = initial_scene(CONFIG, make_capture(torch.zeros(0, 3))).static
    assert len(static) == NETWORK.max_static_points
    assert static.means.abs().max() <= 1.0
    assert static.means.std(0).min() > 0.3


def test_a_scene_starts_without_dynamic_gaussians():
    assert len(initial_scene(CONFIG, make_capture(random_points(9))).dynamic) == 0


def test_initial_networks_depend_on_the_seed_only():
    capture = make_capture(random_points(9))
    weights = []
    for seed, disturbance in ((1, 0), (1, 1), (2, 1)):
        torch.manual_seed(disturbance)
        scene = initial_scene(dataclasses.replace(CONFIG, seed=seed), capture)
        weights.append(scene.deformation.trunk.values)
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_a_subsample_is_sorted_and_without_repetition():
    chosen = subsample(random_points(100), 30, generator())
    assert len(chosen) == 30
    assert (chosen.diff() > 0).all()
    assert 0 <= chosen.min() <= chosen.max() < 100


def test_few_points_are_all_taken():
    assert subsample(random_points(5), 5, generator()).tolist() == [0, 1, 2, 3, 4]


def test_the_box_contains_the_points_with_a_margin():
    points = torch.rand(1001, 3, generator=generator()) * torch.tensor([2.0, 4.0, 1.0]) + torch.tensor([5.0, 0, -3.0])
    center, half_size = scene_box(points)
    assert error(center, torch.tensor([6.0, 2.0, -2.5])) < 0.1
    assert ((points - center).abs() <= half_size).all()
    assert half_size.max() < 1.25 * 2.0


def test_the_box_is_a_cube():
    _, half_size = scene_box(random_points(100) * torch.tensor([1.0, 5.0, 0.1]))
    assert half_size[0] == half_size[1] == half_size[2]


@pytest.mark.parametrize("distance", [1e6, -1e6])
def test_a_few_distant_points_do_not_widen_the_box(distance):
    points = torch.rand(1000, 3, generator=generator())
    far = points.clone()
    far[:3] = distance
    for usual, widened in zip(scene_box(points), scene_box(far), strict=True):
        assert error(widened, usual) < 0.01


def test_points_that_occur_several_times_do_not_narrow_the_box():
    points = torch.rand(500, 3, generator=generator())
    crowded = torch.cat([points, torch.zeros(100_000, 3)])
    for alone, among in zip(scene_box(points), scene_box(crowded), strict=True):
        assert error(among, alone) < 0.02


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.ones(1, 3), torch.ones(50, 3)])
def test_the_box_is_never_flat(points):
    assert (scene_box(points)[1] > 0).all()


def points_at(row, column, depth=DEPTH):
    size = (len(row),)
    return CAMERA.unproject(torch.tensor(row), torch.tensor(column), torch.full(size, depth))


def test_a_point_has_the_mean_colour_of_its_pixels():
    dark, bright = torch.zeros(2, HEIGHT, WIDTH, 3, dtype=torch.uint8)
    dark[5, 7] = torch.tensor([0, 51, 102])
    bright[5, 7] = torch.tensor([255, 51, 0])
    everywhere = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
    views = [(CAMERA, image, everywhere) for image in (dark, bright)]
    colors = color_points(points_at([5, 6], [7, 7]), views)
    assert error(colors, torch.tensor([[0.5, 0.2, 0.2], [0.0, 0.0, 0.0]])) < 1e-6


def test_masked_pixels_do_not_colour_points():
    image = torch.full((HEIGHT, WIDTH, 3), 255, dtype=torch.uint8)
    black = torch.zeros_like(image)
    views = [(CAMERA, image, static_mask()), (CAMERA, black, torch.ones(HEIGHT, WIDTH, dtype=torch.bool))]
    colors = color_points(points_at([12, 2], [20, 20]), views)
    assert error(colors, torch.tensor([[0.0] * 3, [0.5] * 3])) < 1e-6


def test_points_outside_all_views_are_grey():
    image = torch.full((HEIGHT, WIDTH, 3), 255, dtype=torch.uint8)
    views = [(CAMERA, image, torch.ones(HEIGHT, WIDTH, dtype=torch.bool))]
    assert (color_points(points_at([12], [20], depth=-DEPTH), views) == 0.5).all()


def test_unprojected_pixels_project_to_their_positions_and_depths_and_keep_their_colours():
    depth, image = 1.0 + torch.rand(HEIGHT, WIDTH, generator=generator()), torch.rand(HEIGHT, WIDTH, 3)
    points, colors = unproject(depth, ~static_mask(), image, CAMERA)
    viewed = points.double() @ CAMERA.viewmat[:3, :3].T.double() + CAMERA.viewmat[:3, 3].double()
    pixels = viewed @ CAMERA.K.T.double()
    row, column = (~static_mask()).nonzero(as_tuple=True)
    assert error(viewed[:, 2], depth[BLOCK].flatten()) < 1e-5
    assert error(pixels[:, 0] / pixels[:, 2], column + 0.5) < 1e-4
    assert error(pixels[:, 1] / pixels[:, 2], row + 0.5) < 1e-4
    assert torch.equal(colors, image[BLOCK].reshape(-1, 3))


def test_pixels_without_depth_are_not_unprojected():
    depth = torch.ones(HEIGHT, WIDTH)
    depth[12, 15:35] = torch.nan
    depth[13, 15:35] = torch.inf
    points, colors = unproject(depth, ~static_mask(), torch.rand(HEIGHT, WIDTH, 3), CAMERA)
    assert len(points) == len(colors) == 200 - 40


def test_dynamic_gaussians_start_in_the_dynamic_region_at_the_aligned_depth_and_in_its_colour():
    gaussians = dynamic_gaussians(make_capture(random_points(9), inverse_depth=constant_depth()), ALIGNMENT)
    row, column, depth, inside = CAMERA.project(gaussians.means.detach())
    assert len(gaussians) == NETWORK.dynamic_points
    assert inside.all()
    assert not static_mask()[row, column].any()
    assert error(depth, torch.full_like(depth, DEPTH)) < 5e-3  # depth is stored in half precision
    colors = 0.5 + 0.28209479 * gaussians.sh_dc[:, 0]
    assert error(colors, torch.tensor([1.0, 0.0, 0.0]).expand_as(colors)) < 1e-6


def test_metric_depth_is_not_aligned():
    points = points_around_the_block(torch.full((8,), 3.0)).repeat(3, 1)
    capture = make_capture(points, inverse_depth=torch.full((HEIGHT, WIDTH), 0.25))
    for metric, expected in ((False, [torch.nan, torch.nan]), (True, [1.0, 0.0])):  # one value: nothing to fit
        capture.metric_depth = metric
        found = alignment.align_to_points(capture, views_of(capture), smooth=True)
        assert torch.equal(found.alignments.isnan(), torch.tensor([expected] * 3).isnan())
        assert metric == torch.equal(found.alignments, torch.tensor([expected] * 3))
    assert found.errors[:, 0].tolist() == pytest.approx([0.25] * 3)  # 3 m are 1 / 0.25 = 4 m in the files


def test_metric_depth_that_is_unknown_is_not_used():
    capture = make_capture(random_points(9), inverse_depth=torch.full((HEIGHT, WIDTH), torch.nan))
    capture.metric_depth = True
    found = alignment.align_to_points(capture, views_of(capture))
    assert found.alignments.isnan().all()


def test_frames_without_alignment_give_no_dynamic_gaussians():
    alignments = ALIGNMENT.clone()
    alignments[1:] = torch.nan
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(NETWORK, dynamic_points=10_000))
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    assert len(dynamic_gaussians(capture, alignments, config)) == 200
    assert len(dynamic_gaussians(capture, ALIGNMENT, config)) == 600


def mostly_unknown():
    """Depth as multi-view stereo gives it: in the dynamic region only a few pixels at its border."""
    inverse_depth = torch.full((HEIGHT, WIDTH), torch.nan)
    inverse_depth[BLOCK[0], BLOCK[1].start] = 0.3
    return inverse_depth


def points_around_the_block(depth):
    row = torch.tensor([8, 8, 22, 22, 15, 15, 8, 22])
    column = torch.tensor([13, 37, 13, 37, 13, 37, 25, 25])
    return CAMERA.unproject(row, column, depth)


def test_dynamic_points_are_those_of_a_sample_of_many_views(monkeypatch):
    monkeypatch.setattr(views_module, "MANY", 10)
    monkeypatch.setattr(views_module, "SAMPLED", 4)
    capture, read = make_capture(random_points(9), inverse_depth=constant_depth(), num_frames=40), []
    views = Views(with_frames(capture, lambda name: read.append(name) or capture.frame(name)), torch.device("cpu"), 0)
    alignments, mask_of = ALIGNMENT[:1].expand(40, 2), lambda view: ~view.static_mask
    read.clear()
    found = dynamic_points.unproject_pixels(views._capture, views, alignments, mask_of, 100, generator())
    assert len(found.positions) == 100
    assert found.views.unique().tolist() == [0, 13, 26, 39]
    assert {*read} == {"13", "26", "39"}  # and the first one, before


@pytest.mark.parametrize("inverse_depth", [None, mostly_unknown()])
def test_without_depth_dynamic_gaussians_start_in_front_of_the_points_around_them(inverse_depth):
    points = points_around_the_block(torch.linspace(2.0, 3.0, 8))
    gaussians = dynamic_gaussians(make_capture(points, inverse_depth=inverse_depth), ALIGNMENT)
    row, column, depth, _ = CAMERA.project(gaussians.means.detach())
    assert len(gaussians) == NETWORK.dynamic_points
    assert not static_mask()[row, column].any()
    assert error(depth, torch.full_like(depth, 2.0 * dynamic_points.DEPTH_FACTOR)) < 1e-4


def test_only_the_points_around_a_dynamic_pixel_count():
    around, corner = points_around_the_block(torch.full((8,), 3.0)), torch.zeros(1, dtype=torch.long)
    points = torch.cat([around, around, CAMERA.unproject(corner, corner, torch.ones(1))])
    depth = CAMERA.project(dynamic_gaussians(make_capture(points), ALIGNMENT).means.detach())[2]
    assert error(depth, torch.full_like(depth, 3.0 * dynamic_points.DEPTH_FACTOR)) < 1e-4


@pytest.mark.parametrize("inverse_depth", [None, torch.full((HEIGHT, WIDTH), torch.nan)])
def test_without_depth_and_visible_points_dynamic_gaussians_start_at_random_in_the_box(inverse_depth):
    points = random_points(200) + CAMERA.position + 50.0 * (CAMERA.position / CAMERA.position.norm())
    gaussians = dynamic_gaussians(make_capture(points, inverse_depth=inverse_depth), ALIGNMENT)
    center, half_size = scene_box(points)
    assert len(gaussians) == NETWORK.dynamic_points
    assert ((gaussians.means - center).abs() <= half_size).all()


WIDE = dataclasses.replace(NETWORK, depth=2, width=32)
UNFITTED = dataclasses.replace(CONFIG, model=WIDE)
FITTED = dataclasses.replace(UNFITTED, schedule=dataclasses.replace(CONFIG.schedule, fit_motion=300))
RECEDING = torch.stack([ALIGNMENT[0] * DEPTH / depth for depth in (2.5, 2.6, 2.7)])
"""With these alignments the dynamic block recedes from frame to frame."""


def new_deformation():
    torch.manual_seed(0)
    return make_deformation(WIDE, torch.zeros(3), torch.ones(3))


def test_the_deformation_is_fitted_to_dynamic_pixels_of_known_depth():
    deformation = new_deformation()
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    means = dynamic_gaussians(capture, RECEDING, FITTED, deformation).means.detach()
    assert len(means) == NETWORK.dynamic_points
    with torch.no_grad():
        moved = [means + deformation(means, torch.tensor([time]))[:, :3] for time in (0.0, 2 / 3)]
    depths = torch.stack([CAMERA.project(positions)[2].mean() for positions in moved])
    assert error(depths, torch.tensor([2.5, 2.7])) < 0.05


def is_new(deformation):
    """Whether it has the parameters of a new one."""
    pairs = zip(deformation.parameters(), new_deformation().parameters(), strict=True)
    return all(torch.equal(ours, new) for ours, new in pairs)


def test_the_deformation_is_not_fitted_to_dynamic_pixels_of_unknown_depth():
    deformation = new_deformation()
    dynamic_gaussians(make_capture(random_points(50)), ALIGNMENT, FITTED, deformation)
    assert is_new(deformation)


def test_a_start_lacks_a_fit_if_the_plan_asks_for_one_and_the_depth_of_what_moves_is_unknown():
    for depth, config, lacks in ((None, FITTED, True), (None, UNFITTED, False), (constant_depth(), FITTED, False)):
        capture = make_capture(random_points(50), inverse_depth=depth)
        assert dynamic_start(capture, RECEDING, config, new_deformation()).lacks_fit == lacks


def test_the_deformation_is_fitted_only_if_the_plan_says_so():
    """It is decided before depth is realigned, and then the deformation is in use from the start of stage I."""
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    for config in (UNFITTED, FITTED):
        deformation = new_deformation()
        dynamic_gaussians(capture, RECEDING, config, deformation)
        assert is_new(deformation) == (config is UNFITTED)


@pytest.mark.parametrize(
    ("assume", "depth", "can"), [("masks", True, True), ("masks", False, False), ("dynamic", True, False)]
)
def test_motion_can_be_fitted_where_masks_and_depth_show_it(assume, depth, can):
    capture = make_capture(random_points(50), inverse_depth=constant_depth() if depth else None).assuming(assume)
    sources = capture, views_of(capture), ALIGNMENT
    assert initialize.can_fit_motion(*sources, new_deformation()) == can
    assert not initialize.can_fit_motion(*sources, torch.nn.Identity())


@pytest.mark.parametrize("steps", [0, 2])
def test_a_fit_of_the_deformation_which_takes_a_while_is_announced(data, tmp_path, steps):
    config = dataclasses.replace(tiny.CONFIG, schedule=dataclasses.replace(tiny.SCHEDULE, fit_motion=steps))
    trainer, logger = tiny.trainer(data, tmp_path / "run", config), MagicMock(spec=TrainingLogger)
    assert trainer._add_dynamic_gaussians(logger=logger)
    lines = [call.args[0] for call in logger.log.call_args_list]
    assert lines == ["before stage I, 2 steps fit the deformation to points on what moves"] * (steps > 0)


def test_a_fit_of_the_deformation_that_is_not_used_is_told(data, tmp_path, monkeypatch):
    monkeypatch.setattr(motion_fit, "MIN_KEPT", 1.1)
    schedule = dataclasses.replace(tiny.SCHEDULE, fit_motion=2)
    trainer = tiny.trainer(data, tmp_path / "run", dataclasses.replace(tiny.CONFIG, schedule=schedule))
    logger = MagicMock(spec=TrainingLogger)
    assert trainer._add_dynamic_gaussians(logger=logger)
    assert logger.log.call_args.args[0].startswith("warning: no deformation follows what moves")
    assert len(trainer.scene.dynamic)


class Still(torch.nn.Module):
    """A deformation without parameters."""

    def __init__(self, config, center, half_size):
        super().__init__()

    def forward(self, means, time):
        return means.new_zeros(len(means), 10)


def test_nothing_is_told_of_a_fit_of_a_deformation_without_parameters(data, tmp_path, monkeypatch):
    monkeypatch.setitem(FIELDS, "still", Still)
    config = dataclasses.replace(tiny.CONFIG, model=dataclasses.replace(tiny.MODEL, deformation="still"))
    trainer, logger = tiny.trainer(data, tmp_path / "run", config), MagicMock(spec=TrainingLogger)
    assert trainer._add_dynamic_gaussians(logger=logger)
    assert logger.log.call_args_list == []
    assert len(trainer.scene.dynamic)


def test_if_everything_is_assumed_static_there_are_no_dynamic_gaussians():
    capture = make_capture(random_points(9), inverse_depth=constant_depth()).assuming("static")
    assert len(dynamic_gaussians(capture, ALIGNMENT)) == 0


def test_if_masks_mark_nothing_as_dynamic_there_are_no_dynamic_gaussians():
    capture = make_capture(random_points(9), inverse_depth=constant_depth())
    static = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)

    def read(name):
        return dataclasses.replace(capture.frame(name), static_mask=static)

    assert len(dynamic_gaussians(with_frames(capture, read), ALIGNMENT)) == 0


def test_gaussians_of_unknown_depth_are_small():
    capture = make_capture(100.0 * random_points(50))
    max_scale = dynamic_gaussians(capture, ALIGNMENT).scales.max()
    assert max_scale < 1.0001 * dynamic_points.MAX_SCALE * capture.view_size


@pytest.mark.parametrize("deformation", ["mlp", "splines"])
@pytest.mark.parametrize("unit", ["pixel", "extent"])
def test_offsets_are_in_half_view_sizes_or_as_in_the_paper_in_scene_units(deformation, unit):
    model = dataclasses.replace(CONFIG.model, deformation=deformation)
    config = dataclasses.replace(CONFIG, model=model, densify=plain.densify(unit=unit))
    capture = make_capture(points_at([12, 2], [20, 20]))
    field = initial_scene(config, capture).deformation
    units = (field.network if deformation == "splines" else field).units
    length = {"pixel": capture.view_size / 2, "extent": 1.0}[unit]
    assert units.tolist() == pytest.approx([length] * 3 + [1.0] * 7)


def test_if_everything_is_assumed_dynamic_the_points_become_dynamic_gaussians():
    capture = make_capture(random_points(9)).assuming("dynamic")
    assert len(initial_scene(CONFIG, capture).static) == 0
    assert torch.equal(dynamic_gaussians(capture, ALIGNMENT).means, capture.points)


@pytest.mark.parametrize("assumption", ["static", "dynamic"])
def test_under_an_assumption_points_take_their_colours_from_all_pixels(assumption):
    capture = make_capture(points_at([12, 2], [20, 20])).assuming(assumption)
    scene = initial_scene(CONFIG, capture)
    gaussians = scene.static if assumption == "static" else dynamic_gaussians(capture, ALIGNMENT)
    colors = 0.5 + 0.28209479 * gaussians.sh_dc[:, 0]
    assert error(colors, torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])) < 1e-6


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("assumption", ["masks", "static", "dynamic"])
def test_initial_gaussians_have_the_sh_degree_of_the_model(degree, assumption):
    config = dataclasses.replace(CONFIG, model=dataclasses.replace(NETWORK, sh_degree=degree))
    capture = make_capture(random_points(9), inverse_depth=constant_depth()).assuming(assumption)
    scene = initial_scene(config, capture)
    for gaussians in (scene.static, scene.dynamic, dynamic_gaussians(capture, ALIGNMENT, config)):
        assert gaussians.sh.shape[1] == (degree + 1) ** 2


def test_the_deformation_is_fitted_to_all_that_cameras_see_at_one_time(monkeypatch):
    capture = make_capture(grid(0.5), inverse_depth=constant_depth())
    times = {"0": 0.5, "1": 0.25, "2": 0.5}
    cameras = {name: dataclasses.replace(CAMERA, time=time) for name, time in times.items()}
    read = capture.frame
    capture = dataclasses.replace(capture, cameras=cameras)
    capture = with_frames(capture, lambda name: dataclasses.replace(read(name), camera=cameras[name]))
    seen = []

    def fit_motion(deformation, observed, *_):
        seen.append(observed)
        return motion_fit.MotionFit(observed.points, 0)

    monkeypatch.setattr(initialize, "fit_motion", fit_motion)
    schedule = dataclasses.replace(CONFIG.schedule, fit_motion=5)
    start = dynamic_start(capture, ALIGNMENT, dataclasses.replace(CONFIG, schedule=schedule))
    assert start.lacks_fit
    assert seen[0].times.tolist() == [0.25, 0.5]
    first, second = seen[0].points.views.bincount().tolist()
    assert second == 2 * first > 0
