"""Training views are the same whether they are resident or read on demand."""

import dataclasses
from collections import Counter

import numpy as np
import pytest
import torch

from tests import tiny
from tests.data.captures import ids_of, write_capture
from tests.scenes import along_z
from warpgs.cameras import Camera
from warpgs.captures.opening import load_capture
from warpgs.data.capture import Capture, Frame
from warpgs.data.dynamic_regions import dynamic_counts, dynamic_regions
from warpgs.distortion import Distortion
from warpgs.model.poses import PoseCorrections
from warpgs.views import views as module
from warpgs.views.part import Part
from warpgs.views.pixels import mask_border
from warpgs.views.stacked_cameras import StackedCameras
from warpgs.views.views import Views

CPU = torch.device("cpu")
PLENTY = 1 << 30


@pytest.fixture(scope="module", params=["nerfds", "iphone", "builtin"])
def capture(request, tmp_path_factory):
    """Captures with masks, with depth and with both."""
    folder = tmp_path_factory.mktemp(request.param)
    return load_capture(tiny.write(folder) if request.param == "builtin" else write_capture(folder, request.param))


def views_of(capture, resident_bytes=PLENTY):
    if capture.frame(capture.train[0]).static_mask is None:
        capture = capture.assuming("static")
    return Views(capture, CPU, resident_bytes, mask_margin=0.05)


def without(capture, **changes):
    """The capture with changed frames."""

    def read(name):
        return dataclasses.replace(capture.frame(name), **changes)

    return Capture("less", capture.cameras, capture.train, capture.val, capture.points, None, read)


def assert_same(a, b):
    for name in ("time", "image", "static_mask", "mask_border", "inverse_depth"):
        left, right = getattr(a, name), getattr(b, name)
        assert left.dtype == right.dtype
        assert torch.equal(left.nan_to_num(-1.0), right.nan_to_num(-1.0)), name
    assert torch.equal(a.camera.viewmat, b.camera.viewmat)
    assert torch.equal(a.camera.K, b.camera.K)
    assert a.camera.size == b.camera.size


@pytest.mark.parametrize(
    ("lens", "coefficients", "shares"),
    [
        ("radial", [[-0.1, 0.02], [-0.11, 0.021]], True),
        ("fisheye", [[0.1], [0.11]], True),
        ("radial", [[-0.1, 0.02], [0.9, 1.5]], False),  # which shows less than the other one's image
    ],
)
def test_lenses_have_one_limit_unless_it_is_inside_an_image(lens, coefficients, shares):
    pinhole = along_z(40.0 if lens == "radial" else 20.0, (50, 37))
    bent = [getattr(Distortion, lens)(k, pinhole.K, pinhole.size) for k in coefficients]
    cameras = StackedCameras([dataclasses.replace(pinhole, distortion=one) for one in bent], CPU)
    limits = [one.limit for one in bent]
    assert limits[0] != limits[1]
    assert cameras.have_one_lens == shares
    assert [one.limit for one in cameras.lenses] == ([min(limits)] * 2 if shares else limits)


def with_circles(capture, circles):
    """The capture with fisheye lenses, whose circular images end at these angles, of its first cameras."""
    cameras = {name: capture.cameras[name] for name in capture.train[: len(circles)]}
    lenses = {n: Distortion.fisheye([0.03], c.K, c.size) for n, c in cameras.items()}
    lenses = {
        n: dataclasses.replace(lens, circle=circle) for (n, lens), circle in zip(lenses.items(), circles, strict=True)
    }
    return capture.with_cameras({n: dataclasses.replace(c, distortion=lenses[n]) for n, c in cameras.items()})


@pytest.mark.parametrize("resident_bytes", [PLENTY, 0])
def test_each_view_has_what_its_camera_shows(capture, resident_bytes):
    round_ones = with_circles(capture, [0.2, 0.3, 0.2])
    views = views_of(round_ones, resident_bytes)
    for index, name in enumerate(capture.train[:4]):
        views.select(index)
        expected = round_ones.cameras[name].shown
        for found in (views[index].shown, views.selected().shown):
            assert found is expected or torch.equal(found, expected)
    assert not views[0].shown.all()


