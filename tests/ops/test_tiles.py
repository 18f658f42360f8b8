"""Tile binning: the list of every tile has the Gaussians that reach into it, front to back."""

import pytest
import torch

from tests.ops.alone import composite, pack, project
from tests.reference.projection import Projection
from tests.reference.tiles import ALPHA_MIN, max_alphas
from tests.scenes import HEIGHT, WIDTH, generator, make_camera, make_splats
from warpgs.kernels import tiles as kernels
from warpgs.kernels.sort import MAX_PAIRS
from warpgs.ops import tiles
from warpgs.ops.projection import Geometry, View
from warpgs.rendering import render

NUM = 120


def projected(width=WIDTH, height=HEIGHT, num=NUM) -> Projection:
    camera, splats = make_camera(width, height), make_splats(num)
    geometry = Geometry(splats.means, splats.quats, splats.scales, splats.opacities)
    return project(geometry, View(camera.viewmat, camera.K, *camera.size))


def binned(splats: Projection, width=WIDTH, height=HEIGHT, max_intersections=None) -> tuple[list[list[int]], int]:
    """The list of each tile, and the number of intersections."""
    packed = pack(splats, torch.rand(len(splats.depths), 3, device=splats.depths.device), with_depth=False)
    result = tiles.bin_splats(*packed, (width, height), max_intersections=max_intersections)
    isects = result.gaussian_from_isect.tolist()
    return [isects[begin:end] for begin, end in result.ranges.tolist()], int(result.num_isects)


@pytest.mark.parametrize("size", [(WIDTH, HEIGHT), (16, 16), (1, 1), (130, 7)])
def test_every_gaussian_visible_in_a_tile_is_in_its_list(size):
    splats = projected()
    splats = splats._replace(means2d=splats.means2d * torch.tensor(size) / torch.tensor([WIDTH, HEIGHT]))
    lists, _ = binned(splats, *size)
    visible = max_alphas(splats, size, step=1.0) >= ALPHA_MIN
    assert visible.any()
    for tile, listed in enumerate(lists):
        assert set(visible[:, tile].nonzero()[:, 0].tolist()) <= set(listed)


def test_a_listed_gaussian_reaches_into_its_tile():
    splats = projected(64, 48)
    lists, _ = binned(splats, 64, 48)
    alphas = max_alphas(splats, (64, 48), step=0.125)
    for tile, listed in enumerate(lists):
        assert (alphas[listed, tile] >= 0.8 * ALPHA_MIN).all()


def test_few_listed_gaussians_are_invisible():
    splats = projected()
    lists, _ = binned(splats)
    visible = (max_alphas(splats, (WIDTH, HEIGHT), step=1.0) >= ALPHA_MIN).sum().item()
    listed = sum(map(len, lists))
    assert visible <= listed <= 1.05 * visible


def test_lists_are_in_order_of_depth_and_without_repeats():
    splats = projected()
    lists, _ = binned(splats)
    for listed in lists:
        depths = splats.depths[listed]
        assert torch.equal(depths, depths.sort().values)
        assert len(set(listed)) == len(listed)


def test_equal_depths_keep_the_order_of_the_input():
    splats = projected()
    lists, _ = binned(splats._replace(depths=torch.ones(NUM)))
    assert any(len(listed) > 5 for listed in lists)
    for listed in lists:
        assert listed == sorted(listed)


@pytest.mark.parametrize("max_intersections", [None, 10_000])
def test_the_number_of_intersections_is_the_length_of_all_lists(max_intersections):
    lists, number = binned(projected(), max_intersections=max_intersections)
    assert sum(map(len, lists)) == number
    assert lists == binned(projected())[0]


def test_culled_gaussians_are_in_no_list():
    splats = projected()
    gone = torch.arange(NUM) % 3 == 0
    lists, _ = binned(splats._replace(radii=torch.where(gone[:, None], 0, splats.radii)))
    assert not any(gone[listed].any() for listed in lists)
    remaining = [[g for g in listed if not gone[g]] for listed in binned(splats)[0]]
    assert lists == remaining


def test_a_gaussian_in_a_corner_leaves_the_other_tiles_empty():
    splats = projected()
    corner = splats._replace(
        means2d=torch.full((NUM, 2), 4.0),
        conics=torch.tensor([[1.0, 0.0, 1.0]]).repeat(NUM, 1),
        depths=torch.ones(NUM),
        radii=torch.full((NUM, 2), 4, dtype=torch.int32),
        opacities=torch.full((NUM,), 0.9),
    )
    lists, _ = binned(corner)
    assert [len(listed) for listed in lists] == [NUM] + [0] * 11


