"""Surfaces of balls: exact depth gives round, closed and outward meshes, whatever windows they cross."""

import numpy as np
import pytest
import torch

from warpgs.cameras import Camera
from warpgs.config import RenderSettings
from warpgs.meshing import tsdf
from warpgs.meshing.depth_views import DepthView, depth_view
from warpgs.meshing.surface import MIN_FACES, UNKNOWN, Surface, colors_of, mesh_of, surface_of, without_small_parts
from warpgs.meshing.tsdf import SIDE, blocks_near, fitting_blocks, fuse
from warpgs.model.splats import Splats

AXES = [(1, 0.2, 0), (-1, 0.2, 0), (0, 1, 0.1), (0, -1, 0.1), (0.1, 0.2, 1), (0.1, 0.2, -1)]
DIRECTIONS = [*AXES, *((x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1))]


def camera_from(direction, distance=4.0):
    position = distance * torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float32), dim=0)
    return Camera.looking_at(position, torch.zeros(3), torch.tensor([0.3, 0.1, 0.5]), 150.0, (120, 120))


def view_of_ball(direction, radius=1.0, center=(0.0, 0.0, 0.0), color=(200, 100, 50)):
    """Exact depth of a ball."""
    camera = camera_from(direction)
    rays = camera.rays(camera.pixel_centers) @ camera.viewmat[:3, :3]
    offset = camera.position - torch.tensor(center)
    a, b = rays.square().sum(1), (rays * offset).sum(1)
    root = b.square() - a * (offset.square().sum() - radius**2)
    depth = torch.where(root > 0, (-b - root.clamp_min(0).sqrt()) / a, 0.0)
    image = torch.tensor(color, dtype=torch.uint8).expand(120, 120, 3)
    return DepthView(camera, depth.reshape(120, 120), image.contiguous())


def ball(voxel=0.06, directions=DIRECTIONS, **options):
    views = [view_of_ball(direction, **options) for direction in directions]
    return mesh_of(fuse(views, voxel, blocks_near(views, voxel)), views)


def num_open_edges(faces):
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] != 2).sum())


def volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize("voxel", [0.06, 0.02])  # the smaller one crosses windows
def test_a_ball_that_is_seen_from_all_sides_is_round_closed_and_outward(voxel):
    mesh = ball(voxel)
    errors = np.abs(np.linalg.norm(mesh.vertices, axis=1) - 1.0)
    assert errors.mean() < 0.3 * voxel
    assert errors.max() < 1.2 * voxel
    assert num_open_edges(mesh.faces) == 0
    assert volume(mesh) == pytest.approx(4 / 3 * np.pi, rel=0.03)


def test_what_no_camera_sees_has_no_surface():
    mesh = ball(directions=DIRECTIONS[:1])
    assert (mesh.vertices[:, 0] > -0.3).all()
    assert num_open_edges(mesh.faces) > 0


def test_vertices_have_the_colors_of_the_pixels_that_show_them():
    assert (ball().colors == [200, 100, 50]).all()
    behind = np.array([[-1.0, 0.0, 0.0], [0.0, 50.0, 0.0]], np.float32)
    front = view_of_ball((1, 0, 0), color=(255, 0, 0))
    back = view_of_ball((-1, 0, 0), color=(0, 255, 0))
    assert colors_of(behind, [front, back], 0.1).tolist() == [[0, 255, 0], [UNKNOWN] * 3]


def test_small_parts_are_floaters():
    views = [view_of_ball(direction) for direction in DIRECTIONS]
    floater = [view_of_ball(direction, 0.08, (1.6, 0.0, 0.0)) for direction in DIRECTIONS]
    views = [a._replace(depth=torch.where(a.depth > 0, a.depth, b.depth)) for a, b in zip(views, floater, strict=True)]
    whole = surface_of(fuse(views, 0.06, blocks_near(views, 0.06)))
    cleaned = without_small_parts(whole)
    assert np.linalg.norm(whole.vertices, axis=1).max() > 1.5
    assert np.linalg.norm(cleaned.vertices, axis=1).max() < 1.1
    assert MIN_FACES < len(cleaned.faces) < len(whole.faces)
    assert (whole.vertices[whole.faces[:10]] == cleaned.vertices[cleaned.faces[:10]]).all()