def test_what_cameras_of_one_lens_show_is_computed_once(capture, monkeypatch):
    views = views_of(with_circles(capture, [0.2, 0.3, 0.2]))
    monkeypatch.setattr(Camera, "shown", property(lambda _: pytest.fail("computed again")))
    assert views[0].shown is views[2].shown is not views[1].shown


def test_rays_of_many_lenses_are_not_kept(capture, monkeypatch):
    views = views_of(with_circles(capture, [0.2, 0.3, 0.2]))
    rays = views.lens_rays()
    for k in range(3):
        camera = views.camera(k)
        found, expected = rays.at(torch.tensor([k])), camera.rays(camera.pixel_centers)
        assert torch.equal(found.nan_to_num(-9.0), expected.nan_to_num(-9.0))
    num_lenses = 2 + (len(views) > 3)
    nbytes = rays.at(torch.tensor([0])).nbytes * num_lenses
    monkeypatch.setattr(module, "MAX_RAY_BYTES", nbytes)
    assert views.lens_rays() is not None
    monkeypatch.setattr(module, "MAX_RAY_BYTES", nbytes - 1)
    assert views.lens_rays() is None


@pytest.mark.parametrize(("circles", "shares"), [([0.2, 0.2], True), ([0.2, 0.3], False)])
def test_lenses_are_one_if_they_show_the_same_pixels(circles, shares):
    pinhole = along_z(20.0, (50, 37))
    lens = Distortion.fisheye([0.1], pinhole.K, pinhole.size)
    lenses = [dataclasses.replace(lens, circle=circle) for circle in circles]
    cameras = StackedCameras([dataclasses.replace(pinhole, distortion=one) for one in lenses], CPU)
    assert cameras.have_one_lens == shares


@pytest.mark.parametrize(("durations", "shares"), [((0.1, 0.1), True), ((0.1, 0.2), False)])
def test_cameras_are_constants_of_a_graph_if_they_are_read_in_one_time(durations, shares):
    still = dataclasses.replace(along_z(20.0, (50, 37)), motion=torch.zeros(2, 3))
    cameras = StackedCameras([dataclasses.replace(still, duration=duration) for duration in durations], CPU)
    assert cameras.have_one_lens == shares
    assert [cameras.at(torch.tensor([k]), k, (50, 37)).duration for k in range(2)] == [*durations]


def test_each_view_has_the_motion_of_its_camera(capture):
    second = capture.train[1]
    assert views_of(capture)[0].camera.motion is None
    camera = dataclasses.replace(capture.cameras[second], motion=torch.full((2, 3), 0.01))
    views = views_of(capture.with_cameras({second: camera}))
    assert [float(views[index].camera.motion.max()) for index in (0, 1)] == pytest.approx([0.0, 0.01])


@pytest.mark.parametrize("resident_bytes", [PLENTY, 0])
def test_each_view_has_the_lens_of_its_camera(capture, resident_bytes):
    first, second, third, *_ = capture.train
    cameras = {name: capture.cameras[name] for name in (first, second, third)}
    bent = {
        first: Distortion.radial([0.1, 0.02], cameras[first].K, cameras[first].size),
        second: Distortion.fisheye([0.03], cameras[second].K, cameras[second].size),
        third: Distortion.radial([0.0, 0.0, 0.01], cameras[third].K, cameras[third].size),
    }
    moved = capture.with_cameras({n: dataclasses.replace(c, distortion=bent[n]) for n, c in cameras.items()})
    views = views_of(moved, resident_bytes)
    for index, name in enumerate(capture.train[:4]):
        views.select(index)
        for view in (views[index], views.selected()):
            found, expected = view.camera.distortion, bent.get(name)
            if expected is None or found is None:
                assert found is expected
            else:
                assert (found.lens, found.limit) == (expected.lens, expected.limit)
                assert torch.equal(found.coefficients, expected.coefficients)


def test_times_of_numpy_are_single_precision(capture):
    name, *_ = capture.train
    camera = dataclasses.replace(capture.cameras[name], time=np.float64(0.25))
    time = views_of(capture.with_cameras({name: camera}))[0].time
    assert time.dtype == torch.float32
    assert time.tolist() == [0.25]


