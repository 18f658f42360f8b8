"""Dynamic objects are followed from frame to frame, and their size gives their depth."""

import dataclasses
import math
import threading
import tracemalloc
import weakref
from collections import Counter
from collections.abc import Callable

import cv2
import numpy as np
import pytest
import torch

from tests import plain, tiny
from tests.scenes import along_z
from warpgs.captures.opening import load_capture
from warpgs.data import dynamic_regions
from warpgs.data.capture import Capture, Frame
from warpgs.data.dynamic_regions import unknown_depth
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.initialization import object_depth as module
from warpgs.initialization import objects, seen_objects
from warpgs.initialization.averaged_depth import without_rims
from warpgs.initialization.depth_by_size import depth_by_size
from warpgs.initialization.dynamic_points import NUM_CHECKED
from warpgs.initialization.initialize import MAX_COLOR_VIEWS
from warpgs.initialization.object_depth import SIZE_ERROR, ObjectDepth, fill_object_depth
from warpgs.initialization.objects import MIN_VISIBLE, find_objects
from warpgs.initialization.prepare_start import prepare_start
from warpgs.initialization.seen_objects import ObjectView, see_objects
from warpgs.runtime import launch
from warpgs.training.trainer import Trainer
from warpgs.views.view_reader import ViewReader
from warpgs.views.views import Views

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
NUM = 30
WALL = 2.0
"""Depth of a wall of static points behind everything."""

CONFIG = dataclasses.replace(tiny.CONFIG, loss=plain.loss(object_depth=True))


def ellipse(column: float, row: float, axes: tuple[float, float], angle: float = 0.0) -> np.ndarray:
    """[H, W] true inside an ellipse with these semi-axes [px]."""
    image = np.zeros((HEIGHT, WIDTH), np.uint8)
    shift = 3
    center, half = (tuple(round(v * 2**shift) for v in values) for values in ((column, row), axes))
    cv2.ellipse(image, center, half, angle, 0, 360, 1, -1, cv2.LINE_8, shift)
    return image > 0


def ball(depth: float, x: float = 0.0, radius: float = 0.2) -> np.ndarray:
    """[H, W] true where a ball at a depth is seen, before the middle of the image."""
    size = FOCAL * radius / depth
    return ellipse(WIDTH / 2 + FOCAL * x / depth, HEIGHT / 2, (size, size))


def wall(depth: float = WALL) -> torch.Tensor:
    """[P, 3] points on a plane across the whole image."""
    x, y = torch.meshgrid(torch.linspace(-0.53, 0.53, 80), torch.linspace(-0.4, 0.4, 60), indexing="xy")
    return torch.stack([x, y, torch.ones_like(x)], -1).view(-1, 3) * depth


def capture_of(masks, points=None, images=None, **frames) -> Capture:
    """A capture of a camera that moves sideways, with dynamic masks [T, H, W]."""
    last, size = max(1, len(masks) - 1), (WIDTH, HEIGHT)
    cameras = {f"{k:03d}": along_z(FOCAL, size, (-1e-3 * k, 0.0, 0.0), k / last) for k in range(len(masks))}

    def read(name: str) -> Frame:
        k = int(name)
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8) if images is None else images[k]
        static = torch.from_numpy(~masks[k])
        return Frame(name, cameras[name], torch.from_numpy(image), static, **{n: f(static) for n, f in frames.items()})

    points = wall() if points is None else points
    return Capture("objects", cameras, list(cameras), [], points, None, read)


def changed(capture: Capture, change: Callable[[Frame], Frame]) -> Capture:
    """The capture with changed frames."""
    read = capture._cached
    capture._cached = lambda name: change(read(name))
    return capture


def views_of(capture: Capture, resident_bytes: int = 1 << 30) -> Views:
    return Views(capture, torch.device("cpu"), resident_bytes)


def object_depth(capture: Capture) -> dict[int, torch.Tensor]:
    views = views_of(capture)
    return depth_by_size(capture, views, module.find_all_objects(views))


def depths_at(capture: Capture, masks) -> np.ndarray:
    """[T] mean depth of what the masks show; NaN where there is none."""
    found = object_depth(capture)
    means = []
    for k, mask in enumerate(masks):
        means.append(found[k].numpy()[mask].mean() if k in found else np.nan)
    return np.array(means)


def test_an_object_that_keeps_its_size_is_as_far_away_as_it_looks_small():
    true = np.linspace(1.0, 1.5, NUM)
    masks = [ball(depth) for depth in true]
    found = depths_at(capture_of(masks), masks)
    assert found / found[0] == pytest.approx(true / true[0], rel=0.03)


