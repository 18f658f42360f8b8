"""A capture reads frames on request and caches the last ones."""

import dataclasses

import pytest
import torch

from warpgs.cameras import Camera
from warpgs.data import capture as capture_module
from warpgs.data.capture import Capture, Frame, missing_view


def camera(x: float) -> Camera:
    viewmat = torch.eye(4)
    viewmat[0, 3] = -x
    return Camera(viewmat, torch.eye(3), 4, 2)


def make_capture(xs=(0.0, 2.0, 4.0), cache_frames=256, train=None, mask=None, depth=None):
    """A capture with cameras along x, and the list of the frames read so far."""
    cameras, read = {f"f{k}": camera(x) for k, x in enumerate(xs)}, []

    def frame(name: str) -> Frame:
        read.append(name)
        return Frame(name, cameras[name], torch.zeros(2, 4, 3, dtype=torch.uint8), mask, depth)

    train = tuple(cameras) if train is None else train
    return Capture("c", cameras, train, (), torch.zeros(0, 3), None, frame, cache_frames), read


def test_opening_a_capture_reads_no_frame():
    assert make_capture()[1] == []


def test_a_capture_is_shown_in_one_line():
    assert repr(make_capture()[0]) == "<Capture c: 3 frames to train on, 0 to evaluate on, 0 points>"


def test_frames_are_sorted_by_their_times_and_names():
    capture, _ = make_capture()
    times = {"f0": 0.5, "f1": 0.2, "f2": 0.2}
    capture = capture.with_cameras({name: dataclasses.replace(camera(0.0), time=time) for name, time in times.items()})
    assert capture.in_time(("f2", "f0", "f1")) == ["f1", "f2", "f0"]


def rig(**moments):
    """A capture with frames of some (camera, time)."""
    capture = make_capture(xs=(0.0,) * len(moments))[0]
    given = dict(zip(moments, capture.cameras.values(), strict=True))
    cameras = {name: dataclasses.replace(given[name], id=i, time=time) for name, (i, time) in moments.items()}
    return dataclasses.replace(capture, cameras=cameras, train=list(moments))


def test_frames_are_told_by_their_camera_in_the_order_of_time():
    capture = rig(a=(1, 0.5), b=(0, 0.6), c=(1, 0.1), d=(0, 0.2))
    assert capture.by_camera(capture.train) == {0: ["d", "b"], 1: ["c", "a"]}


def test_neighbours_are_frames_of_one_camera():
    capture = rig(a=(0, 0.0), b=(1, 0.1), c=(0, 0.2), d=(1, 0.3), e=(0, 0.4))
    assert capture.neighbours(capture.train) == [("a", "c"), ("c", "e"), ("b", "d")]


def test_cameras_with_offsets_do_not_make_time_finer():
    capture = rig(a=(0, 0.0), b=(1, 0.1), c=(0, 0.4), d=(1, 0.5), e=(0, 0.8), f=(1, 0.9))
    assert capture.moments == [0.0, 0.4, 0.8, 0.9]
    assert capture.interval == pytest.approx(0.4)


def test_cameras_that_film_one_after_the_other_make_time_longer():
    capture = rig(a=(0, 0.0), b=(0, 0.25), c=(1, 0.5), d=(1, 0.75), e=(1, 1.0))
    assert capture.moments == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert capture.split(["c", "e"], []).moments == [0.5, 1.0]


def test_frames_of_one_time_have_no_interval():
    assert rig(a=(0, 0.5), b=(1, 0.5)).interval == 0.0


def test_frames_of_an_id_with_two_frames_of_one_time_have_no_neighbours():
    capture = rig(a=(0, 0.0), b=(0, 0.0), c=(0, 0.5), d=(1, 0.0), e=(1, 0.5))
    assert capture.neighbours(capture.train) == [("d", "e")]


def test_a_frame_is_read_once():
    capture, read = make_capture()
    assert capture.frame("f1") is capture.frame("f1")
    assert read == ["f1"]


def test_only_the_last_frames_are_cached():
    capture, read = make_capture(cache_frames=2)
    for name in ("f0", "f1", "f2", "f2", "f1", "f0"):
        capture.frame(name)
    assert read == ["f0", "f1", "f2", "f0"]