def test_without_gaussians_or_if_all_are_culled_lists_are_empty():
    splats = projected()
    for none in (Projection(*(t[:0] for t in splats)), splats._replace(radii=torch.zeros_like(splats.radii))):
        assert binned(none) == ([[]] * 12, 0)


def images_and_gradients(is_dynamic):
    splats = projected()
    leaves = [t.clone().requires_grad_() for t in splats[:4]]
    colors = torch.rand(NUM, 3, generator=torch.Generator().manual_seed(5)).requires_grad_()
    images = composite(Projection(*leaves, splats.radii), colors, (WIDTH, HEIGHT), is_dynamic=is_dynamic).images
    sum(image.square().sum() for image in images).backward()
    return [*(image.detach() for image in images), *(t.grad for t in (leaves[0], leaves[1], leaves[3], colors))]


@pytest.mark.parametrize("is_dynamic", [None, torch.arange(NUM) % 3 == 0])
def test_more_intersections_than_expected_give_the_same_image(is_dynamic, monkeypatch):
    expected = images_and_gradients(is_dynamic)
    capacity = tiles._capacity
    monkeypatch.setattr(tiles, "_capacity", lambda order, size, _, count: capacity(order, size, 1, count))
    actual = images_and_gradients(is_dynamic)
    for a, e in zip(actual, expected, strict=True):
        assert torch.equal(a, e)


def test_with_too_many_intersections_every_tile_lists_all_gaussians_in_depth_order():
    splats = projected()
    lists, number = binned(splats, max_intersections=1)
    assert number == binned(splats)[1] > NUM
    keys = torch.where(splats.radii[:, 0] > 0, splats.depths, torch.inf)
    assert lists == [keys.argsort(stable=True).tolist()] * 12


def test_the_next_budget_covers_the_number_of_intersections_and_little_more():
    budget = tiles._Budget()
    assert budget.recent_max is None
    for number in (0, 5_000, 123_457, 40):
        budget.num_isects.fill_(number)
        capacity = budget.capacity(3_000)
        wanted = max(number * tiles.HEADROOM, 3_000)
        assert capacity >= wanted
        assert number == 40 or capacity <= 1.13 * wanted


def test_a_budget_learned_in_inference_mode_works_outside_of_it():
    tiles.reset_budgets()
    splats = make_splats()
    with torch.inference_mode():
        inside = render(splats, make_camera()).joint.image
    assert torch.equal(render(splats, make_camera()).joint.image, inside)


def test_removing_gaussians_only_removes_them_from_the_lists():
    splats = projected()
    few = torch.arange(NUM) % 10 == 0
    names = few.nonzero()[:, 0].tolist()
    lists, _ = binned(Projection(*(t[few].contiguous() for t in splats)))
    assert [[names[g] for g in listed] for listed in lists] == [
        [g for g in listed if few[g]] for listed in binned(splats)[0]
    ]


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.5, 1.0])
def test_the_lists_of_tiles_are_split_by_branch_in_order(fraction):
    splats = projected()
    is_dynamic = torch.rand(NUM, generator=generator()) < fraction
    packed = pack(splats, torch.rand(NUM, 3), with_depth=False)
    result = tiles.bin_splats(*packed, (WIDTH, HEIGHT), is_dynamic.view(torch.uint8))
    joint, _ = binned(splats)
    assert len(joint) == len(result.ranges)
    for listed, (begin, end), (num_static, num_dynamic) in zip(
        joint, result.ranges.tolist(), result.branch_lengths.tolist(), strict=True
    ):
        listed = torch.tensor(listed, dtype=torch.int32)
        dynamic = is_dynamic[listed.long()]
        assert torch.equal(result.gaussian_from_isect[begin:end], listed + dynamic * kernels.DYNAMIC)
        both = result.gaussian_from_isect[result.half + begin : result.half + end]
        assert torch.equal(both[:num_static], listed[~dynamic])
        assert torch.equal(both.flip(0)[:num_dynamic], listed[dynamic])


def test_learned_buffers_are_no_larger_than_what_can_be_sorted():
    budget = tiles._Budget()
    budget._number[0] = MAX_PAIRS
    assert budget.capacity(1) == MAX_PAIRS - 1
