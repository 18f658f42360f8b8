"""Cameras with the distortion of a lens: points, rays, rendering, and lenses that cannot be used."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.scenes import as_leaves, gradients, make_camera, make_splats, relative_error, select
from warpgs import Camera, render
from warpgs.distortion import Distortion
from warpgs.rendering import RenderSettings

K = torch.tensor([[40.0, 0.0, 26.0], [0.0, 42.0, 18.0], [0.0, 0.0, 1.0]])
SIZE = (50, 37)
RADIAL = [-0.2, 0.05, 0.01, -0.005, 0.01, 0.02, 0.01, 0.002, 0.003, 0.001, -0.002, 0.001]
FISHEYE = [0.05, -0.02, 0.01, -0.004]
CAPTURED = {  # focal lengths, principal point, size and coefficients
    "phone": ("radial", (3000, 3000), (2016, 1512), (4032, 3024), [0.05, -0.15, 0.001, 0.0005, 0.12]),
    "depth camera": (
        "radial",
        (605, 605),
        (638, 366),
        (1280, 720),
        [0.46, -2.5, 7e-4, -3e-4, 1.5, 0.34, -2.4, 1.4],
    ),
    "wide": ("radial", (600, 600), (640, 480), (1280, 960), [-0.35, 0.12]),
    "pincushion": ("radial", (400, 400), (400, 300), (800, 600), [1.0]),
    "tangential": ("radial", (400, 400), (400, 300), (800, 600), [0.1, 0.0, 0.03, -0.02]),
    "off centre": ("radial", (900, 700), (100, 900), (1920, 1080), [-0.1, 0.02]),
    "one pixel": ("radial", (1, 1), (0.5, 0.5), (1, 1), [-0.1]),
    "200 degrees": ("fisheye", (440, 440), (640, 480), (1280, 960), [-0.01, 0.002, -0.002, 3e-4]),
}
LENSES = {
    "radial": Distortion.radial(RADIAL, K, SIZE),
    "fisheye": Distortion.fisheye(FISHEYE, K, SIZE),
    "equirectangular": Distortion.equirectangular(),
}


def camera(lens):
    turned = make_camera()
    return dataclasses.replace(turned, K=K, width=SIZE[0], height=SIZE[1], distortion=LENSES[lens])


@pytest.mark.parametrize("lens", LENSES)
def test_rays_are_bent_to_where_they_come_from(lens):
    rows, columns = torch.meshgrid(torch.arange(37), torch.arange(50), indexing="ij")
    depth = torch.linspace(1.0, 5.0, 37 * 50)
    points = camera(lens).unproject(rows.flatten(), columns.flatten(), depth)
    row, column, found, is_visible = camera(lens).project(points)
    assert is_visible.all()
    assert torch.equal(row, rows.flatten())
    assert torch.equal(column, columns.flatten())
    assert relative_error(found, depth) < 1e-5


@pytest.mark.parametrize("name", CAPTURED)
def test_rays_of_real_lenses_are_bent_to_where_they_come_from(name):
    lens, (fx, fy), (cx, cy), size, coefficients = CAPTURED[name]
    intrinsics = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distortion = getattr(Distortion, lens)(coefficients, intrinsics, size)
    across = torch.cartesian_prod(torch.linspace(0.0, size[0], 40), torch.linspace(0.0, size[1], 40))
    pixels = distortion.bend(distortion.rays((across - intrinsics[:2, 2]) / intrinsics.diagonal()[:2]))
    pixels = pixels * intrinsics.diagonal()[:2] + intrinsics[:2, 2]
    assert (pixels - across).norm(dim=1).max() < 1e-3 * max(1.0, max(size) / 1000.0)


@pytest.mark.parametrize("lens", LENSES)
def test_an_image_of_another_size_shows_points_at_the_same_places(lens):
    view = camera(lens)
    rows, columns = torch.tensor([3, 11, 30]), torch.tensor([4, 25, 45])
    points = view.unproject(rows, columns, torch.ones(3))
    row, column, _, is_visible = view.resized(150, 185).project(points)  # 3 times as wide, 5 times as high
    assert is_visible.all()
    assert torch.equal(row, 5 * rows + 2)
    assert torch.equal(column, 3 * columns + 1)


def test_pixels_outside_the_circle_of_a_fisheye_lens_show_no_point():
    wide = torch.tensor([[6.0, 0.0, 25.0], [0.0, 6.0, 25.0], [0.0, 0.0, 1.0]])
    view = Camera(torch.eye(4), wide, 50, 50, distortion=Distortion.fisheye([], wide, (50, 50)))
    pixel = torch.tensor([2, 12]), torch.tensor([2, 12])
    points = view.unproject(*pixel, torch.ones(2))
    assert points.isnan().all(1).tolist() == [True, False]
    assert view.project(points)[3].tolist() == [False, True]


@pytest.mark.parametrize("lens", LENSES)
def test_a_gaussian_appears_at_the_pixel_that_its_centre_is_projected_to(lens):
    view = camera(lens)
    for row, column in ((5, 7), (30, 44), (18, 26)):
        point = view.unproject(torch.tensor([row]), torch.tensor([column]), torch.tensor([3.0]))
        splats = dataclasses.replace(make_splats(1), means=point, scales=torch.full((1, 3), 1e-3))
        splats = dataclasses.replace(splats, opacities=torch.tensor([0.9]))
        rendered = render(splats, view, settings=RenderSettings(depth=True)).joint
        assert divmod(int(rendered.alpha.argmax()), SIZE[0]) == (row, column)
        assert rendered.depth[row, column] == pytest.approx(3.0, rel=1e-4)


@pytest.mark.parametrize("lens", ["radial", "fisheye"])
def test_the_coefficient_of_a_lens_is_found_from_its_image(lens):
    splats, view = make_splats(60), camera(lens)
    truth = torch.tensor(-0.15 if lens == "radial" else 0.1)

    def image(first):
        coefficients = torch.cat([first[None], torch.zeros(len(view.distortion.coefficients) - 1)])
        distortion = dataclasses.replace(view.distortion, coefficients=coefficients)
        return render(splats, dataclasses.replace(view, distortion=distortion)).joint.image

    first, target = torch.zeros((), requires_grad=True), image(truth)
    optimizer = torch.optim.Adam([first], lr=0.01)
    for _ in range(60):
        optimizer.zero_grad()
        (image(first) - target).square().mean().backward()
        optimizer.step()
    assert first.item() == pytest.approx(truth.item(), abs=0.01)


def test_without_coefficients_a_radial_lens_renders_as_a_pinhole():
    pinhole = make_camera()
    radial = dataclasses.replace(pinhole, distortion=Distortion.radial([], pinhole.K, pinhole.size))
    splats = make_splats(60)
    inside = pinhole.project(splats.means)[3]  # Jacobians are clamped by other rules outside
    assert inside.sum() > 10
    splats = select(splats, inside)
    torch.testing.assert_close(render(splats, radial).joint.image, render(splats, pinhole).joint.image)


def test_a_fisheye_camera_renders_what_is_beside_and_behind_it():
    wide = torch.tensor([[9.0, 0.0, 25.5], [0.0, 9.0, 25.5], [0.0, 0.0, 1.0]])
    view = Camera(torch.eye(4), wide, 50, 50, distortion=Distortion.fisheye([], wide, (50, 50)))
    for degrees in (0.0, 60.0, 90.0, 130.0):
        angle = math.radians(degrees)
        point = 2.0 * torch.tensor([[math.sin(angle), 0.0, math.cos(angle)]])
        splats = dataclasses.replace(make_splats(1), means=point, scales=torch.full((1, 3), 0.05))
        image = render(dataclasses.replace(splats, opacities=torch.tensor([0.9])), view).joint.alpha
        assert int(image.max(0).values.argmax()) == int(25.5 + 9.0 * angle)
        assert view.depths(point).item() == pytest.approx(2.0)
        assert bool(view.project(point)[3])


PANORAMA = Camera(
    make_camera().viewmat,
    torch.tensor([[64 / (2 * math.pi), 0.0, 32.0], [0.0, 32 / math.pi, 16.0], [0.0, 0.0, 1.0]]),
    64,
    32,
    distortion=Distortion.equirectangular(),
)
MOTION = torch.tensor([[0.1, 0.3, 0.0], [0.4, 0.1, 0.2]])


def turned_back(camera):
    """A panorama's camera turned by 180 degrees to its right."""
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    motion = None if camera.motion is None else camera.motion @ turn[:3, :3]
    return dataclasses.replace(camera, viewmat=turn @ camera.viewmat, motion=motion)


