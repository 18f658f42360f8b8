"""Objects of a trained scene: dynamic Gaussians whose paths stay close to each other at all times.

Two Gaussians are neighbours if they are never farther apart than a few times the usual distance between neighbours;
connected ones are an object (DBSCAN, Ester et al. 1996, of paths instead of points). So objects that touch now and
then are told apart, and what deforms without tearing stays one. Nothing else is needed: neither masks nor the capture.
"""

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int32
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from warpgs.data.npz import names_of, read_npz
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.errors import counted
from warpgs.files import write_bytes
from warpgs.runs.trained import TrainedScene
from warpgs.video.camera_paths import evenly_spaced

from .contribution import weakest
from .identity import identity_of

NAME = "objects.npz"
"""File in a run folder."""

ARRAYS = ("iteration", "fingerprint", "ids")
"""Arrays in it: the ``Identity`` of the scene, and the object of each dynamic Gaussian."""

MAX_BYTES = 1 << 30
"""Maximum size of its arrays [bytes]."""

NUM_TIMES = 16
"""Number of times at which paths are compared."""

MAX_FOUNDERS = 20_000
"""Maximum number of Gaussians that objects are found from; the others join the nearest."""

FAINT = 0.02
"""Part of all opacity that the faintest Gaussians hold, which found no object: little holds them where they are."""

NUM_NEIGHBORS, MIN_NEIGHBORS = 16, 8
"""Number of nearest paths among which neighbours are, and of neighbours that a Gaussian inside of an object has."""

REACH = 4.0
"""Largest distance of neighbours, relative to the median distance of the ``MIN_NEIGHBORS``-th. Objects of the
built-in scenes are found with 3.5 to 6."""

JOIN = 2.0
"""Largest distance from which a Gaussian joins an object, in those of neighbours."""

MIN_PART = 0.02
"""Minimum part of the founders in an object; smaller ones are fragments."""


class Objects(NamedTuple):
    """Which object each Gaussian belongs to.

    Attributes:
        ids: [N] number of its object, static Gaussians first; 0 if it belongs to none.
        names: Names of the objects 1, 2, …: of dynamic ones their numbers.
        num_dynamic: Number of dynamic Gaussians.
    """

    ids: Int32[np.ndarray, " N"]
    names: tuple[str, ...]
    num_dynamic: int

    def __str__(self) -> str:
        if not self.names:
            no_group = f"no group of the {self.num_dynamic:,} dynamic Gaussians stays together"
            return f"none, because {no_group if self.num_dynamic else 'nothing in this scene is dynamic'}"
        counts = np.bincount(self.ids, minlength=len(self.names) + 1)[1:]
        listed = zip(range(1, len(counts) + 1), self.names, counts, strict=True)
        return ", ".join(
            f"{k}{'' if name == str(k) else f' {name}'} ({counted(int(count), 'Gaussian')})"
            for k, name, count in listed
        )


def stored_objects(scene: TrainedScene, folder: Path) -> tuple[Int32[np.ndarray, " D"], str]:
    """The objects of a run, found once for its newest checkpoint and kept in its folder, so that all commands agree.

    Args:
        scene: Of the newest checkpoint, not edited.
        folder: Its run folder.

    Returns:
        As ``find_objects``; and a line about why they could not be stored, or an empty one.

    Raises:
        ValueError: If the file is damaged.
    """
    ids = known_objects(scene, folder)
    if ids is None:
        ids = find_objects(scene)
        try:
            write_objects(scene, folder, ids)
        except OSError as error:
            return ids, f"objects are found anew each time: {error}"
    return ids, ""


def known_objects(scene: TrainedScene, folder: Path) -> Int32[np.ndarray, " D"] | None:
    """The objects that were found before; None if they were not, or of other Gaussians. As ``stored_objects``."""
    path, count = folder / NAME, len(scene.scene.dynamic)
    if not count:
        return np.zeros(0, np.int32)
    if not path.exists() or not {*ARRAYS} <= names_of(path):
        return None
    stored = read_npz(path, ARRAYS, MAX_BYTES)
    ids, fingerprint = stored["ids"], stored["fingerprint"]
    if stored["iteration"].shape != () or ids.ndim != 1 or ids.dtype != np.int32 or fingerprint.dtype != np.uint8:
        raise ValueError(f"{path} does not hold one number, bytes and whole numbers of 32 bits: delete it")
    if (stored["iteration"], fingerprint.tobytes().hex()) != identity_of(scene) or len(ids) != count:
        return None
    if not 0 <= ids.min() <= ids.max() <= count:
        raise ValueError(f"{path} has numbers of objects outside of 0 to {count:,}: delete it")
    return ids


