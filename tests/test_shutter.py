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