def test_nothing_seen_is_an_empty_mesh():
    view = view_of_ball((1, 0, 0))
    views = [view._replace(depth=torch.zeros_like(view.depth))]
    mesh = mesh_of(fuse(views, 0.1, blocks_near(views, 0.1)), views)
    assert [len(part) for part in mesh] == [0, 0, 0]
    empty = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert [len(part) for part in without_small_parts(empty)] == [0, 0]


@pytest.mark.parametrize("max_voxels", [20_000, 100_000])
def test_voxels_are_as_small_as_their_number_allows(max_voxels):
    views = [view_of_ball(direction) for direction in DIRECTIONS]
    voxel, blocks = fitting_blocks(views, max_voxels)
    assert max_voxels / 4 < len(blocks) * SIDE**3 <= max_voxels
    assert (blocks_near(views, voxel) == blocks).all()


def test_voxels_are_no_smaller_than_pixels():
    views = [view_of_ball((1, 0, 0))]
    assert fitting_blocks(views, 10**9)[0] == pytest.approx(3.2 / 150, rel=0.1)


def test_a_voxel_that_is_too_small_is_refused_with_one_that_is_not():
    views = [view_of_ball((1, 0, 0))]
    with pytest.raises(ValueError, match=r"--voxel 0\.01 needs .* more than the maximum of 100,000: use 0\.0") as error:
        fitting_blocks(views, 100_000, 0.01)
    allowed = float(str(error.value).split("use ")[1].split()[0])
    assert fitting_blocks(views, 100_000, allowed)[0] == allowed


def test_a_voxel_that_is_far_smaller_than_a_pixel_is_refused_before_voxels_are_counted(monkeypatch):
    monkeypatch.setattr(tsdf, "blocks_near", lambda views, size: pytest.fail("counted"))
    with pytest.raises(ValueError, match=r"--voxel 1e-09 is finer than the images: use 0\.00\d+ or larger"):
        fitting_blocks([view_of_ball((1, 0, 0))], 10**9, 1e-9)


def test_a_voxel_is_not_compared_with_the_pixels_of_images_in_which_nothing_is_seen():
    view = view_of_ball((1, 0, 0))
    voxel, blocks = fitting_blocks([view._replace(depth=torch.zeros_like(view.depth))], 10**9, 1e-9)
    assert (voxel, len(blocks)) == (1e-9, 0)


@pytest.mark.parametrize("is_dynamic", [False, True])
def test_depth_is_the_median_of_one_branch(is_dynamic):
    """A wall at 3 and a faint one before it at 2, of the branch; the other branch has a wall at 1."""
    depths = torch.tensor([1.0, 2.0, 3.0])
    splats = Splats(
        means=torch.stack([torch.zeros(3), torch.zeros(3), depths], 1),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        scales=torch.full((3, 3), 1.0) * torch.tensor([1.0, 1.0, 1e-3]),
        opacities=torch.tensor([0.99, 0.3, 0.99]),
        colors=torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0]]),
        is_dynamic=torch.tensor([not is_dynamic, is_dynamic, is_dynamic]),
    )
    camera = Camera(torch.eye(4), torch.tensor([[40.0, 0, 8], [0, 40.0, 8], [0, 0, 1]]), 16, 16)
    view = depth_view(splats, is_dynamic, camera, RenderSettings())
    assert view.depth[8, 8] == pytest.approx(3.0, abs=1e-3)
    assert view.image[8, 8].tolist() == pytest.approx([0, 77, 178], abs=2)


def test_large_images_are_scaled_down():
    camera = Camera(torch.eye(4), torch.tensor([[400.0, 0, 960], [0, 400.0, 8], [0, 0, 1]]), 1920, 16)
    splats = Splats(
        *(torch.ones(1, n) for n in (3, 4, 3)), torch.ones(1), torch.ones(1, 3), is_dynamic=torch.ones(1) > 0
    )
    view = depth_view(splats, True, camera, RenderSettings())
    assert view.depth.shape == (8, 960)
    assert float(view.camera.K[0, 0]) == 200.0
