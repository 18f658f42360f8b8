"""Cameras with a rolling shutter: rows, points and rays, rendering, and motion from images."""

import dataclasses
import math

import pytest
import torch

from tests.scenes import make_camera, make_splats, relative_error
from warpgs import Camera, Distortion, RenderSettings, render

MOTION = torch.tensor([[0.05, -0.08, 0.03], [0.10, 0.06, -0.05]])
GLOBAL = make_camera()
ROLLING = dataclasses.replace(GLOBAL, motion=MOTION)
CAMERAS = {
    "pinhole": ROLLING,
    "radial": dataclasses.replace(ROLLING, distortion=Distortion.radial([-0.2, 0.05], GLOBAL.K, GLOBAL.size)),
    "fisheye": dataclasses.replace(ROLLING, distortion=Distortion.fisheye([0.05], GLOBAL.K, GLOBAL.size)),
}
LENSES = pytest.mark.parametrize("lens", CAMERAS)


def at_readout(camera: Camera, s: float) -> Camera:
    """The camera with a global shutter where a rolling one is at a share of its readout after the middle row."""
    turn, move = camera.motion.double()
    x, y, z = (-s * turn).tolist()
    turned = torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64))
    viewmat = camera.viewmat.double()
    viewmat[:3, 3] -= s * move
    viewmat[:3] = turned @ viewmat[:3]
    return dataclasses.replace(camera, viewmat=viewmat.float(), motion=None)


def row_by_row(splats, camera: Camera) -> torch.Tensor:
    """The image of which each row is a render from where the camera is then."""
    poses = [at_readout(camera, (row + 0.5) / camera.height - 0.5) for row in range(camera.height)]
    return torch.stack([render(splats, pose).joint.image[row] for row, pose in enumerate(poses)])


@LENSES
def test_each_row_shows_what_the_camera_sees_while_it_is_read(lens):
    splats = dataclasses.replace(make_splats(60), scales=torch.full((60, 3), 0.06))
    expected = row_by_row(splats, CAMERAS[lens])
    still = render(splats, dataclasses.replace(CAMERAS[lens], motion=None)).joint.image
    rolling = render(splats, CAMERAS[lens]).joint.image
    assert (rolling - expected).square().mean() < (still - expected).square().mean() / 200


@LENSES
def test_points_of_pixels_are_seen_there_again(lens):
    camera = CAMERAS[lens]
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    depth = torch.linspace(1.0, 5.0, camera.height * camera.width)
    row, column, found, is_visible = camera.project(camera.unproject(rows.flatten(), columns.flatten(), depth))
    assert is_visible.all()
    assert torch.equal(row, rows.flatten())
    assert torch.equal(column, columns.flatten())
    assert relative_error(found, depth) < 1e-5


@LENSES
def test_points_of_a_row_are_where_the_camera_sees_them_while_it_is_read(lens):
    row, column = torch.tensor([31]), torch.tensor([12])
    pose = at_readout(CAMERAS[lens], 31.5 / GLOBAL.height - 0.5)
    ours, expected = (camera.unproject(row, column, torch.tensor([2.0])) for camera in (CAMERAS[lens], pose))
    torch.testing.assert_close(ours, expected)


