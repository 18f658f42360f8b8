"""The depth at which cameras see a scene: of points, else of depth images, else of where the cameras look."""

import math

import pytest
import torch

from warpgs.cameras import Camera
from warpgs.data.median_depth import UNKNOWN_DEPTH, median_depth

SIZE = (64, 48)
NONE = torch.zeros(0, 3)


def looking(position, target, size=SIZE):
    return Camera.looking_at(position, target, (0.0, -1.0, 0.0), 50.0, size)


def along(step, count=5):
    """Cameras that look along z from a path of ``count`` steps along x."""
    return [looking((step * k, 0.0, 0.0), (step * k, 0.0, 1.0)) for k in range(count)]


def points_at(depths, count=30):
    """``count`` points at each depth of cameras near the origin, close to their axes."""
    offsets = torch.linspace(-0.1, 0.1, count)
    parts = [torch.stack([d * offsets, 0.5 * d * offsets, torch.full((count,), float(d))], 1) for d in depths]
    return torch.cat(parts)


def unread():
    """Depth images of which none may be read."""
    yield pytest.fail("a depth image was read")


@pytest.mark.parametrize("step", [0.0, 1e-4, 0.1])
def test_it_is_the_median_depth_of_the_points_however_little_the_camera_moves(step):
    assert median_depth(along(step), points_at([1.0, 3.0, 8.0]), unread()) == pytest.approx(3.0)


def test_it_has_the_unit_of_the_scene():
    cameras, points = along(0.1), points_at([1.0, 3.0, 8.0])
    larger = [looking(100.0 * c.position, 100.0 * (c.position + c.viewmat[2, :3])) for c in cameras]
    assert median_depth(larger, 100.0 * points, ()) == pytest.approx(300.0)


def test_depth_is_along_the_optical_axis_and_no_distance():
    corner = torch.tensor([0.6, 0.4, 1.0])  # 1.23 from the camera
    assert median_depth(along(0.0), 2.0 * corner.expand(20, 3), ()) == pytest.approx(2.0)


def test_points_that_no_camera_sees_do_not_count():
    behind, beside = points_at([-2.0, -3.0, -4.0, -5.0]), points_at([0.5] * 4) + torch.tensor([5.0, 0.0, 0.0])
    points = torch.cat([points_at([3.0]), behind, beside])
    assert median_depth(along(0.01), points, ()) == pytest.approx(3.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30])
def test_points_that_are_far_outliers_or_not_finite_change_nothing(value):
    points = torch.cat([points_at([1.0, 3.0, 8.0]), torch.full((20, 3), value)])
    assert median_depth(along(0.01), points, ()) == pytest.approx(3.0)


def test_many_cameras_and_points_are_sampled_evenly():
    depth = 2.0 + torch.rand(50_000, generator=torch.Generator().manual_seed(3))
    points = torch.stack([torch.zeros_like(depth), torch.zeros_like(depth), depth], 1).sort(0).values
    assert median_depth(along(1e-5, count=300), points, ()) == pytest.approx(2.5, abs=0.01)


def image(depth, unknown=math.nan):
    inverse = torch.full((48, 64), 1.0 / depth)
    inverse[:20] = unknown
    return inverse


@pytest.mark.parametrize("unknown", [math.nan, 0.0, math.inf, -1.0])
@pytest.mark.parametrize("points", [NONE, points_at([9.0], 3)], ids=["none", "too few"])
def test_without_enough_points_it_is_the_median_of_the_depth_images(points, unknown):
    images = [image(depth, unknown) for depth in (2.0, 4.0, 5.0)]
    assert median_depth(along(0.1), points, images) == pytest.approx(4.0)


def ring(radius, angle, count=12, center=(0.0, 0.0, 0.0)):
    """Cameras on an arc around a point at which they look."""
    angles = [angle * k / (count - 1) for k in range(count)]
    positions = [(radius * math.sin(a) + center[0], 0.02 * k + center[1], -radius * math.cos(a) + center[2])
                 for k, a in enumerate(angles)]  # fmt: skip
    return [looking(position, center) for position in positions]


@pytest.mark.parametrize("angle", [0.3, math.pi / 2, 2.0 * math.pi])
def test_without_points_and_depth_it_is_the_distance_to_where_the_optical_axes_converge(angle):
    cameras = ring(4.0, angle, center=(1.0, 2.0, 3.0))
    distances = torch.stack([c.position - torch.tensor([1.0, 2.0, 3.0]) for c in cameras]).norm(dim=1)
    assert median_depth(cameras, NONE, [torch.full((4, 4), math.nan)]) == pytest.approx(
        float(distances.median()), rel=1e-5
    )


def test_cameras_that_look_elsewhere_do_not_hide_where_the_others_converge():
    stray = looking((0.0, 0.0, -4.0), (0.0, 3.0, -4.5))
    assert median_depth([*ring(4.0, 2.0, count=40), stray], NONE, ()) == pytest.approx(4.0, rel=0.1)


def outward(radius, count=12):
    """Cameras on a circle that look away from its centre."""
    angles = [2.0 * math.pi * k / count for k in range(count)]
    positions = [(radius * math.sin(a), 0.0, radius * math.cos(a)) for a in angles]
    return [looking(p, (2.0 * p[0], 0.0, 2.0 * p[2])) for p in positions]


def turning(jitter):
    """Cameras that turn by half a circle, each at a random place near (3, 0, 0)."""
    generator = torch.Generator().manual_seed(1)
    cameras = []
    for k in range(24):
        position = torch.tensor([3.0, 0.0, 0.0]) + jitter * torch.randn(3, generator=generator)
        axis = torch.tensor([math.cos(k * math.pi / 24), 0.0, math.sin(k * math.pi / 24)])
        cameras.append(looking(position, position + axis))
    return cameras


NOWHERE = {
    "one": along(0.0, count=1),
    "parallel": along(0.1),
    "forwards": [looking((0.0, 0.0, 0.1 * k), (1e-3 * (-1) ** k, 0.0, 10.0)) for k in range(9)],
    "outward": outward(2.0),
    "turning": turning(0.0),
    "turning and shaking": turning(1e-3),
}


@pytest.mark.parametrize("cameras", NOWHERE.values(), ids=NOWHERE)
def test_where_nothing_tells_it_training_starts_in_the_box_of_one_scene_unit(cameras):
    assert median_depth(cameras, NONE, ()) == UNKNOWN_DEPTH == 1.0


def test_the_same_capture_has_the_same_depth():
    cameras, points = ring(3.0, 1.0), torch.randn(1000, 3, generator=torch.Generator().manual_seed(2))
    assert median_depth(cameras, points, ()) == median_depth(cameras, points.clone(), ())
