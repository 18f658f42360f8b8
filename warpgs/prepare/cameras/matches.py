"""Pairs of frames to match, and COLMAP's matches: those in static regions, and those that show parallax."""

import itertools
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float

from warpgs.data.images import decode
from warpgs.data.turning import Matches

from .recovered import camera_centers

OVERLAP = 10
"""Number of next frames that each frame is matched with, in addition to those at powers of two."""

NUM_REVISITS = 3
"""Number of frames far away in time that a frame is matched with, if they see the same points."""

MIN_SHARED = 0.5
"""Fraction of a frame's points in the image of a frame far away in time, from which on the two are matched."""

KEYFRAMES = 8
"""Of every how many frames of two cameras all pairs are matched: they may see the same at different times."""

APART = 100_000
"""Distance of the frames of two cameras, in frames: farther than any of one camera."""

Pair = tuple[int, int]


def sequence_pairs(count: int) -> list[Pair]:
    """Pairs of each frame with the next ones and those at powers of two, as indices, the first frame in order."""
    offsets = sorted({*range(1, OVERLAP + 1), *(2**k for k in range(OVERLAP))})
    return [(a, a + offset) for a in range(count) for offset in offsets if a + offset < count]


def all_pairs(count: int) -> list[Pair]:
    """All pairs, as indices."""
    return [(a, b) for a in range(count) for b in range(a + 1, count)]


def cross_pairs(groups: Sequence[Sequence[int]], times: Sequence[int]) -> list[Pair]:
    """Pairs of frames of two cameras: each with the one nearest in time, and all of every ``KEYFRAMES``-th.

    Args:
        groups: Indices of the frames of each camera, in temporal order. A single one of a camera is paired with all.
        times: Time of every frame [ms].
    """
    pairs = set()
    for first, second in itertools.combinations(groups, 2):
        pairs |= {(a, min(second, key=lambda b: abs(times[a] - times[b]))) for a in first}
        pairs |= {(min(first, key=lambda a: abs(times[a] - times[b])), b) for b in second}
        pairs |= {*itertools.product(first[::KEYFRAMES], second[::KEYFRAMES])}
    return sorted(pairs)