QUARTER_TURN = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""To the left, of what the image shows: the top becomes the left side."""


def turned(camera: Camera) -> Camera:
    """The camera, turned by a quarter, whose image is that of the camera turned to the left."""
    viewmat, K = camera.viewmat.clone(), camera.K.clone()
    viewmat[:3] = QUARTER_TURN @ viewmat[:3]
    K[0, 0], K[1, 1] = camera.K[1, 1], camera.K[0, 0]
    K[0, 2], K[1, 2] = camera.K[1, 2], camera.width - camera.K[0, 2]
    motion, size = camera.motion @ QUARTER_TURN.T, {"width": camera.height, "height": camera.width}
    sign = -1.0 if camera.by_columns else 1.0  # columns read to the right become rows read upwards
    shutter = {"motion": sign * motion, "duration": sign * camera.duration, "by_columns": not camera.by_columns}
    return dataclasses.replace(camera, viewmat=viewmat, K=K, **size, **shutter)


@pytest.mark.parametrize("turns", [1, 2, 3])
@LENSES
def test_an_upright_phone_sees_the_turned_image_of_a_lying_one(lens, turns):
    images, gradients, delays = [], [], []
    weights = torch.rand(GLOBAL.height, GLOBAL.width, 3, generator=torch.Generator().manual_seed(0))
    for k in (0, turns):
        motion = MOTION.clone().requires_grad_()
        camera = dataclasses.replace(CAMERAS[lens], motion=motion, duration=0.1)
        for _ in range(k):
            camera = turned(camera)
        splats = dataclasses.replace(make_splats(60), scales=torch.full((60, 3), 0.06))
        splats = dataclasses.replace(splats, means=splats.means.clone().requires_grad_())
        image = torch.rot90(render(splats, camera).joint.image, -k)
        (image * weights).sum().backward()
        images.append(image.detach())
        gradients.append((splats.means.grad, motion.grad))
        delays.append(camera.delays(splats.means).detach())
    assert relative_error(images[1], images[0]) < 1e-4
    for of_turned, of_lying in zip(*reversed(gradients), strict=True):
        assert relative_error(of_turned, of_lying) < 1e-3
    torch.testing.assert_close(delays[1], delays[0], rtol=1e-4, atol=1e-6)


@LENSES
def test_pixels_of_an_upright_phone_are_seen_there_again(lens):
    camera = turned(CAMERAS[lens])
    assert camera.by_columns
    rows, columns = torch.meshgrid(torch.arange(camera.height), torch.arange(camera.width), indexing="ij")
    points = camera.unproject(rows.flatten(), columns.flatten(), torch.full((rows.numel(),), 2.0))
    row, column, _, is_visible = camera.project(points)
    assert is_visible.all()
    assert torch.equal(row, rows.flatten())
    assert torch.equal(column, columns.flatten())


@LENSES
def test_a_gaussian_appears_at_the_pixel_and_depth_that_its_centre_is_projected_to(lens):
    camera = CAMERAS[lens]
    for row, column in ((2, 4), (34, 44), (18, 26)):
        point = camera.unproject(torch.tensor([row]), torch.tensor([column]), torch.tensor([3.0]))
        splats = dataclasses.replace(make_splats(1), means=point, scales=torch.full((1, 3), 1e-3))
        splats = dataclasses.replace(splats, opacities=torch.tensor([0.9]))
        rendered = render(splats, camera, settings=RenderSettings(depth=True)).joint
        assert divmod(int(rendered.alpha.argmax()), camera.width) == (row, column)
        assert rendered.depth[row, column] == pytest.approx(3.0, rel=1e-4)


def test_the_motion_of_a_camera_is_found_from_its_image():
    splats = make_splats(60)
    target = row_by_row(splats, ROLLING)
    motion = torch.zeros(2, 3, requires_grad=True)
    optimizer = torch.optim.Adam([motion], lr=0.02)
    for _ in range(200):
        optimizer.zero_grad()
        image = render(splats, dataclasses.replace(GLOBAL, motion=motion)).joint.image
        (image - target).square().mean().backward()
        optimizer.step()
    assert (motion - MOTION).norm() < 0.2 * MOTION.norm()


def test_motion_that_is_not_a_number_renders_nothing():
    camera = dataclasses.replace(GLOBAL, motion=torch.full((2, 3), math.nan))
    assert not render(make_splats(60), camera).joint.alpha.any()


@pytest.mark.usefixtures("contracts_off")
def test_motion_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"motion must have shape \[2, 3\]"):
        dataclasses.replace(GLOBAL, motion=torch.zeros(6))


def test_a_camera_and_its_motion_are_on_one_device():
    with pytest.raises(ValueError, match="motion"):
        dataclasses.replace(GLOBAL, motion=MOTION.to("meta"))
