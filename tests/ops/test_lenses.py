"""Lenses of the projection: points as OpenCV puts them, gradients in double precision, and what each lens sees."""

import math

import cv2
import numpy as np
import pytest
import torch

from tests.ops.alone import project
from tests.ops.test_projection import (
    assert_same_gradients,
    assert_same_values,
    gradients,
    in_double,
    random_gradient_rows,
)
from tests.reference.projection import project as reference
from tests.scenes import generator, relative_error
from warpgs.ops.projection import Geometry, View

K = torch.tensor([[30.0, 0.0, 24.0], [0.0, 28.0, 19.0], [0.0, 0.0, 1.0]])
SIZE = (50, 37)
RADIAL = torch.tensor([0.1, -0.05, 0.01, -0.02, 0.02, 0.05, 0.01, -0.01, 0.01, 0.005, -0.01, 0.004])
FISHEYE = torch.tensor([0.05, -0.02, 0.01, -0.004])
VIEWS = {
    "radial": View(torch.eye(4), K, *SIZE, RADIAL, 1.2, "radial"),
    "fisheye": View(torch.eye(4), K, *SIZE, FISHEYE, math.radians(110.0), "fisheye"),
}
K_WIDE = torch.tensor([[9.0, 0.0, 25.0], [0.0, 8.0, 18.0], [0.0, 0.0, 1.0]])
K_PANORAMA = torch.tensor([[50.0 / (2 * math.pi), 0.0, 25.0], [0.0, 37.0 / math.pi, 18.5], [0.0, 0.0, 1.0]])
PANORAMA = View(torch.eye(4), K_PANORAMA, *SIZE, torch.zeros(0), math.pi, "equirectangular")
CASES = {**VIEWS, "wide": VIEWS["fisheye"]._replace(K=K_WIDE), "panorama": PANORAMA}
"""The last two have nearly all that they see in their image."""


def gaussians(points: torch.Tensor, size: float = 0.05) -> Geometry:
    """Gaussians of about one size that are turned at random, at [N, 3] points in camera space."""
    num, random = len(points), generator()
    scales = size * (0.5 + torch.rand(num, 3, generator=random))
    return Geometry(points, torch.randn(num, 4, generator=random), scales, torch.full((num,), 0.7))


def scattered(view: View, num: int = 60) -> Geometry:
    """Gaussians in all directions around the axis up to what the lens sees, on it, and nearly on it."""
    random = generator(3)
    farthest = 0.99 * view.limit if view.lens != "radial" else math.atan(1.3 * view.limit)
    theta = farthest * torch.rand(num, generator=random)
    theta[:3] = torch.tensor([0.0, 1e-4, 0.0999])
    turn = 2 * math.pi * torch.rand(num, generator=random)
    across = torch.stack([turn.cos(), turn.sin()], 1) * theta.sin()[:, None]
    return gaussians((1.0 + 2.0 * torch.rand(num, 1, generator=random)) * torch.cat([across, theta.cos()[:, None]], 1))


@pytest.mark.parametrize("lens", VIEWS)
def test_points_are_where_opencv_puts_them(lens):
    view = VIEWS[lens]
    points = torch.tensor([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.5], [0.001, 0.002, 2.0], [0.6, 0.2, 1.0]])
    project_points = cv2.projectPoints if lens == "radial" else cv2.fisheye.projectPoints
    pose, coefficients = np.zeros(3), view.distortion.double().numpy()
    expected = project_points(points[:, None].double().numpy(), pose, pose, K.double().numpy(), coefficients)[0]
    assert relative_error(project(gaussians(points), view).means2d, torch.tensor(expected[:, 0])) < 1e-6


@pytest.mark.parametrize(
    ("direction", "longitude", "latitude"),
    [
        ((0.0, 0.0, 1.0), 0.0, 0.0),
        ((1.0, 0.0, 0.0), 90.0, 0.0),
        ((1.0, 0.0, -1.0), 135.0, 0.0),
        ((-1e-4, 0.0, -1.0), -179.994, 0.0),
        ((0.0, 1.0, 1.0), 0.0, 45.0),
        ((-1.0, -math.sqrt(2.0), 1.0), -45.0, -45.0),
    ],
)
def test_a_panorama_has_longitudes_to_the_right_and_latitudes_downward(direction, longitude, latitude):
    splats = project(gaussians(3.0 * torch.tensor([direction])), PANORAMA)
    expected = torch.tensor([[25.0 + longitude * 50.0 / 360.0, 18.5 + latitude * 37.0 / 180.0]])
    torch.testing.assert_close(splats.means2d, expected, rtol=1e-5, atol=1e-4)
    assert splats.depths.item() == pytest.approx(3.0 * torch.tensor(direction).norm().item())