def test_frames_come_in_the_order_of_their_names():
    capture, read = make_capture()
    assert [frame.name for frame in capture.frames(("f2", "f0", "f1"))] == ["f2", "f0", "f1"]
    assert sorted(read) == ["f0", "f1", "f2"]


def test_the_cache_of_frames_has_a_maximum_size(monkeypatch):
    frame_bytes = capture_module.FRAME_BYTES_PER_PIXEL * make_capture()[0].cameras["f0"].width * 2
    monkeypatch.setattr(capture_module, "MAX_CACHE_BYTES", 2 * frame_bytes)
    capture, read = make_capture()
    for name in ("f0", "f1", "f2", "f2", "f1", "f0"):
        capture.frame(name)
    assert read == ["f0", "f1", "f2", "f0"]


def test_an_unknown_frame_is_a_key_error():
    with pytest.raises(KeyError, match="nine"):
        make_capture()[0].frame("nine")


def test_a_view_that_is_not_there_is_told_the_similar_one_or_the_first():
    capture = make_capture()[0].split(["f1", "f2"], [])
    assert missing_view(capture, "F2") == "c has no view 'F2'; did you mean 'f2'?"
    assert missing_view(capture, 7) == "c has no view 7; its first is 'f1'"
    assert missing_view(capture.split(["f1"], ["f2"]), "middle") == "c has no view 'middle'; its first is 'f2'"


def test_a_number_or_a_long_name_that_is_no_view_is_shown_as_given():
    capture = make_capture()[0]
    capture = dataclasses.replace(capture, cameras={"10": capture.cameras["f1"]}, train=["10"], val=[])
    assert missing_view(capture, 10) == "c has no view 10; did you mean '10'?"
    name = "shots/left_camera_of_the_pair/000001.png"
    assert repr(name) in missing_view(capture, name)


def test_the_radius_of_the_path_is_the_distance_of_the_farthest_training_camera_from_their_mean():
    assert make_capture()[0].path_radius == pytest.approx(2.0)
    assert make_capture(train=("f0", "f1"))[0].path_radius == pytest.approx(1.0)
    assert make_capture(xs=(3.0,))[0].path_radius == 0.0


def test_the_extent_is_a_tenth_more_and_has_a_minimum():
    assert make_capture()[0].extent == pytest.approx(1.1 * 2.0)
    assert make_capture(xs=(3.0,))[0].extent == capture_module.MIN_EXTENT


def with_points(capture, depth):
    """The capture with 50 points at a depth of its first camera, on its optical axis."""
    return dataclasses.replace(capture, points=torch.tensor([0.5, 0.5, 1.0]).expand(50, 3) * depth)


@pytest.mark.parametrize(("step", "hardly"), [(0.0, True), (0.009, True), (0.011, False)])
@pytest.mark.parametrize("unit", [0.1, 30.0])
def test_the_camera_hardly_moves_if_its_path_is_short_for_how_far_it_looks(step, hardly, unit):
    capture = make_capture(xs=(-step * unit, 0.0, step * unit))[0]
    assert with_points(capture, unit).hardly_moves == hardly


def test_only_metric_depth_tells_the_median_depth():
    depth = torch.full((2, 4), 0.2)
    capture, read = make_capture(depth=depth)
    assert capture.median_depth == 1.0
    assert read == []
    assert dataclasses.replace(capture, metric_depth=True).median_depth == pytest.approx(5.0)
    assert with_points(dataclasses.replace(capture, metric_depth=True), 3.0).median_depth == pytest.approx(3.0)


def test_few_frames_are_read_for_the_median_depth_and_for_none_twice():
    capture, read = make_capture(xs=tuple(map(float, range(40))), depth=torch.full((2, 4), 0.2))
    capture = dataclasses.replace(capture, metric_depth=True)
    assert capture.median_depth == capture.assuming("static").median_depth == pytest.approx(5.0)
    assert 0 < len(read) == len(set(read)) <= capture_module.MAX_DEPTH_IMAGES