def around(num=60):
    """Splats in all directions around the camera, none of which reaches more than halfway around it."""
    splats = make_splats(num)
    splats = dataclasses.replace(splats, means=1.5 * splats.means - torch.tensor([0.0, 0.0, 5.0]))
    return as_leaves(select(splats, PANORAMA.depths(splats.means) > 0.5))


@pytest.mark.parametrize("motion", [None, MOTION])
def test_a_panorama_has_no_seam(motion):
    """What is in its middle, where splats are drawn once, is at its borders if the camera is turned back."""
    settings = RenderSettings(depth=True, branches=True)
    ahead = dataclasses.replace(PANORAMA, motion=motion)
    splats = around()
    layers = [render(splats, camera, settings=settings) for camera in (ahead, turned_back(ahead))]
    for name in ("joint", "static", "dynamic"):
        first, second = (getattr(layer, name) for layer in layers)
        assert second.alpha[:, [0, -1]].max() > 0.3
        for part in ("image", "alpha", "depth"):
            turned = getattr(second, part).roll(32, 1)
            torch.testing.assert_close(turned, getattr(first, part), rtol=1e-3, atol=1e-4)


def test_gradients_across_the_seam_of_a_panorama_are_as_elsewhere():
    found = []
    for camera, columns in ((PANORAMA, 0), (turned_back(PANORAMA), 32)):
        splats = around()
        offsets = torch.zeros_like(splats.means[:, :2], requires_grad=True)
        K, viewmat = (part.clone().requires_grad_() for part in (camera.K, camera.viewmat))
        view = dataclasses.replace(camera, K=K, viewmat=viewmat)
        image = render(splats, view, screen_offsets=offsets).joint.image.roll(columns, 1)
        (image * torch.linspace(-1.0, 1.0, 32)[:, None, None]).square().sum().backward()
        found.append([*gradients(splats).values(), offsets.grad, K.grad[1, 1], viewmat.grad[1]])
    for first, second in zip(*found, strict=True):
        assert relative_error(second, first) < 1e-3