@pytest.mark.parametrize("height", [-2.0, 2.0])
def test_a_panorama_culls_what_is_right_above_or_below_the_camera(height):
    points = torch.tensor([[0.0, height, 0.0], [0.05, height, 0.05]])
    assert project(gaussians(points, 0.01), PANORAMA).radii.gt(0).all(1).tolist() == [False, True]


def test_lenses_without_distortion_project_as_pinhole_and_equidistant():
    points = torch.tensor([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.5]])
    radial = VIEWS["radial"]._replace(distortion=torch.zeros(12))
    pinhole = View(torch.eye(4), K, *SIZE)
    for ours, expected in zip(project(gaussians(points), radial), project(gaussians(points), pinhole), strict=True):
        torch.testing.assert_close(ours, expected)
    fisheye = VIEWS["fisheye"]._replace(distortion=torch.zeros(4))
    theta = torch.atan2(points[:, :2].norm(dim=1), points[:, 2])
    expected = points[:, :2] / points[:, :2].norm(dim=1, keepdim=True) * theta[:, None] * K.diagonal()[:2] + K[:2, 2]
    torch.testing.assert_close(project(gaussians(points), fisheye).means2d, expected)


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("lens", CASES)
def test_values_equal_the_reference(lens, antialias):
    view = CASES[lens]
    geometry = scattered(view)
    splats = project(geometry, view, antialias=antialias)
    points = [part.double() for part in geometry]
    points[0][0, :2] = 1e-12  # where the formulas as printed are 0 / 0
    expected = reference(Geometry(*points), in_double(view), antialias=antialias)
    assert expected[-1].sum() > 20
    assert_same_values(splats, expected, 3e-6)


@pytest.mark.parametrize("lens", CASES)
def test_gradients_equal_the_reference(lens):
    view = CASES[lens]
    geometry = scattered(view)
    geometry.means[0, :2] = 2e-4  # the formulas as printed are 0 / 0 on the axis
    visible = assert_same_gradients(geometry, view, random_gradient_rows(len(geometry.means)), False, of_camera=True)
    assert visible.sum() > 20


@pytest.mark.parametrize("lens", CASES)
def test_gradients_on_the_axis_are_those_beside_it(lens):
    view, rows = CASES[lens], random_gradient_rows(2)
    rows[:, 1] = rows[:, 0]
    geometry = gaussians(torch.tensor([[0.0, 0.0, 2.0], [1e-5, 0.0, 2.0]]))
    geometry.quats[1], geometry.scales[1] = geometry.quats[0], geometry.scales[0]
    v_means = gradients(geometry, view, rows).geometry.means
    assert v_means.isfinite().all()
    torch.testing.assert_close(v_means[0], v_means[1], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    ("degrees", "is_seen"), [(80.0, True), (100.0, True), (109.0, True), (111.0, False), (180.0, False)]
)
def test_a_fisheye_lens_sees_what_is_behind_up_to_its_limit(degrees, is_seen):
    wide = CASES["wide"]._replace(distortion=torch.zeros(4))
    angle = math.radians(degrees)
    splats = project(gaussians(torch.tensor([[math.sin(angle) * 2.0, 0.0, math.cos(angle) * 2.0]]), 0.3), wide)
    assert bool(splats.radii.gt(0).all()) == is_seen
    if is_seen:
        assert splats.depths.item() == pytest.approx(2.0)


def test_a_polynomial_that_folds_back_does_not_bring_far_points_into_the_image():
    folding = VIEWS["radial"]._replace(distortion=torch.tensor([-0.3, *[0.0] * 11]), limit=0.9)  # turns at 1.054
    radius = torch.linspace(0.1, 6.0, 100)
    points = torch.stack([radius, torch.zeros(100), torch.ones(100)], 1)
    x = project(gaussians(points, 3.0), folding._replace(width=500)).means2d[:, 0]
    assert (x.diff() > 0.0).all()