def test_an_object_is_as_far_away_as_the_static_points_around_it_allow():
    """It comes back to the wall, and never goes through it."""
    true = WALL - 0.8 * np.sin(np.linspace(0.0, math.pi, NUM))
    masks = [ball(depth, radius=0.3) for depth in true]
    assert depths_at(capture_of(masks), masks) == pytest.approx(true, rel=0.04)


def test_an_object_is_round():
    masks = [ball(WALL, radius=0.3)] * NUM
    depth = object_depth(capture_of(masks))[0].numpy()
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    squared = (WALL / FOCAL) ** 2 * ((row + 0.5 - HEIGHT / 2) ** 2 + (column + 0.5 - WIDTH / 2) ** 2)
    inside = masks[0] & (squared < 0.27**2)
    expected = -np.sqrt(0.3**2 - squared[inside])
    found = depth[inside]
    assert found - found.mean() == pytest.approx(expected - expected.mean(), abs=0.03)
    assert np.isnan(depth[~masks[0]]).all()


def test_points_on_the_object_itself_do_not_bound_its_depth():
    masks = [ball(1.0) for _ in range(NUM)]
    on_it = torch.tensor([[0.0, 0.0, 0.5]]).repeat(50, 1)
    found = depths_at(capture_of(masks, torch.cat([wall(), on_it])), masks)
    assert found == pytest.approx(np.full(NUM, WALL), rel=0.01)


def test_the_diameter_measures_a_ring_that_tumbles():
    angles = np.linspace(0.0, 3.0 * math.pi, NUM)
    masks = [ellipse(80, 60, (30.0, 6.0 + 24.0 * abs(math.cos(a))), 10.0) for a in angles]
    found = depths_at(capture_of(masks), masks)
    assert np.ptp(found) < 0.05 * found.mean()


def test_the_area_measures_a_body_that_deforms():
    stretch = 1.3 ** np.sin(np.linspace(0.0, 3.0 * math.pi, NUM))
    masks = [ellipse(80, 60, (20.0 * s, 20.0 / s)) for s in stretch]
    found = depths_at(capture_of(masks), masks)
    assert np.ptp(found) < 0.05 * found.mean()


@pytest.mark.parametrize(
    ("masks", "points"),
    [
        ([ball(1.0)] * 11, None),
        ([ball(1.0)] * NUM, torch.zeros(0, 3)),
        ([ellipse(80, 0, (20.0, 20.0))] * NUM, None),
        ([ellipse(80, 60, (2.0, 2.0))] * NUM, None),
        ([np.zeros((HEIGHT, WIDTH), bool)] * NUM, None),
        ([np.ones((HEIGHT, WIDTH), bool)] * NUM, None),
        ([ball(1.0)], None),
    ],
    ids=["few frames", "no points", "cut off", "tiny", "nothing moves", "everything moves", "one frame"],
)
def test_there_is_no_depth_where_nothing_tells_it(masks, points):
    assert object_depth(capture_of(masks, points)) == {}


def two_walls(left: float, right: float) -> torch.Tensor:
    """Points on a plane across the left half of the image, and on another one across the right half."""
    points = wall(1.0)
    return points * torch.where(points[:, :1] < 0.0, left, right)


BESIDE = ellipse(40, 25, (15.0, 15.0))
"""A ball that is whole."""


def test_an_object_that_the_border_cuts_off_is_as_far_away_as_the_points_around_it():
    cut = ellipse(120, 119, (20.0, 30.0))
    found = object_depth(capture_of([BESIDE | cut] * NUM, two_walls(2.0, 1.5)))
    assert sorted(found) == list(range(NUM))
    for depth in found.values():
        assert depth.numpy()[cut] == pytest.approx(np.full(cut.sum(), 1.5), rel=1e-3)
        assert depth.numpy()[BESIDE] == pytest.approx(np.full(BESIDE.sum(), 2.0), rel=0.1)


def test_the_depth_around_an_object_is_smoothed_over_time():
    cut = [ellipse(20 + 4 * k, 119, (10.0, 30.0)) for k in range(NUM)]
    found = object_depth(capture_of([BESIDE | mask for mask in cut], two_walls(2.0, 1.5)))
    depths = np.array([found[k].numpy()[mask & ~BESIDE].mean() for k, mask in enumerate(cut)])
    assert depths[[0, -1]] == pytest.approx([2.0, 1.5], rel=0.01)
    assert 0.02 < -np.diff(depths).min() < 0.2  # without smoothing, it is 0.5