def test_views_are_resident_if_their_pixels_fit(capture):
    stored = views_of(capture)._all
    nbytes = sum(t.nbytes for t in (stored.image, stored.static_mask, stored.inverse_depth, stored.mask_border))
    assert views_of(capture, nbytes).resident
    assert not views_of(capture, nbytes - 1).resident


def test_resident_views_are_those_of_training_and_equal_those_that_are_read_on_demand(capture):
    kept, read = views_of(capture), views_of(capture, resident_bytes=0)
    assert len(kept) == len(read) == len(capture.train)
    assert capture.val
    for index in range(len(kept)):
        assert_same(kept[index], read[index])


@pytest.mark.parametrize("resident_bytes", [PLENTY, 0])
def test_the_selected_view_is_that_of_the_index(capture, resident_bytes):
    views = views_of(capture, resident_bytes)
    for index in (*range(len(views)), 0):
        views.select(index)
        assert_same(views.selected(), views[index])
        assert views.index.tolist() == [index]


@pytest.mark.parametrize("resident_bytes", [PLENTY, 0])
def test_work_is_done_on_every_view_in_order(capture, resident_bytes):
    views = views_of(capture, resident_bytes)
    found = [(image.clone(), time.clone()) for image, time in views.map(lambda view: (view.image.sum(), view.time))]
    assert found == [(views[index].image.sum(), views[index].time) for index in range(len(views))]


def test_a_view_has_the_image_time_and_mask_of_its_frame(capture):
    views = views_of(capture)
    for index, name in enumerate(capture.train):
        frame, view = capture.frame(name), views[index]
        assert torch.equal((view.image * 255).round().byte(), frame.image)
        assert view.image.max() <= 1.0
        assert view.time.tolist() == pytest.approx([frame.camera.time])
        if frame.static_mask is not None:
            assert torch.equal(view.static_mask, frame.static_mask)


def test_inverse_depth_is_stored_in_half_precision_and_stays_unknown(capture):
    view, frame = views_of(capture)[1], capture.frame(capture.train[1])
    if frame.inverse_depth is None:
        assert view.inverse_depth.isnan().all()
    else:
        assert torch.equal(view.inverse_depth.isnan(), frame.inverse_depth.isnan())
        assert torch.allclose(view.inverse_depth, frame.inverse_depth, rtol=2**-11, atol=1e-7, equal_nan=True)


@pytest.mark.parametrize(("assume", "is_static"), [("static", True), ("dynamic", False)])
@pytest.mark.parametrize("resident_bytes", [0, PLENTY])
def test_an_assumption_overrides_masks(capture, resident_bytes, assume, is_static):
    views = Views(capture.assuming(assume), CPU, resident_bytes)
    assert all(bool((views[index].static_mask == is_static).all()) for index in range(len(views)))


@pytest.mark.parametrize("resident_bytes", [0, PLENTY])
def test_a_frame_without_a_mask_is_refused_by_name_with_advice(capture, resident_bytes):
    bare = without(capture, static_mask=None)
    with pytest.raises(
        ValueError, match=rf"frame {capture.train[0]} has no mask .*--assume static or --assume dynamic"
    ):
        Views(bare, CPU, resident_bytes)