def test_statistics_of_a_panorama_are_of_each_splat_once():
    splats, settings = around(), RenderSettings(statistics=True)
    first, second = (render(splats, camera, settings=settings) for camera in (PANORAMA, turned_back(PANORAMA)))
    assert first.radii.shape == (len(splats.means), 2)
    assert torch.equal(first.contributed, second.contributed)
    torch.testing.assert_close(first.weights, second.weights, rtol=1e-3, atol=1e-3)
    assert torch.equal(first.contributed, first.weights > 0)


def test_a_panorama_without_splats_is_empty():
    rendering = render(make_splats(0), PANORAMA, settings=RenderSettings(statistics=True))
    assert not rendering.joint.alpha.any()
    assert rendering.radii.shape == (0, 2)


@pytest.mark.parametrize(
    ("make", "coefficients", "message"),
    [
        (Distortion.radial, [-0.9], "folds back inside the image: it bends nothing farther than 0.406 focal lengths"),
        (Distortion.radial, [0.0, 0.0, 0.5], r"folds back inside the image: it bends nothing to \(0, 0\) px"),
        (Distortion.fisheye, [-0.9], "folds back inside the image: it bends nothing farther than 0.406 focal lengths"),
        (Distortion.radial, [math.nan], "at most 12 finite coefficients"),
        (Distortion.fisheye, [0.1] * 5, "at most 4 finite coefficients"),
    ],
)
def test_lenses_that_cannot_be_used_are_refused(make, coefficients, message):
    with pytest.raises(ValueError, match=message):
        make(coefficients, K, SIZE)


