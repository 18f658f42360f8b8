"""Camera paths start and end at the right cameras, keep their target in view and stay in the scene."""

import dataclasses
import math
from itertools import pairwise

import pytest
import torch
from scipy.spatial.transform import Rotation

from warpgs.cameras import Camera
from warpgs.data.capture import Capture
from warpgs.video import camera_paths as paths

UP = torch.tensor([0.0, -1.0, 0.0])


def camera(x=0.0, time=0.0, focal=50.0, size=(64, 48)):
    return Camera.looking_at(torch.tensor([x, 0.0, -2.0]), torch.zeros(3), UP, focal, size, time)


def capture(positions, times):
    return capture_of([camera(x, t) for x, t in zip(positions, times, strict=True)])


def capture_of(views):
    cameras = {f"{k}": view for k, view in enumerate(views)}
    return Capture("test", cameras, list(cameras), [], torch.zeros(0, 3), None, lambda name: None)


def positions(path):
    return torch.stack([c.position for c in path])


def is_rigid(path):
    R = torch.stack([c.viewmat[:3, :3] for c in path])
    return bool((R @ R.transpose(1, 2) - torch.eye(3)).abs().max() < 1e-5) and bool((torch.linalg.det(R) > 0).all())


@pytest.mark.parametrize(("target", "up"), [((1.0, 2.0, 3.0), (0.0, 0.0, 1.0)), ((1.0, 2.0, 5.0), (0.0, 0.0, -2.0))])
def test_a_camera_without_a_direction_or_parallel_to_up_is_refused(target, up):
    with pytest.raises(ValueError, match="position and target coincide, or the view direction is parallel to up"):
        Camera.looking_at(torch.tensor([1.0, 2.0, 3.0]), torch.tensor(target), torch.tensor(up), 9.0, (4, 4))


@pytest.mark.parametrize("smooth", [False, True])
def test_a_path_passes_through_its_cameras(smooth):
    cameras = [camera(0.0, 0.2), camera(0.5, 0.4, focal=80.0), camera(-0.3, 0.9)]
    path = paths.interpolated(cameras, [0.0, 1.0, 4.0], [0.0, 1.0, 4.0], smooth)
    for a, b in zip(path, cameras, strict=True):
        assert (a.viewmat - b.viewmat).abs().max() < 1e-5
        assert (a.K - b.K).abs().max() < 1e-4
        assert a.time == pytest.approx(b.time)


@pytest.mark.parametrize("smooth", [False, True])
def test_halfway_between_two_cameras_everything_is_halfway(smooth):
    a, b = camera(0.0, 0.0, focal=50.0), camera(1.0, 1.0, focal=200.0)
    middle = paths.interpolated([a, b], [3.0, 5.0], [4.0], smooth)[0]
    assert (middle.position - torch.tensor([0.5, 0.0, -2.0])).abs().max() < 1e-5
    assert float(middle.K[0, 0]) == pytest.approx(100.0)
    assert middle.time == pytest.approx(0.5)
    assert is_rigid([middle])


def test_smooth_paths_do_not_overshoot():
    cameras = [camera(x) for x in (0.0, 0.0, 1.0, 1.0)]
    x = positions(paths.interpolated(cameras, [0.0, 1.0, 2.0, 3.0], [k / 10 for k in range(31)], smooth=True))[:, 0]
    assert x.min() > -1e-6
    assert x.max() < 1 + 1e-6
    assert (x.diff() > -1e-6).all()


def test_a_path_of_one_camera_is_constant():
    assert paths.interpolated([camera(0.3)], [0.0], [0.0, 0.0])[1].position[0] == pytest.approx(0.3)


TRAINING = {  # positions and times of the cameras, positions of the path
    "it is sorted by time": ([0.4, 0.0, 0.2], [1.0, 0.0, 0.5], [0.0, 0.1, 0.2, 0.3, 0.4]),
    "before the first time it stays at the first camera": ([0.1, 0.5], [0.5, 1.0], [0.1, 0.1, 0.5]),
    "of cameras at the same time the first is used": ([0.1, 0.9, 0.5], [0.0, 0.0, 1.0], [0.1, 0.5]),
}