def test_without_a_writable_cache_views_that_do_not_fit_say_so(capture, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    views = views_of(capture, resident_bytes=0)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warpgs: no cache for decoded views (")
    assert str(views.cache.folder) in line
    assert "set XDG_CACHE_HOME" in line


def test_frames_of_different_sizes_are_read_on_demand(tmp_path):
    """They cannot be stacked."""
    whole = load_capture(write_capture(tmp_path))
    smaller = ids_of("nerfds")[0][2]
    cameras = {**whole.cameras, smaller: dataclasses.replace(whole.cameras[smaller], width=20, height=10)}

    def read(name):
        frame = whole.frame(name)
        if name != smaller:
            return frame
        image, mask = frame.image[:10, :20], frame.static_mask[:10, :20]
        return dataclasses.replace(frame, camera=cameras[name], image=image, static_mask=mask)

    views = Views(Capture("mixed", cameras, whole.train, whole.val, whole.points, None, read), CPU, PLENTY)
    assert not views.resident
    assert views[2].image.shape == (10, 20, 3)
    assert views[1].image.shape == (24, 40, 3)


def test_the_border_of_a_mask_is_where_both_regions_are_near():
    mask = torch.ones(7, 9, dtype=torch.bool)
    mask[2:5, 4:] = False
    border = torch.zeros(7, 9, dtype=torch.bool)
    border[1:6, 3:] = True
    border[3, 5:] = False
    assert torch.equal(mask_border(mask, 1), border)
    assert torch.equal(mask_border(~mask, 1), border)


@pytest.mark.parametrize("value", [True, False])
def test_a_mask_of_one_region_has_no_border(value):
    assert not mask_border(torch.full((7, 9), value), 3).any()


def test_without_a_margin_there_is_no_border(capture):
    bare = capture.assuming("static")
    assert Views(bare, CPU, PLENTY)[0].mask_border is None
    assert Views(bare, CPU, 0)[0].mask_border is None


@pytest.mark.parametrize("resident_bytes", [0, PLENTY])
def test_frames_are_those_of_the_capture_without_depth_also_where_images_are_divided(capture, resident_bytes):
    bare = capture.assuming("static")
    views, order = Views(bare, CPU, resident_bytes), range(len(bare.train))[::-1]
    views.divide_by(torch.full((len(views), 3), 2.0))
    for index, frame in zip(order, views.frames(order), strict=True):
        expected = bare.frame(bare.train[index])
        assert (frame.name, frame.camera) == (expected.name, expected.camera)
        assert torch.equal(frame.image, expected.image)
        assert torch.equal(frame.static_mask, expected.static_mask)
        assert frame.inverse_depth is None


def test_gains_also_divide_images_that_were_read_ahead(capture):
    bare = capture.assuming("static")
    views, gains = Views(bare, CPU, 0), torch.full((len(bare.train), 3), 2.0)
    plain = views[1].image
    views.announce([0, 1])
    views.divide_by(gains)
    assert torch.equal(views[1].image, plain / 2.0)


def test_views_of_a_camera_are_in_the_order_of_time_not_of_names(capture):
    names = capture.train[:3]
    times = zip(names, (0.5, 0.0, 0.2), strict=True)
    moved = {name: dataclasses.replace(capture.cameras[name], time=time) for name, time in times}
    views = Views(capture.assuming("static").split(names, ()).with_cameras(moved), CPU, PLENTY)
    assert views.videos == [[1, 2, 0]]


@pytest.mark.parametrize("resident_bytes", [0, PLENTY])
def test_gains_divide_images(capture, resident_bytes):
    bare = capture.assuming("static")
    gains = torch.rand(len(bare.train), 3) + 0.5
    views, plain = Views(bare, CPU, resident_bytes), Views(bare, CPU, resident_bytes)
    views.divide_by(gains)
    for index in range(len(views)):
        assert torch.equal(views[index].image, plain[index].image / gains[index])


def test_the_margin_is_relative_to_the_larger_side(tmp_path):
    capture = load_capture(write_capture(tmp_path))
    view = Views(capture, CPU, PLENTY, mask_margin=2.4 / 40)[0]
    assert view.static_mask.shape == (24, 40)
    assert torch.equal(view.mask_border, mask_border(view.static_mask, 2))
    assert view.mask_border.any()


@pytest.mark.parametrize("resident_bytes", [0, PLENTY])
def test_corrections_move_the_cameras_of_views(capture, resident_bytes):
    if capture.frame(capture.train[0]).static_mask is None:
        capture = capture.assuming("static")
    poses = PoseCorrections(torch.arange(len(capture.train)), 2.0)
    with torch.no_grad():
        poses.translations[1] = 0.25
    views = Views(capture, CPU, resident_bytes, poses=poses)
    plain = Views(capture, CPU, resident_bytes)
    moves = [views[k].camera.viewmat - plain[k].camera.viewmat for k in range(2)]
    assert not moves[0].any()
    assert torch.allclose(moves[1][:3, 3], torch.full((3,), 0.5))
    assert [torch.equal(camera.viewmat, views[k].camera.viewmat) for k, camera in enumerate(views.cameras())] == [
        True
    ] * len(views)


@pytest.mark.parametrize("resident_bytes", [0, PLENTY])
def test_a_factor_changes_aligned_inverse_depth(capture, resident_bytes):
    if capture.frame(capture.train[0]).inverse_depth is None:
        pytest.skip("a layout without depth")
    views = views_of(capture, resident_bytes)
    before, other, alignment = views[1].inverse_depth, views[0].inverse_depth, torch.tensor([2.0, 0.5])
    factor = torch.linspace(0.8, 1.2, before.numel()).view(before.shape)
    views.set_depth_factor(1, alignment, factor)
    expected = (2.0 * before + 0.5) * factor
    torch.testing.assert_close(2.0 * views[1].inverse_depth + 0.5, expected, rtol=3e-3, atol=0.0, equal_nan=True)
    assert torch.equal(views[0].inverse_depth.nan_to_num(-1.0), other.nan_to_num(-1.0))


@pytest.mark.parametrize("resident_bytes", [PLENTY, 0])
def test_a_glance_holds_the_mask_and_a_small_image_of_a_view(capture, resident_bytes):
    views = views_of(capture, resident_bytes)
    for glance, view, name in zip(views.glances, views, capture.train, strict=True):
        assert torch.equal(glance.static_mask, view.static_mask)
        regions = dynamic_regions(view.static_mask, view.camera)
        assert np.array_equal(glance.regions, regions)
        assert glance.counts == dynamic_counts(view.static_mask, regions)
        assert glance.has_depth == (capture.frame(name).inverse_depth is not None)
        assert glance.colors.shape[:2] == glance.is_static.shape
        assert abs(glance.colors / 255.0 - view.image.numpy()).mean() < 0.5
        assert glance.is_static.all() == view.static_mask.all()


@pytest.mark.parametrize("resident_bytes", [PLENTY, 0])
def test_of_many_views_those_of_a_sample_are_worked_on(capture, resident_bytes, monkeypatch):
    monkeypatch.setattr(module, "MANY", 3)
    monkeypatch.setattr(module, "SAMPLED", 3)
    views = views_of(capture, resident_bytes)
    expected = views.sample
    assert len(expected) == 3 < len(views)
    assert [int(time * 1e6) for (time,) in views.map(lambda view: (view.time,))] == [
        int(views.time(index) * 1e6) for index in expected
    ]
    cameras = views.cameras()
    assert [torch.equal(found.viewmat, views.camera(k).viewmat) for found, k in zip(cameras, expected, strict=True)]
    assert len(cameras) == 3


def test_the_sample_of_many_views_is_spread_over_cameras_and_times(monkeypatch):
    monkeypatch.setattr(module, "MANY", 100)
    monkeypatch.setattr(module, "SAMPLED", 60)
    names = [f"{camera}-{time}" for time in range(50) for camera in range(6)]
    cameras = {
        name: dataclasses.replace(along_z(20.0, (6, 5)), id=int(name[0]), time=int(name[2:]) / 49.0) for name in names
    }
    static, image = torch.ones(5, 6, dtype=torch.bool), torch.zeros(5, 6, 3, dtype=torch.uint8)
    capture = Capture(
        "rig", cameras, names, [], torch.zeros(0, 3), None, lambda name: Frame(name, cameras[name], image, static)
    )
    sample = Views(capture, CPU, 0).sample
    assert sample == sorted({*sample})
    assert [*Counter(index % 6 for index in sample).values()] == [10] * 6
    assert len({index // 6 for index in sample}) > 25


def test_a_part_reads_its_views_from_the_whole(capture, monkeypatch):
    monkeypatch.setattr(module, "MANY", 2)
    monkeypatch.setattr(module, "SAMPLED", 2)
    views = views_of(capture)
    part = Part(views, range(1, len(views)))
    assert (len(part), part.device) == (len(views) - 1, views.device)
    assert len(part.sample) == 2
    assert max(part.sample) < len(part)
    for k, view, frame in zip((2, 0), part.each((2, 0)), part.frames((2, 0)), strict=True):
        assert torch.equal(view.image, views[k + 1].image)
        assert frame.name == capture.train[k + 1]