def test_the_depth_around_an_object_is_that_of_the_frames_nearby_where_it_is_unknown():
    """Nothing is seen around it in the first frames, which show it at the left border."""
    cut = [ellipse(4 * k, 119, (10.0, 30.0)) for k in range(NUM)]
    points = two_walls(2.0, 1.5)
    points = points[points[:, 0] / points[:, 2] > -0.4]
    found = object_depth(capture_of([BESIDE | mask for mask in cut], points))
    assert found[0].numpy()[cut[0]] == pytest.approx(np.full(cut[0].sum(), 2.0), rel=0.01)


@pytest.mark.parametrize("shown", [11, 12])
def test_an_object_that_few_frames_show_has_no_depth(shown):
    cut, beside = ellipse(120, 119, (20.0, 30.0)), [BESIDE] * NUM
    masks = [mask | cut if k < shown else mask for k, mask in enumerate(beside)]
    found = object_depth(capture_of(masks))
    assert np.isfinite(found[0].numpy()[cut]).all() == (shown == 12)


def test_depth_by_size_is_used_where_an_object_is_known_both_whole_and_cut_off(monkeypatch):
    """As one that is told apart from others in one order of time only."""
    mask = ball(1.0)
    pixels = dict.fromkeys(range(NUM), np.flatnonzero(mask).astype(np.int32))
    items = [objects.MovingObject(pixels, whole) for whole in ([], list(range(NUM)))]
    monkeypatch.setattr(module, "find_all_objects", lambda views: items)
    assert np.ptp(object_depth(capture_of([mask] * NUM))[0].numpy()[mask]) > 0.05  # round, not flat


def test_an_object_is_cut_off_in_the_frames_that_show_it_at_the_border():
    masks = [ellipse(4 * k, 60, (18.0, 18.0)) for k in range(NUM)]
    (item,) = find_objects(views_of(capture_of(masks)), range(NUM))
    assert item.cut == [k for k, mask in enumerate(masks) if mask[:, 0].any() or mask[:, -1].any()]
    assert sorted([*item.cut, *item.whole]) == list(range(NUM))
    assert 0 < len(item.cut) < NUM


# Several objects ------------------------------------------------------------------------------------------------------