def test_other_cameras_and_other_training_frames_have_a_median_depth_of_their_own():
    capture = with_points(make_capture()[0], 3.0)
    viewmat = torch.eye(4)
    viewmat[2, 3] = 2.0
    assert capture.median_depth == pytest.approx(3.0)
    back = {name: dataclasses.replace(camera, viewmat=viewmat) for name, camera in capture.cameras.items()}
    assert capture.with_cameras(back).median_depth == pytest.approx(5.0)
    half = capture.with_cameras({"f1": back["f1"]})
    assert (half.split(["f0"], ["f1"]).median_depth, half.split(["f1"], []).median_depth) == pytest.approx((3.0, 5.0))
    assert capture.median_depth == pytest.approx(3.0)


def test_the_view_size_is_the_width_of_what_an_image_shows_at_the_median_depth():
    capture = with_points(make_capture()[0], 3.0)
    camera = capture.cameras["f0"]
    corners = camera.unproject(torch.tensor([0, 0]), torch.tensor([0, camera.width - 1]), torch.full((2,), 3.0))
    between_centres = float((corners[1] - corners[0]).norm())
    assert capture.view_size == pytest.approx(between_centres * camera.width / (camera.width - 1))


@pytest.mark.parametrize("zoom", [0.2, 5.0])
def test_a_fraction_of_the_view_size_is_that_fraction_of_the_image_through_every_lens(zoom):
    capture = with_points(make_capture()[0], 3.0)
    K = capture.cameras["f0"].K * torch.tensor([zoom, zoom, 1.0])[:, None]
    K[:2, 2] = capture.cameras["f0"].K[:2, 2]
    zoomed = capture.with_cameras({n: dataclasses.replace(c, K=K) for n, c in capture.cameras.items()})
    shift = 0.1 * zoomed.view_size
    assert shift / zoomed.median_depth * float(K[0, 0]) == pytest.approx(0.1 * zoomed.cameras["f0"].width)


def test_portrait_and_landscape_have_one_view_size():
    capture = with_points(make_capture()[0], 3.0)
    turned = {
        name: dataclasses.replace(camera, K=camera.K[[1, 0, 2]][:, [1, 0, 2]], width=camera.height, height=camera.width)
        for name, camera in capture.cameras.items()
    }
    assert capture.cameras["f0"].width > capture.cameras["f0"].height
    assert capture.with_cameras(turned).view_size == pytest.approx(capture.view_size)


def test_a_capture_without_training_frames_is_refused():
    with pytest.raises(ValueError, match="c has no frames to train on: give train the ids of some"):
        make_capture(train=())


def test_frames_are_not_all_held_out():
    capture = make_capture()[0]
    with pytest.raises(ValueError, match="c has no frames to train on: give train the ids of some"):
        capture.split([], capture.train)


SOME_STATIC = torch.tensor([[True, False, True, True], [True, True, False, True]])


@pytest.mark.parametrize("mask", [None, SOME_STATIC])
@pytest.mark.parametrize(("assumption", "is_static"), [("static", True), ("dynamic", False)])
def test_an_assumption_replaces_the_masks(mask, assumption, is_static):
    capture = make_capture(mask=mask)[0].assuming(assumption)
    assert capture.assumption == assumption
    assert torch.equal(capture.frame("f0").static_mask, torch.full((2, 4), is_static))


@pytest.mark.parametrize("mask", [None, SOME_STATIC])
def test_assuming_masks_leaves_frames_as_they_are(mask):
    capture, _ = make_capture(mask=mask)
    assert capture.assuming("masks").frame("f0") is capture.frame("f0")
    assert capture.frame("f0").static_mask is mask


def test_an_assumption_leaves_the_capture_itself_unchanged():
    capture, _ = make_capture(mask=SOME_STATIC)
    assumed = capture.assuming("static")
    assumed.frame("f0")
    assert capture.assumption == "masks"
    assert capture.frame("f0").static_mask is SOME_STATIC
    assert assumed.assuming("masks").frame("f0").static_mask is SOME_STATIC


def test_an_assumption_shares_the_cache_and_everything_but_the_mask():
    capture, read = make_capture(mask=SOME_STATIC)
    assumed = capture.assuming("dynamic")
    assert assumed.frame("f1").image is capture.frame("f1").image
    assert read == ["f1"]
    assert (assumed.train, assumed.median_depth, assumed.points) == (
        capture.train,
        capture.median_depth,
        capture.points,
    )
