"""Triangle meshes of signed distances: marching cubes of scikit-image, in dense windows of a bounded size."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64, UInt8
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from warpgs.formats.mesh import Mesh

from .depth_views import DepthView
from .tsdf import SIDE, TRUNCATION, Field

WINDOW = 8
"""Blocks along each side of a window."""

WELD = 1e-3
"""Distance within which vertices at the border of two windows are the same one [voxels]."""

MIN_FACES = 200
"""Connected parts of fewer triangles, about as many as a ball of six voxels across has, are floaters."""

UNKNOWN = 128
"""Grey of vertices that no view shows."""


class Surface(NamedTuple):
    """Triangles.

    Attributes:
        vertices: [V, 3] positions.
        faces: [F, 3] as of ``Mesh``.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]


def mesh_of(field: Field, views: Iterable[DepthView]) -> Mesh:
    """The surface at which signed distances are 0, without floaters, in the colours of the views."""
    surface = without_small_parts(surface_of(field))
    vertices = surface.vertices.astype(np.float32)
    return Mesh(vertices, surface.faces, colors_of(vertices, views, TRUNCATION * field.voxel))


def surface_of(field: Field) -> Surface:
    """The surface at which signed distances are 0 [scene units], in cells all of whose corners are known.

    Where a surface ends in what no camera has seen, it is open.
    """
    blocks = field.blocks.cpu().numpy()
    index = {tuple(block): k for k, block in enumerate(blocks.tolist())}
    values = field.values.cpu().numpy().reshape(-1, SIDE, SIDE, SIDE)
    known = field.weights.cpu().numpy().reshape(values.shape) > 0
    parts, count = [Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64))], 0
    for window in np.unique(blocks // WINDOW, axis=0):
        part = _marched(*_dense(WINDOW * window, index, values, known))
        parts.append(Surface(part.vertices + WINDOW * SIDE * window, part.faces + count))
        count += len(part.vertices)
    joined = _welded(Surface(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True))))
    return Surface(joined.vertices * field.voxel, joined.faces)


def without_small_parts(surface: Surface) -> Surface:
    """A surface without its connected parts of fewer than ``MIN_FACES`` triangles."""
    _, part = _connected(len(surface.vertices), surface.faces[:, [0, 1]], surface.faces[:, [1, 2]])
    sizes = np.bincount(part[surface.faces[:, 0]], minlength=len(surface.vertices))
    is_kept = sizes[part] >= MIN_FACES
    number = np.cumsum(is_kept) - 1
    return Surface(surface.vertices[is_kept], number[surface.faces[is_kept[surface.faces[:, 0]]]])


def colors_of(
    vertices: Float32[np.ndarray, "V 3"], views: Iterable[DepthView], tolerance: float
) -> UInt8[np.ndarray, "V 3"]:
    """Mean colours of vertices in the views that show them; of vertices that none shows, in those that look there.

    Args:
        vertices: [V, 3] positions [scene units].
        views: The views.
        tolerance: Maximum difference of the depth of a vertex and of the pixel that shows it [scene units].
    """
    total, weights = np.zeros((len(vertices), 3)), np.zeros((len(vertices), 1))
    for view in views:
        row, column, depth, is_seen = view.camera.project(torch.from_numpy(vertices).to(view.depth.device))
        found = view.depth[row, column]
        shows = is_seen & ((found - depth).abs() < tolerance)
        weight = (shows + 1e-6 * (is_seen & (found > 0))).cpu().numpy()[:, None]
        total += weight * view.image[row, column].cpu().numpy()
        weights += weight
    mean = np.where(weights > 0, total / np.maximum(weights, 1e-12), UNKNOWN)
    return np.rint(mean).astype(np.uint8)


def _dense(
    first: Int64[np.ndarray, "3"], index: dict[tuple[int, ...], int], values: np.ndarray, known: np.ndarray
) -> tuple[Float32[np.ndarray, "n n n"], Bool[np.ndarray, "n n n"]]:
    """Values of a window from a block on, with one more voxel at each upper side, and whether they are known."""
    side = WINDOW * SIDE + 1
    dense, is_known = np.ones((side, side, side), np.float32), np.zeros((side, side, side), bool)
    for offset in np.ndindex(*[WINDOW + 1] * 3):
        block = index.get(tuple((first + offset).tolist()))
        if block is not None:
            sizes = [SIDE if k < WINDOW else 1 for k in offset]
            target = tuple(slice(SIDE * k, SIDE * k + size) for k, size in zip(offset, sizes, strict=True))
            source = tuple(slice(0, size) for size in sizes)
            dense[target], is_known[target] = values[block][source], known[block][source]
    return dense, is_known


def _marched(dense: Float32[np.ndarray, "n n n"], is_known: Bool[np.ndarray, "n n n"]) -> Surface:
    """The surface in a window [voxels]."""
    corners = [tuple(slice(k, k - 1 or None) for k in corner) for corner in np.ndindex(2, 2, 2)]
    is_inside = dense <= 0  # as scikit-image decides
    cells = np.logical_and.reduce([is_known[corner] for corner in corners])
    cells &= np.logical_or.reduce([is_inside[corner] for corner in corners])
    cells &= ~np.logical_and.reduce([is_inside[corner] for corner in corners])
    if not cells.any():
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    mask = np.pad(cells, ((1, 0),) * 3)  # scikit-image looks it up at the upper corner of a cell
    vertices, faces, _, _ = marching_cubes(dense, 0.0, mask=mask, gradient_direction="descent")
    return Surface(vertices.astype(np.float64), faces.astype(np.int64))


def _welded(surface: Surface) -> Surface:
    """A surface [voxels] whose windows share their vertices, without triangles that have no area."""
    vertices, side = surface.vertices, WINDOW * SIDE
    is_border = (np.abs(vertices - side * np.rint(vertices / side)) < WELD).any(1)
    border = np.flatnonzero(is_border)
    pairs = cKDTree(vertices[border]).query_pairs(WELD, output_type="ndarray")
    count, label = _connected(len(vertices), border[pairs])
    welded = np.zeros((count, 3))
    welded[label] = vertices
    faces = label[surface.faces].astype(np.int64)
    has_area = (faces != np.roll(faces, 1, axis=1)).all(1)
    return Surface(welded, faces[has_area])


def _connected(count: int, *pairs: Int64[np.ndarray, "_ 2"]) -> tuple[int, np.ndarray]:
    """The number of connected parts of ``count`` nodes, and the part of each, from pairs of them."""
    first, second = np.concatenate(pairs).T
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), (count, count))
    return connected_components(graph, directed=False)