def write_objects(scene: TrainedScene, folder: Path, ids: Int32[np.ndarray, " D"]) -> None:
    """Keeps the objects of a scene; raises OSError if they cannot be written."""
    iteration, fingerprint = identity_of(scene)
    data, digest = io.BytesIO(), np.frombuffer(bytes.fromhex(fingerprint), np.uint8)
    np.savez_compressed(data, iteration=iteration, fingerprint=digest, ids=ids)
    write_bytes(folder / NAME, [data.getvalue()])


def find_objects(scene: TrainedScene) -> Int32[np.ndarray, " D"]:
    """The object of each dynamic Gaussian: 1 of the largest, 2 of the next, …; 0 if it belongs to none."""
    ids = np.zeros(len(scene.scene.dynamic), np.int32)
    paths, is_opaque = _paths(scene)
    known = np.isfinite(paths).all((1, 2))
    founders = np.flatnonzero(known & is_opaque)
    founders = founders[evenly_spaced_indices(len(founders), MAX_FOUNDERS)]
    if len(founders) <= NUM_NEIGHBORS:
        return ids
    found, reach = _connected(paths[founders])
    inside = found > 0
    if not inside.any():
        return ids
    distances, nearest = cKDTree(_flat(paths[founders[inside]])).query(_flat(paths[known]))
    ids[known] = np.where(distances <= JOIN * reach, found[inside][nearest], 0)
    return _by_size(ids)


def _paths(scene: TrainedScene) -> tuple[Float64[np.ndarray, "D T 3"], Bool[np.ndarray, " D"]]:
    """Positions of the dynamic Gaussians over time, and which are not faint."""
    first = len(scene.scene.static)
    means = [scene.splats(time).means[first:].double().cpu() for time in evenly_spaced(NUM_TIMES)]
    return torch.stack(means, 1).numpy(), (~weakest(scene.scene.dynamic.opacities, FAINT)).cpu().numpy()


def _flat(paths: Float64[np.ndarray, "D T 3"]) -> Float64[np.ndarray, "D T3"]:
    """Paths as points whose distance is the root mean square over time."""
    return paths.reshape(len(paths), -1) / np.sqrt(paths.shape[1])


def _connected(paths: Float64[np.ndarray, "F T 3"]) -> tuple[Int32[np.ndarray, " F"], float]:
    """Connected components of paths that are large enough, numbered from 1, and the distance of neighbours."""
    points, count = _flat(paths), len(paths)
    _, neighbors = cKDTree(points).query(points, NUM_NEIGHBORS + 1)
    neighbors = neighbors[:, 1:]
    farthest = np.zeros(neighbors.shape)  # at any time
    for k in range(NUM_NEIGHBORS):
        farthest[:, k] = np.linalg.norm(paths - paths[neighbors[:, k]], axis=2).max(1)
    surrounded = np.sort(farthest, axis=1)[:, MIN_NEIGHBORS - 1]
    reach = REACH * float(np.median(surrounded))
    is_inner = surrounded <= reach
    linked = (farthest <= reach) & is_inner[:, None] & is_inner[neighbors]
    row, column = linked.nonzero()
    graph = coo_matrix((np.ones(len(row), bool), (row, neighbors[row, column])), (count, count))
    labels = connected_components(graph, directed=False)[1]
    sizes = np.bincount(labels)
    is_object = sizes >= max(MIN_NEIGHBORS + 1, MIN_PART * count)
    numbers = np.where(is_object, np.cumsum(is_object), 0)
    return numbers[labels].astype(np.int32), reach


def _by_size(ids: Int32[np.ndarray, " D"]) -> Int32[np.ndarray, " D"]:
    """The objects numbered by how many Gaussians they have."""
    sizes = np.bincount(ids)[1:]
    numbers = np.zeros(len(sizes) + 1, np.int32)
    numbers[1 + np.argsort(-sizes, kind="stable")] = np.arange(1, len(sizes) + 1)
    return numbers[ids]