@pytest.mark.parametrize(("xs", "times", "expected"), TRAINING.values(), ids=TRAINING)
def test_the_training_path_covers_all_times(xs, times, expected):
    path = paths.training_path(capture(xs, times), len(expected), smoothing=0.0)
    assert positions(path)[:, 0].tolist() == pytest.approx(expected, abs=1e-5)
    assert [c.time for c in path] == pytest.approx(paths.evenly_spaced(len(expected)))


def test_smoothing_removes_shaking():
    shaking = capture([0.05 * (k % 2) for k in range(21)], [k / 20 for k in range(21)])
    rough, smooth = (positions(paths.training_path(shaking, 21, s))[:, 0] for s in (0.0, 0.1))
    assert smooth[3:-3].diff().abs().max() < 0.05 * rough.diff().abs().max()
    assert is_rigid(paths.training_path(shaking, 21, 0.1))


@pytest.mark.parametrize("frames", [1, 2])
def test_paths_of_one_and_two_frames_have_that_length(frames):
    assert len(paths.training_path(capture([0.0, 1.0], [0.0, 1.0]), frames)) == frames


def test_the_focus_is_the_median_depth_of_the_visible_points():
    behind = torch.tensor([[0.0, 0.0, -9.0]])
    ahead = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0], [0.1, 0.0, 3.0], [math.nan, 0.0, 0.0]])
    assert paths.focus(camera(), torch.cat([behind, ahead])) == pytest.approx(4.0)


def test_the_focus_is_on_the_first_cloud_of_which_any_point_is_visible():
    empty, behind, near, far = torch.zeros(0, 3), *(torch.tensor([[0.0, 0.0, z]]) for z in (-9.0, 1.0, 5.0))
    assert paths.focus(camera(), empty, behind, near, far) == pytest.approx(3.0)


@pytest.mark.parametrize("points", [torch.zeros(0, 3), torch.tensor([[0.0, 0.0, -9.0]])])
def test_without_visible_points_the_focus_is_one_unit_away(points):
    assert paths.focus(camera(), points) == 1.0


def pixel_of(c, point):
    projected = c.K @ (c.viewmat[:3, :3] @ point + c.viewmat[:3, 3])
    return projected[:2] / projected[2]


def distance_from_center(c, point):
    """Distance of a point from the image center [px]."""
    return float((pixel_of(c, point) - c.K[:2, 2]).norm())


def test_a_spiral_keeps_its_target_centered_and_its_radius():
    path = paths.spiral(camera(), 2.0, 0.3, paths.evenly_spaced(40))
    assert max(distance_from_center(c, torch.zeros(3)) for c in path) < 1e-3
    distances = (positions(path) - torch.tensor([0.0, 0.0, -2.0])).norm(dim=1)
    assert distances.max() < 0.4
    assert distances.max() > 0.25
    assert is_rigid(path)
    assert [c.time for c in path] == paths.evenly_spaced(40)


def test_a_spiral_is_closed():
    path = paths.spiral(camera(), 2.0, 0.3, [0.0] * 200)
    assert (path[0].position - path[-1].position).norm() < 2 * (path[0].position - path[1].position).norm()