def textured(seed: int) -> np.ndarray:
    """[H, W, 3] smooth noise, which optical flow can follow."""
    noise = np.random.default_rng(seed).random((HEIGHT // 4, WIDTH // 4, 3)).astype(np.float32)
    return (255 * cv2.resize(noise, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC).clip(0, 1)).astype(np.uint8)


def two_balls(offsets: np.ndarray, radius: float = 18.0):
    """Masks and images of a ball in the middle and one that passes behind it at these columns [px]."""
    still, ground = textured(1), textured(2)
    masks, images = [], []
    front = ellipse(80, 60, (radius, radius))
    for offset in offsets:
        behind = ellipse(80 + offset, 60, (radius, radius))
        moved = cv2.warpAffine(textured(3), np.float32([[1, 0, offset], [0, 1, 0]]), (WIDTH, HEIGHT))
        images.append(np.where(front[..., None], still, np.where(behind[..., None], moved, ground)))
        masks.append(front | behind)
    return masks, images


def test_objects_that_touch_are_told_apart_by_optical_flow():
    offsets = np.concatenate([np.linspace(-50, -30, 15), np.linspace(-30, -50, 15)])
    masks, images = two_balls(offsets)
    objects = find_objects(views_of(capture_of(masks, images=images)), range(NUM))
    assert len(objects) == 2
    joined = [k for k in range(NUM) if k not in objects[0].whole]
    assert joined
    for item in objects:
        assert sorted(item.pixels) == list(range(NUM))
        assert not item.is_mixture
    for k in joined:
        front = ellipse(80, 60, (18.0, 18.0))
        column = np.unravel_index(objects[0].pixels[k], front.shape)[1].mean()
        item = objects[1] if abs(column - 80) > 8 else objects[0]
        shown = np.zeros(front.shape, bool)
        shown.flat[item.pixels[k]] = True
        assert (shown & front).sum() > 0.9 * (shown | front).sum()


def test_what_is_hidden_by_half_is_not_followed():
    masks, images = two_balls(np.linspace(-50, 0, NUM))
    objects = find_objects(views_of(capture_of(masks, images=images)), range(NUM))
    both = objects[2]
    assert [item.is_mixture for item in objects] == [False, False, True]
    assert max(objects[0].pixels) == max(objects[1].pixels) == min(both.pixels) - 1
    assert all(len(item.pixels[max(item.pixels)]) >= MIN_VISIBLE * len(item.pixels[0]) for item in objects[:2])


def test_an_object_is_followed_through_the_frames_of_one_camera():
    masks = np.array([ball(1.0, x=0.05 * (k % 2)) for k in range(NUM)])
    capture = capture_of(masks)
    cameras = {name: dataclasses.replace(c, id=k % 2) for k, (name, c) in enumerate(capture.cameras.items())}
    objects = module.find_all_objects(views_of(capture.with_cameras(cameras)))
    assert [sorted({k % 2 for k in item.pixels}) for item in objects] == [[0], [0], [1], [1]]
    assert all(len(item.whole) == NUM // 2 for item in objects)


def test_cameras_are_followed_on_all_cores_with_the_results_of_one(monkeypatch):
    """These are all threads: frames, which several threads read, were read before."""
    masks, images = two_balls(np.linspace(-60, -33, NUM))
    capture = capture_of(masks, images=images)
    cameras = {name: dataclasses.replace(c, id=k % 3) for k, (name, c) in enumerate(capture.cameras.items())}
    views, threads = views_of(capture.with_cameras(cameras), resident_bytes=0), set()
    expected = [item for video in views.videos for order in (video, video[::-1]) for item in find_objects(views, order)]

    together = threading.Barrier(2)

    def find(views, order):
        if threading.get_ident() not in threads:
            threads.add(threading.get_ident())
            together.wait(timeout=60)  # for the other core
        return find_objects(views, order)

    monkeypatch.setattr(objects, "find_objects", find)
    monkeypatch.setattr(launch, "_num_cores", lambda: 2)
    monkeypatch.setattr(views, "in_threads", lambda *_: pytest.fail("threads within threads"))
    found = module.find_all_objects(views)
    assert len(found) == len(expected) > 3
    for item, other in zip(found, expected, strict=True):
        assert (item.whole, item.cut, item.is_mixture) == (other.whole, other.cut, other.is_mixture)
        assert item.pixels.keys() == other.pixels.keys()
        assert all(np.array_equal(item.pixels[k], other.pixels[k]) for k in item.pixels)
    assert len(threads) == 2


def test_objects_that_part_are_told_apart_backward_in_time():
    masks, images = two_balls(np.concatenate([np.full(5, -33.0), np.linspace(-33, -60, NUM - 5)]))
    views = views_of(capture_of(masks, images=images))
    assert len(find_objects(views, range(NUM))) == 3
    objects = find_objects(views, range(NUM)[::-1])
    assert len(objects) == 2
    assert all(sorted(item.pixels) == list(range(NUM)) for item in objects)


# In training ----------------------------------------------------------------------------------------------------------


def no_alignments() -> torch.Tensor:
    return torch.full((NUM, 2), torch.nan)


DEPTHS = np.linspace(1.0, 1.5, NUM)
MASKS = [ball(depth) for depth in DEPTHS]


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_views_without_depth_get_that_of_objects(resident_bytes):
    capture, alignments = capture_of(MASKS), no_alignments()
    views = views_of(capture, resident_bytes)
    assert fill_object_depth(CONFIG, capture, views, alignments, 0.0).num_views == NUM
    assert alignments.tolist() == [[1.0, 0.0]] * NUM
    expected = object_depth(capture)
    for k in range(NUM):
        assert torch.equal(views[k].inverse_depth.isfinite(), ~views[k].static_mask)
        assert torch.allclose(views[k].inverse_depth[~views[k].static_mask], 1.0 / expected[k][MASKS[k]], rtol=1e-3)


def test_static_depth_stays_and_objects_follow_its_alignment():
    capture = capture_of(MASKS, inverse_depth=lambda static: torch.where(static, 3.0, torch.nan))
    views, alignments = views_of(capture), torch.tensor([[0.5, -1.0]]).repeat(NUM, 1)
    assert fill_object_depth(CONFIG, capture, views, alignments, 0.0).num_views == NUM
    assert alignments.tolist() == [[0.5, -1.0]] * NUM
    expected = object_depth(capture)
    for k in range(NUM):
        view = views[k]
        assert (view.inverse_depth[view.static_mask] == 3.0).all()
        aligned = 0.5 * view.inverse_depth[~view.static_mask] - 1.0
        assert torch.allclose(aligned, 1.0 / expected[k][MASKS[k]], rtol=3e-3)


def test_depth_that_cannot_be_aligned_is_not_mixed_with_that_of_objects():
    capture = capture_of(MASKS, inverse_depth=lambda static: torch.where(static, 3.0, torch.nan))
    assert fill_object_depth(CONFIG, capture, views_of(capture), no_alignments(), 0.0).num_views == 0


NOT_ASKED_FOR = pytest.mark.parametrize(
    ("config", "change"),
    [
        (tiny.CONFIG, lambda capture: capture),
        (dataclasses.replace(CONFIG, depth=False), lambda capture: capture),
        (CONFIG, lambda capture: capture.assuming("dynamic")),
        (CONFIG, lambda capture: capture.assuming("static")),
    ],
    ids=["off", "no depth", "all dynamic", "all static"],
)


@NOT_ASKED_FOR
def test_objects_get_no_depth_where_it_is_not_asked_for(config, change):
    capture = change(capture_of(MASKS))
    assert fill_object_depth(config, capture, views_of(capture), no_alignments(), 0.0).num_views == 0


def test_frames_whose_depth_is_entirely_unknown_get_that_of_objects():
    capture = capture_of(MASKS, inverse_depth=lambda static: torch.full(static.shape, torch.nan))
    views, alignments = views_of(capture), no_alignments()
    assert fill_object_depth(CONFIG, capture, views, alignments, 0.0).num_views == NUM
    assert alignments.tolist() == [[1.0, 0.0]] * NUM


def test_known_depth_of_what_moves_is_kept():
    capture = capture_of(MASKS, inverse_depth=lambda static: torch.ones(static.shape))
    views, alignments = views_of(capture), torch.tensor([[1.0, 0.0]]).repeat(NUM, 1)
    assert fill_object_depth(CONFIG, capture, views, alignments, 0.0).num_views == 0
    assert (views[0].inverse_depth == 1.0).all()


SHIFTS = 1.0 + 0.1 * np.sin(np.linspace(0.0, 2.0 * math.pi, NUM))
"""Factors by which a depth network misplaces an object, slowly changing."""


def misplaced(masks, shifts=SHIFTS) -> Capture:
    """A ball before a wall whose depth is known and off by these factors."""

    def with_depth(frame: Frame) -> Frame:
        k = int(frame.name)
        depth = torch.where(torch.from_numpy(masks[k]), DEPTHS[k] * shifts[k], WALL)
        return dataclasses.replace(frame, inverse_depth=1.0 / depth.float())

    return changed(capture_of(masks), with_depth)


def filled(capture: Capture, error: float, resident_bytes: int = 1 << 30) -> tuple[int, np.ndarray, Views]:
    """The number of views changed, the depth of what moves in each view, and the views."""
    views, alignments = views_of(capture, resident_bytes), torch.tensor([[1.0, 0.0]]).repeat(NUM, 1)
    count = fill_object_depth(CONFIG, capture, views, alignments, error).num_views
    return count, np.array([float((1.0 / v.inverse_depth[~v.static_mask]).mean()) for v in views]), views


@pytest.mark.parametrize("error", [0.05, 0.15])
def test_uncertain_depth_of_an_object_is_averaged_with_that_by_its_size(error):
    """The factor of depth by size is the mean of the median of depth times size and of the bound, which is the wall."""
    count, found, views = filled(misplaced(MASKS), error)
    by_size = math.sqrt(WALL / DEPTHS[-1]) * DEPTHS
    weight = 1.0 / (1.0 + (error / SIZE_ERROR) ** 2)
    assert count == NUM
    assert found == pytest.approx((DEPTHS * SHIFTS) ** weight * by_size ** (1.0 - weight), rel=0.03)
    assert all(torch.allclose(v.inverse_depth[v.static_mask], torch.tensor(1.0 / WALL), rtol=1e-3) for v in views)


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_objects_are_moved_by_threads(monkeypatch, resident_bytes):
    threads, set_factor = set(), Views.set_depth_factor
    seen = lambda *sources: threads.add(threading.get_ident()) or set_factor(*sources)  # noqa: E731
    monkeypatch.setattr(Views, "set_depth_factor", seen)
    _, found, _ = filled(misplaced(MASKS), 0.05, resident_bytes)
    assert threads
    assert threading.get_ident() not in threads
    assert found == pytest.approx(filled(misplaced(MASKS), 0.05)[1], rel=1e-6)


def rim_of(static_mask: torch.Tensor, width: int) -> torch.Tensor:
    """Dynamic pixels at most ``width`` pixels from static ones."""
    near = torch.nn.functional.max_pool2d(static_mask[None, None].float(), 2 * width + 1, 1, width)[0, 0]
    return (near > 0) & ~static_mask


@pytest.fixture
def blurred(monkeypatch) -> Capture:
    """A capture whose depth is half way to the wall in a rim of one pixel, as depth networks blur edges."""
    monkeypatch.setattr("warpgs.initialization.averaged_depth.RIM", 2.5 / WIDTH)

    def with_rims(frame: Frame) -> Frame:
        half_way = 0.5 * (frame.inverse_depth + 1.0 / WALL)
        depth = torch.where(rim_of(frame.static_mask, 1), half_way, frame.inverse_depth)
        return dataclasses.replace(frame, inverse_depth=depth)

    return changed(misplaced(MASKS), with_rims)


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_rims_of_objects_have_the_depth_further_inside(blurred, resident_bytes):
    count, _, views = filled(blurred, 0.05, resident_bytes)
    assert count == NUM
    for view in views:
        depths = 1.0 / view.inverse_depth[~view.static_mask]
        assert depths.max() < 1.01 * depths.min()
        assert torch.allclose(view.inverse_depth[view.static_mask], torch.tensor(1.0 / WALL), rtol=1e-3)


def make_plane(is_portrait: bool = False) -> tuple[torch.Tensor, torch.Tensor]:
    """Random inverse depth and an all static mask, 300 pixels long: rims are 2.4 pixels wide."""
    shape = (300, 200) if is_portrait else (200, 300)
    return torch.rand(shape), torch.ones(shape, dtype=torch.bool)


@pytest.mark.parametrize("is_portrait", [False, True])
def test_rims_of_dynamic_pixels_at_the_border_of_the_image_are_not_edges(is_portrait):
    depth, static = make_plane(is_portrait)
    static[:, :100] = False
    filled = without_rims(depth, static)
    assert torch.equal(filled[:, :98], depth[:, :98])
    assert torch.equal(filled[:, 98:100], depth[:, 97:98].expand(-1, 2))
    assert torch.equal(filled[:, 100:], depth[:, 100:])


def test_thin_objects_and_thin_parts_keep_their_depth():
    depth, static = make_plane()
    static[50:150, 50:150] = False
    static[20:24, 50:150] = False  # an object as thin as two rims
    static[98:102, 150:200] = False  # a thin part of the other one
    filled = without_rims(depth, static)
    assert torch.equal(filled[:50], depth[:50])
    assert torch.equal(filled[:, 156:], depth[:, 156:])  # nearer than 4.8 pixels, it is the rim
    assert not torch.equal(filled[98:102, 140:156], depth[98:102, 140:156])
    assert not torch.equal(filled[50:52], depth[50:52])


def test_objects_side_by_side_keep_to_themselves():
    depth, static = make_plane()
    static[50:150, 50:150] = False
    static[50:150, 151:154] = False  # thin, a pixel away
    filled = without_rims(depth, static)
    assert torch.equal(filled[:, 150:], depth[:, 150:])
    assert not torch.equal(filled, depth)


@pytest.mark.parametrize("masks", ["all static", "thin"])
def test_depth_without_an_inside_stays(masks):
    depth, static = make_plane()
    if masks == "thin":
        static[90:94] = False
    assert torch.equal(without_rims(depth, static), depth)


def test_rims_are_not_filled_with_unknown_depth():
    depth, static = make_plane()
    static[50:150, 50:150] = False
    depth[52:148, 52:148] = torch.nan  # the whole inside of one object
    static[50:150, 200:290] = False
    filled = without_rims(depth, static)
    assert torch.equal(filled[:, :180].nan_to_num(2.0), depth[:, :180].nan_to_num(2.0))
    assert not torch.equal(filled[:, 180:], depth[:, 180:])


def test_metric_depth_of_objects_is_kept():
    capture = misplaced(MASKS)
    capture.metric_depth = True
    count, found, _ = filled(capture, 0.15)
    assert count == 0
    assert found == pytest.approx(DEPTHS * SHIFTS, rel=2e-3)


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_static_pixels_keep_their_depth_where_objects_are_found_in_smaller_masks(monkeypatch, resident_bytes):
    monkeypatch.setattr(dynamic_regions, "MAX_SIDE", 40)
    count, _, views = filled(misplaced(MASKS), 0.15, resident_bytes)
    assert count == NUM
    for view in views:
        assert torch.allclose(view.inverse_depth[view.static_mask], torch.tensor(1.0 / WALL), rtol=1e-3)


def test_views_that_are_not_aligned_keep_their_depth(blurred):
    alignments = torch.tensor([[1.0, 0.0]]).repeat(NUM, 1)
    alignments[1] = torch.nan
    views = views_of(blurred)
    assert fill_object_depth(CONFIG, blurred, views, alignments, 0.05).num_views == NUM - 1
    assert torch.allclose(views[1].inverse_depth, blurred.frame("001").inverse_depth, rtol=1e-3)


@pytest.mark.parametrize(("error", "count"), [(0.015, 0), (0.017, NUM)])
def test_depth_that_agrees_with_the_points_is_kept(blurred, error, count):
    num, _, views = filled(blurred, error)
    assert num == count
    is_same = [
        torch.allclose(v.inverse_depth, blurred.frame(f"{k:03d}").inverse_depth, rtol=1e-3) for k, v in enumerate(views)
    ]
    assert all(is_same) if count == 0 else not any(is_same)


def test_frames_that_cut_an_object_off_are_corrected_as_their_neighbours():
    masks = [ball(depth, x=k / NUM * depth * WIDTH / 2 / FOCAL) for k, depth in enumerate(DEPTHS)]
    is_cut = np.array([mask[:, -1].any() for mask in masks])
    assert 0 < is_cut.sum() < 10
    _, found, _ = filled(misplaced(masks), 0.15)
    corrections = found / (DEPTHS * SHIFTS)
    last = corrections[~is_cut][-1]
    assert abs(last - 1.0) > 0.02
    assert corrections[is_cut] == pytest.approx(np.full(is_cut.sum(), last), rel=0.01)


def test_objects_whose_size_is_unknown_keep_their_depth():
    masks = [ball(depth) if k < 11 else np.zeros((HEIGHT, WIDTH), bool) for k, depth in enumerate(DEPTHS)]
    count, found, _ = filled(misplaced(masks), 0.15)
    assert count == 0
    assert found[:11] == pytest.approx((DEPTHS * SHIFTS)[:11], rel=2e-3)


def test_objects_that_few_frames_show_apart_from_others_keep_their_depth(monkeypatch):
    both = (MASKS, [BESIDE] * NUM)
    pixels = [{k: np.flatnonzero(mask).astype(np.int32) for k, mask in enumerate(masks)} for masks in both]
    items = [objects.MovingObject(pixels[0], list(range(11))), objects.MovingObject(pixels[1], list(range(NUM)))]
    monkeypatch.setattr(module, "find_all_objects", lambda views: items)
    count, _, views = filled(misplaced([mask | BESIDE for mask in MASKS]), 0.15)
    assert count == NUM
    found = [float((1.0 / view.inverse_depth[mask]).mean()) for view, mask in zip(views, MASKS, strict=True)]
    assert found == pytest.approx(DEPTHS * SHIFTS, rel=2e-3)


def test_training_uses_the_depth_of_objects_without_pretraining(tmp_path):
    capture = capture_of(MASKS)
    start = prepare_start(CONFIG, capture)
    assert (start.num_aligned, start.num_with_objects) == (0, NUM)
    trainer = Trainer(start, tmp_path)
    assert trainer.protocol.pretrain.end == 0
    assert trainer.protocol.at(0).depth_weight > 0
    trainer._add_dynamic_gaussians()
    z = trainer.scene.dynamic.means[:, 2]
    true = torch.cat([image[image.isfinite()] for image in object_depth(capture).values()])
    assert true.min() - 1e-3 <= z.min()
    assert z.max() <= true.max() + 1e-3


def test_what_comes_before_training_reads_each_view_once(monkeypatch):
    """And a few of them again, which tell whether depth is known."""
    reads, read = Counter(), ViewReader._pixels

    def counted(reader, index, *arguments, **options):
        reads[index] += 1
        return read(reader, index, *arguments, **options)

    monkeypatch.setattr(ViewReader, "_pixels", counted)
    start = prepare_start(dataclasses.replace(CONFIG, resident_bytes=0), capture_of(MASKS))
    assert start.num_with_objects == NUM
    few = {*evenly_spaced_indices(NUM, NUM_CHECKED), *evenly_spaced_indices(NUM, MAX_COLOR_VIEWS)}
    assert {index: reads[index] for index in range(NUM) if index not in few} == {
        index: 1 for index in range(NUM) if index not in few
    }


def test_objects_are_followed_without_reading_views_again(monkeypatch):
    masks, images = two_balls(np.linspace(-60, -33, NUM))
    views = views_of(capture_of(masks, images=images), resident_bytes=0)
    assert views.glances
    monkeypatch.setattr(ViewReader, "_pixels", lambda *_, **__: pytest.fail("read again"))
    assert len(module.find_all_objects(views)) > 1


def test_objects_are_measured_in_threads():
    views, threads = views_of(capture_of(MASKS)), set()
    found = module.find_all_objects(views)
    measured = [*see_objects(views._capture, views, found, lambda seen: threads.add(threading.get_ident()) or seen)]
    assert [item for item, _ in measured] == found
    assert all(seen.item is item for item, seen in measured)
    assert threading.get_ident() not in threads


def test_objects_take_a_small_part_of_the_memory_of_their_pixels():
    """An object of a tenth of the pixels, in 6,000 frames and both orders of time, would have 0.7 GB of them."""
    views = views_of(capture_of([ball(1.0, radius=0.3)] * 100))
    assert views.glances
    find_objects(views, range(2))
    tracemalloc.start()
    try:
        found = find_objects(views, range(100))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 0.2 * sum(pixels.nbytes for item in found for pixels in item.pixels.values())


def test_an_object_is_measured_frame_by_frame(monkeypatch):
    """What is known of it in all frames of a long video would take gigabytes."""
    alive, most = weakref.WeakSet(), []

    class Counted(ObjectView):
        def __init__(self, *args):
            super().__init__(*args)
            alive.add(self)
            most.append(len(alive))

    monkeypatch.setattr(seen_objects, "ObjectView", Counted)
    assert object_depth(capture_of(MASKS))
    assert max(most) <= 2 * 3  # of both orders of time, in threads


def test_a_capture_with_depth_pretrains(tmp_path):
    data = tiny.write(tmp_path / "data")
    start = prepare_start(CONFIG, load_capture(data))
    assert start.num_with_objects == 0
    assert Trainer(start, tmp_path / "run").protocol.pretrain.end == tiny.SCHEDULE.pretrain


def test_training_says_that_size_gives_depth():
    lines = prepare_start(CONFIG, capture_of(MASKS)).notes
    assert f"the size of dynamic objects gives or corrects their depth in {NUM} of {NUM} views" in lines
    assert not any("training without depth" in line for line in lines)


# Where nothing tells the depth of objects -----------------------------------------------------------------------------


def with_cut_off(num_whole: int) -> list[np.ndarray]:
    """Masks of a ball that the lower border cuts off, in all frames but these."""
    return [ball(1.0) if k < num_whole else ellipse(80, 110, (30.0, 30.0)) for k in range(NUM)]


def warnings_before(capture: Capture) -> list[str]:
    """The warnings of a training before its first iteration."""
    return [line for line in prepare_start(CONFIG, capture).notes if line.startswith("warning:")]


@pytest.mark.parametrize(("num_whole", "warned"), [(0, True), (11, True), (12, False)])
def test_training_warns_if_the_border_cuts_the_only_object_off_in_too_many_frames(num_whole, warned):
    found = warnings_before(capture_of(with_cut_off(num_whole)))
    expected = f"warning: {unknown_depth(NUM - num_whole, NUM)}"
    assert found == ([expected] if warned else [])


def test_frames_in_which_the_border_cuts_one_of_several_objects_off_are_counted_once():
    masks = [ellipse(30, 110, (20.0, 20.0)) | ellipse(120, 60 if k < 10 else 110, (20.0, 20.0)) for k in range(NUM)]
    masks[0] = ellipse(120, 60, (20.0, 20.0))
    assert warnings_before(capture_of(masks)) == [f"warning: {unknown_depth(NUM - 1, NUM)}"]


def test_training_warns_if_too_few_frames_show_an_object():
    assert warnings_before(capture_of([ball(1.0)] * 11)) == [f"warning: {unknown_depth(0, 11)}"]


@NOT_ASKED_FOR
def test_unknown_depth_of_objects_is_no_warning_where_it_is_not_asked_for(config, change):
    capture = change(capture_of(with_cut_off(0)))
    assert fill_object_depth(config, capture, views_of(capture), no_alignments(), 0.0).num_cut is None


@pytest.mark.parametrize("error", [0.0, 0.15])
def test_known_depth_of_objects_that_the_border_cuts_off_is_no_warning(error):
    capture = misplaced(with_cut_off(0))
    alignments = torch.tensor([[1.0, 0.0]]).repeat(NUM, 1)
    found = fill_object_depth(CONFIG, capture, views_of(capture), alignments, error)
    assert found == ObjectDepth(0)


def test_depth_of_static_surfaces_alone_leaves_that_of_objects_unknown():
    static_depth = {"inverse_depth": lambda static: torch.where(static, 1.0 / WALL, torch.nan)}
    capture, alignments = capture_of(with_cut_off(0), **static_depth), torch.tensor([[1.0, 0.0]]).repeat(NUM, 1)
    assert fill_object_depth(CONFIG, capture, views_of(capture), alignments, 0.0) == ObjectDepth(0, NUM)


@pytest.mark.parametrize(
    "masks",
    [[BESIDE | mask for mask in with_cut_off(0)], [np.zeros((HEIGHT, WIDTH), bool)] * NUM],
    ids=["another object has a size", "nothing moves"],
)
def test_there_is_no_warning_where_size_gives_depth_or_nothing_moves(masks):
    assert warnings_before(capture_of(masks)) == []