def revisit_pairs(
    model: Any, names: list[str], groups: Sequence[Sequence[int]] = (), sees_all: bool = False
) -> list[Pair]:
    """Pairs of frames far apart in time, or of two cameras, that see the same points, according to a reconstruction.

    Args:
        model: COLMAP's reconstruction.
        names: Names of the images.
        groups: Indices of the images of each camera, in temporal order; those of one camera if empty.
        sees_all: Whether images are panoramas, which see the more alike, the nearer they are to each other.
    """
    order = {k: place + APART * camera for camera, group in enumerate(groups) for place, k in enumerate(group)}
    images = {image.name: image for image in model.images.values() if image.has_pose}
    points = {key: point.xyz for key, point in model.points3D.items()}
    frames = [(k, images[name]) for k, name in enumerate(names) if name in images]
    poses = np.array([image.cam_from_world().matrix() for _, image in frames]).reshape(-1, 3, 4)
    limits = np.array([(1.0, 1.0) if sees_all else _half_size(i.camera) for _, i in frames]).reshape(-1, 2)
    shared = np.zeros((len(frames), len(frames)))
    for row, (_, image) in enumerate(frames):
        seen = [points[p.point3D_id] for p in image.points2D if p.has_point3D()]
        if seen:
            shared[row] = (
                _nearness(np.array(seen), poses, row) if sees_all else _visible(np.array(seen), poses, limits).mean(1)
            )
    shared = np.minimum(shared, shared.T)
    pairs = set()
    for row, (index, _) in enumerate(frames):
        score, place = shared[row].copy(), order.get(index, index)
        score[[abs(order.get(other, other) - place) <= OVERLAP for other, _ in frames]] = 0.0
        for _ in range(NUM_REVISITS):
            best = int(score.argmax())
            if score[best] < MIN_SHARED:
                break
            pairs.add((min(index, frames[best][0]), max(index, frames[best][0])))
            found = order.get(frames[best][0], frames[best][0])
            score[[abs(order.get(other, other) - found) < OVERLAP // 2 for other, _ in frames]] = 0.0
    return sorted(pairs)


def _nearness(
    points: Float[np.ndarray, "P 3"], poses: Float[np.ndarray, "F 3 4"], frame: int
) -> Float[np.ndarray, " F"]:
    """[F] how near cameras are to that of a frame: 1 at its place, 0.5 as far away as half of its points."""
    centers = camera_centers(poses)
    depth = np.median(np.linalg.norm(points - centers[frame], axis=1))
    return depth / (depth + np.linalg.norm(centers - centers[frame], axis=1))


def _half_size(camera: Any) -> Float[np.ndarray, "2"]:
    """Tangents of half the angles of view."""
    return np.array([camera.width, camera.height]) / (2.0 * camera.mean_focal_length())


def _visible(
    points: Float[np.ndarray, "P 3"], poses: Float[np.ndarray, "F 3 4"], limits: Float[np.ndarray, "F 2"]
) -> Bool[np.ndarray, "F P"]:
    """Whether points project into each of the images, whose distortion is neglected."""
    in_camera = points @ poses[:, :, :3].transpose(0, 2, 1) + poses[:, None, :, 3]
    depth = np.where(in_camera[..., 2] > 0, in_camera[..., 2], np.inf)
    return (in_camera[..., 2] > 0) & (np.abs(in_camera[..., :2] / depth[..., None]) < limits[:, None]).all(2)


def has_features(database: Path, names: list[str], num_pairs: int) -> bool:
    """Whether a database can be read and has the features of some images, and enough pairs.

    Args:
        database: COLMAP's database.
        names: Names of the images.
        num_pairs: Number of pairs that were matched at least.
    """
    if not database.is_file():
        return False
    try:
        opened = pycolmap.Database.open(database)
    except RuntimeError:
        return False
    try:
        images = {image.name: image.image_id for image in opened.read_all_images()}
        is_matched = opened.num_matched_image_pairs() >= num_pairs
        return is_matched and all(name in images and opened.exists_descriptors(images[name]) for name in names)
    except RuntimeError:  # damaged further inside
        return False
    finally:
        opened.close()


def keep_static(database: Path, masks: Path | None, names: list[str], unmasked: Collection[str] = ()) -> list[int]:
    """Removes matches of other images, and those in dynamic regions; returns each image's number of static features.

    Args:
        database: COLMAP's database, which is changed.
        masks: Folder of masks <image>.png, 0 = dynamic; None if nothing is.
        names: Names of the images to keep.
        unmasked: Names of the images that have no mask, because nothing moves.
    """
    opened = pycolmap.Database.open(database)
    try:
        static, counts = {}, dict.fromkeys(names, 0)
        for image in opened.read_all_images():
            own = None if image.name in unmasked else masks
            static[image.image_id] = kept = _static(opened, image, own, image.name in names)
            if image.name in counts:
                counts[image.name] = int(kept.sum())
        for key, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(key)
            matches = np.asarray(geometry.inlier_matches)
            keep = static[a][matches[:, 0]] & static[b][matches[:, 1]] if len(matches) else np.zeros(0, bool)
            if not keep.all():
                geometry.inlier_matches = matches[keep]
                opened.update_two_view_geometry(a, b, geometry)
    finally:
        opened.close()
    return list(counts.values())


def _static(opened: Any, image: Any, masks: Path | None, is_wanted: bool) -> Bool[np.ndarray, " K"]:
    """[K] whether each feature of an image is in a static region."""
    positions = _positions(opened, image.image_id)
    if not is_wanted or masks is None:
        return np.full(len(positions), is_wanted)
    mask = decode(masks / f"{image.name}.png", cv2.IMREAD_GRAYSCALE)
    column, row = np.clip(positions.astype(int), 0, [mask.shape[1] - 1, mask.shape[0] - 1]).T
    return mask[row, column] > 0


def verified_matches(database: Path) -> tuple[dict[tuple[str, str], Matches], tuple[int, int]]:
    """Positions of the matches of every verified pair of images by their names, and (width, height) of the images."""
    opened = pycolmap.Database.open(database)
    try:
        camera = opened.read_all_cameras()[0]
        images = opened.read_all_images()
        names = {i.image_id: i.name for i in images}
        positions = {i.image_id: _positions(opened, i.image_id) for i in images}
        found = {}
        for key, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(key)
            matches = np.asarray(geometry.inlier_matches).reshape(-1, 2)
            found[names[a], names[b]] = positions[a][matches[:, 0]], positions[b][matches[:, 1]]
        return found, (camera.width, camera.height)
    finally:
        opened.close()


def _positions(opened: Any, image: int) -> Float[np.ndarray, "K 2"]:
    features = np.asarray(opened.read_keypoints(image), np.float64)
    return features[:, :2] if features.size else np.zeros((0, 2))