@pytest.mark.parametrize("stop", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("frames", [1, 2, 7, 120])
def test_time_stops_while_the_camera_swings(stop, frames):
    path = paths.bullet([camera()], [torch.zeros(1, 3)], stop, frames)
    assert len(path) == frames
    moved = (positions(path) - camera().position).norm(dim=1) > 1e-4
    assert all(c.time == stop for c, m in zip(path, moved, strict=True) if m)
    assert max(distance_from_center(c, torch.zeros(3)) for c in path) < 1e-3
    assert [c.time for c in path] == sorted(c.time for c in path)


def test_bullet_time_runs_from_the_first_time_to_the_last_swings_to_both_sides_and_keeps_its_distance():
    path = paths.bullet([camera()], [torch.zeros(1, 3)], 0.5, 120)
    assert (path[0].time, path[-1].time) == (0.0, 1.0)
    centers = positions(path)
    assert centers[:, 0].max() == pytest.approx(2 * math.sin(paths.BULLET_ARC), rel=0.01)
    assert centers[:, 0].min() == pytest.approx(-2 * math.sin(paths.BULLET_ARC), rel=0.01)
    assert centers.norm(dim=1).tolist() == pytest.approx([2.0] * 120, abs=1e-4)


def test_no_frame_of_bullet_time_is_shown_twice_and_the_swing_begins_and_ends_slowly():
    path = paths.bullet([camera()], [torch.zeros(1, 3)], 0.5, 120)
    assert all(a.time < b.time or (a.position - b.position).norm() > 1e-4 for a, b in pairwise(path))
    steps = [float((b.position - a.position).norm()) for a, b in pairwise(path)]
    swing = [step for step in steps if step > 1e-4]
    assert len(swing) == 61  # to the first of 60 frames, and from the last
    assert max(swing[0], swing[-1]) < 0.2 * max(swing)


@pytest.mark.parametrize("stop", [0.0, 0.3, 1.0])
def test_bullet_time_follows_a_path_while_time_runs_and_swings_around_where_it_stops(stop):
    training = [Camera(torch.eye(4), camera().K, 64, 48, k / 4) for k in range(5)]
    for k, view in enumerate(training):
        view.viewmat[:3, 3] = torch.tensor([-float(k), 0.0, 2.0])  # at x = k, looking at z = 0 from a distance of 2
    target = torch.tensor([4 * stop, 0.0, 0.0])
    path = paths.bullet(training, [target[None]], stop, 120)
    running, stopped = [c for c in path if c.time != stop], [c for c in path if c.time == stop]
    assert len(running) in (59, 60)
    assert positions(running)[:, 0].tolist() == pytest.approx([4 * c.time for c in running], abs=1e-4)
    assert max(distance_from_center(c, target) for c in stopped) < 1e-3
    sides = positions(stopped)[:, 0] - target[0]
    reach = 2 * math.sin(paths.BULLET_ARC)
    assert (float(sides.min()), float(sides.max())) == pytest.approx((-reach, reach), rel=0.01)


def test_outliers_do_not_enlarge_the_bounding_sphere():
    points = torch.randn(5000, 3)
    points[:20] *= 1e4
    points[20] = math.nan
    sphere = paths.BoundingSphere.around(points)
    assert sphere.center.norm() < 0.2
    assert 2 < sphere.radius < 5


def test_training_cameras_are_always_within_the_scene():
    far = torch.tensor([[0.0, 0.0, -50.0]])
    sphere = paths.BoundingSphere.around(torch.randn(100, 3), far)
    sphere.check([Camera.looking_at(far[0], torch.zeros(3), UP, 9.0, (4, 4))], "x")


def test_a_path_that_leaves_the_scene_is_refused_and_its_camera_named():
    sphere = paths.BoundingSphere.around(torch.randn(1000, 3) * 0.1)
    with pytest.raises(ValueError, match=r"^orbit leaves the scene: camera 1 at \(0, 0, -2\) is 2(\.\d+)? from its"):
        sphere.check([Camera(torch.eye(4), torch.eye(3), 4, 4), camera()], "orbit")


def test_a_camera_at_nan_is_refused():
    viewmat = torch.eye(4)
    viewmat[0, 3] = math.nan
    with pytest.raises(ValueError, match="leaves the scene"):
        paths.BoundingSphere(torch.zeros(3), 1.0).check([Camera(viewmat, torch.eye(3), 4, 4)], "orbit")


def test_a_scene_without_gaussians_has_no_bounding_sphere():
    with pytest.raises(ValueError, match="the scene has no Gaussians"):
        paths.BoundingSphere.around(torch.zeros(0, 3))


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0, 0.37])
def test_a_resized_camera_sees_the_same_view(factor):
    point = torch.tensor([0.3, -0.2, 0.5])
    a, b = camera(), paths.resized(camera(), factor)
    assert b.size == (round(64 * factor), round(48 * factor))
    relative = [pixel_of(c, point) / torch.tensor([float(c.width), float(c.height)]) for c in (a, b)]
    assert (relative[0] - relative[1]).abs().max() < 1e-6