def test_a_lens_that_turns_outside_the_image_holds_up_to_there():
    lens = Distortion.radial([-0.2], K, SIZE)  # r - 0.2 r³ turns at 1.291
    corner = math.hypot(26.0 / 40.0, 19.0 / 42.0)
    assert corner < lens.limit < 1.291
    assert Distortion.fisheye([-0.2], K, SIZE).limit == pytest.approx(math.sqrt(1.0 / 0.6), rel=1e-3)


@pytest.mark.parametrize(("focal", "limit"), [(400.0, math.pi / 2), (150.0, 1.3 * 500.0 / 150.0 / 2)])
def test_a_fisheye_lens_sees_little_more_than_its_image_shows(focal, limit):
    intrinsics = torch.tensor([[focal, 0.0, 200.0], [0.0, focal, 150.0], [0.0, 0.0, 1.0]])
    lens = Distortion.fisheye([], intrinsics, (400, 300))
    assert lens.limit == pytest.approx(limit, rel=1e-3)
    view = Camera(torch.eye(4), intrinsics, 400, 300, distortion=lens)
    behind = torch.tensor([[0.1, 0.0, -1.0]])
    splats = dataclasses.replace(make_splats(1), means=behind, scales=torch.full((1, 3), 0.1))
    assert not render(splats, view).joint.alpha.any()


@pytest.mark.usefixtures("contracts_off")
@pytest.mark.parametrize(
    ("lens", "coefficients", "limit", "message"),
    [
        ("fish", torch.zeros(4), 1.0, "lens must be one of radial, fisheye, equirectangular, got 'fish'"),
        ("radial", torch.zeros(5), 1.0, r"coefficients must have shape \[12\]"),
        ("fisheye", torch.zeros(13), 1.0, r"coefficients must have shape \[4\]"),
        ("radial", torch.zeros(12, dtype=torch.float64), 1.0, "coefficients must be torch.float32"),
        ("radial", torch.zeros(12), math.nan, "limit must be positive and finite"),
        ("radial", torch.zeros(12), math.inf, "limit must be positive and finite"),
        ("fisheye", torch.zeros(4), math.pi, "of a fisheye at most 3.107"),
    ],
)
def test_coefficients_and_limits_that_do_not_fit_the_lens_are_refused(lens, coefficients, limit, message):
    with pytest.raises(ValueError, match=message):
        Distortion(lens, coefficients, limit)


@pytest.mark.usefixtures("contracts_off")
def test_a_camera_refuses_coefficients_without_their_lens():
    with pytest.raises(ValueError, match="distortion must be a Distortion or None, got list"):
        Camera(torch.eye(4), K, *SIZE, 0.0, RADIAL)


@pytest.mark.parametrize("shape", [(1, 5), (5, 1), (5,)])
def test_coefficients_may_be_the_array_that_opencv_returns(shape):
    array = np.array(RADIAL[:5]).reshape(shape)
    expected = Distortion.radial(RADIAL[:5], K, SIZE)
    assert torch.equal(Distortion.radial(array, K, SIZE).coefficients, expected.coefficients)


def test_coefficients_of_a_tensor_keep_their_gradient():
    coefficients = torch.tensor(FISHEYE, requires_grad=True)
    view = dataclasses.replace(camera("fisheye"), distortion=Distortion.fisheye(coefficients, K, SIZE))
    render(make_splats(60), view).joint.image.sum().backward()
    assert (coefficients.grad != 0.0).all()


def test_coefficients_that_are_not_numbers_render_nothing():
    lens = dataclasses.replace(LENSES["radial"], coefficients=torch.full((12,), math.nan))
    assert not render(make_splats(60), dataclasses.replace(camera("radial"), distortion=lens)).joint.alpha.any()


def test_the_camera_moves_its_distortion_to_the_device(monkeypatch):
    moved = dataclasses.replace(LENSES["radial"])
    monkeypatch.setattr(Distortion, "to", lambda distortion, device: moved)
    assert camera("radial").to("cpu").distortion is moved


def test_a_camera_and_its_distortion_are_on_one_device():
    with pytest.raises(ValueError, match="distortion"):
        dataclasses.replace(camera("radial"), distortion=LENSES["radial"].to("meta"))