def test_an_image_without_pixels_is_refused():
    with pytest.raises(ValueError, match=r"64 × 48 times 0\.001 has no pixels"):
        paths.resized(camera(), 0.001)


def ring(num, step, sizes=((64, 48),)):
    """A capture of cameras that turn around the vertical axis by a step [degrees]."""
    views = []
    for k in range(num):
        viewmat = torch.eye(4)
        viewmat[:3, :3] = torch.from_numpy(Rotation.from_euler("y", k * step, degrees=True).as_matrix())
        view = camera().resized(*sizes[k % len(sizes)])
        views.append(dataclasses.replace(view, viewmat=viewmat, time=k / (num - 1)))
    return capture_of(views)


def test_a_training_camera_that_turns_far_between_frames_jumps():
    assert [paths.jumps(ring(*args)) for args in ((10, 5), (10, 90), (2, 30))] == [False, True, False]


@pytest.mark.parametrize(("val", "expected"), [("", "2"), ("5", "5"), ("56", "6"), ("567", "6")])
def test_the_middle_view_is_one_to_evaluate_on_unless_there_is_none(val, expected):
    assert paths.middle_view(ring(8, 5).split("01234", val)) == expected


def test_the_replay_follows_the_training_camera_and_stays_at_the_middle_view_if_it_jumps():
    moving, jumping = ring(10, 5), ring(10, 90)
    for a, b in zip(paths.replay(moving, 7), paths.training_path(moving, 7), strict=True):
        assert torch.equal(a.viewmat, b.viewmat)
    still = paths.replay(jumping, 7)
    assert all(torch.equal(view.viewmat, jumping.cameras[jumping.train[5]].viewmat) for view in still)
    assert [view.time for view in still] == pytest.approx([k / 6 for k in range(7)])


def test_a_path_through_cameras_of_two_sizes_has_one_size_and_one_field_of_view():
    path = paths.training_path(ring(5, 2, ((64, 48), (32, 24))), 9)
    assert {c.size for c in path} == {(64, 48)}
    assert [float(c.K[0, 0]) for c in path] == pytest.approx([float(camera().K[0, 0])] * 9)


def test_a_cropped_view_has_the_rolling_shutter_of_its_rows():
    motion = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.1, 0.0]])
    whole = dataclasses.replace(camera(), motion=motion, duration=0.1)
    cropped = paths.filling(whole, (64, 24))
    rows, columns, depth = torch.tensor([2, 12, 20]), torch.tensor([10, 30, 50]), torch.full((3,), 2.0)
    assert torch.allclose(
        cropped.unproject(rows, columns, depth), whole.unproject(rows + 12, columns, depth), atol=1e-6
    )
    points = whole.unproject(rows + 12, columns, depth)
    assert torch.allclose(cropped.delays(points), whole.delays(points), atol=1e-6)


def test_the_training_path_is_of_the_camera_with_the_most_frames():
    two = capture([0.0, 9.0, 1.0, 9.0, 2.0], [0.0, 0.1, 0.5, 0.6, 1.0])
    ids = zip(two.cameras.items(), (0, 1, 0, 1, 0), strict=True)
    two = two.with_cameras({name: dataclasses.replace(camera, id=i) for (name, camera), i in ids})
    assert positions(paths.training_path(two, 3, smoothing=0.0))[:, 0].tolist() == pytest.approx([0.0, 1.0, 2.0])
