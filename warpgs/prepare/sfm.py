"""Cameras and sparse points of a moving camera's frames, by COLMAP (pycolmap).

SIFT features away from what moves, matching, incremental mapping with bundle adjustment, one lens for all frames.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  pycolmap before OpenCV breaks OpenCV's PNG files: both bring a zlib (seen with 5.0 and 4.2)
import numpy as np
import pycolmap
from jaxtyping import Float

from warpgs.data.lens import Lens

from .options import LensModel

EXHAUSTIVE_FRAMES = 100
"""Up to so many frames all pairs are matched; beyond, each with the next ones and with some further off."""

FALLBACK_FRAMES = 250
"""Up to so many frames all pairs are matched where matching along the sequence has lost some."""

OVERLAP = 10
"""Frames after each frame that it is matched with; beyond, powers of two."""

MAX_FEATURES = 4096
"""Features a frame; matching takes time with their square."""

WEAK_PEAK = 0.002
"""Contrast that weak features must have at least; COLMAP's default is 0.0067."""

MIN_FEATURES = 60
"""Features a frame under which pictures count as without texture."""

MIN_REGISTERED = 0.5
"""Share of the frames that must get a camera."""

MIN_ANGLE = 1.0
"""Median angle under which points are seen [degrees]; less leaves depth undetermined."""

MIN_POINTS = 100
"""Points under which a reconstruction is chance: a camera that only turns gives some."""

MAX_ERROR = 2.0
"""Points with a larger mean reprojection error are left out [px]."""


class NoCamerasError(ValueError):
    """The pictures don't tell where they were taken from."""


@dataclass(frozen=True)
class Cameras:
    """What was recovered.

    Attributes:
        names: Frames that got a camera, in order.
        lens: Of them all.
        poses: [F, 3, 4] world to camera, OpenCV axes.
        points: [P, 3] in the world.
        error: Mean reprojection error [px].
        angle: Median over the points of the largest angle between two rays to one [degrees].
    """

    names: list[str]
    lens: Lens
    poses: Float[np.ndarray, "F 3 4"]
    points: Float[np.ndarray, "P 3"]
    error: float
    angle: float

    def save(self, path: Path) -> None:
        """Writes an .npz file."""
        lens = self.lens
        np.savez(
            path,
            names=np.array(self.names),
            lens=np.array([lens.width, lens.height, *lens.focal, *lens.center, *lens.radial, *lens.tangential]),
            poses=self.poses,
            points=self.points,
            quality=np.array([self.error, self.angle]),
        )

    @staticmethod
    def load(path: Path) -> "Cameras":
        """What ``save`` wrote."""
        with np.load(path) as z:
            v = z["lens"].tolist()
            lens = Lens(int(v[0]), int(v[1]), (v[2], v[3]), (v[4], v[5]), (v[6], v[7], v[8]), (v[9], v[10]))
            error, angle = z["quality"].tolist()
            return Cameras(z["names"].tolist(), lens, z["poses"], z["points"], error, angle)


def recover_cameras(
    folder: Path,
    names: list[str],
    work: Path,
    model: LensModel = "SIMPLE_RADIAL",
    masks: Path | None = None,
    thorough: bool = True,
    weak: bool = False,
) -> Cameras:
    """Cameras of the frames folder/<name>.png.

    Args:
        folder: Where the frames are.
        names: Which.
        work: Empty or missing folder for COLMAP's files, removed afterwards.
        model: COLMAP's model of the lens.
        masks: Folder of masks <name>.png.png; features are taken where they are not 0.
        thorough: Whether to match all pairs of few frames, not only along the sequence.
        weak: Whether to take features of low contrast too: more on plain walls, less exact ones.

    Raises:
        NoCamerasError: If the pictures are not fit; says why and what to try.
        ValueError: If COLMAP itself failed.
    """
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 4  # errors come as exceptions
    try:
        _extract(folder, names, work, _readers(model, masks, weak))
        best = _largest(folder, len(names), work, thorough)
    except (RuntimeError, IndexError) as error:
        raise ValueError(f"COLMAP failed on {folder}: {error}") from error
    finally:
        pycolmap.logging.minloglevel = level
        shutil.rmtree(work, ignore_errors=True)
    if best is None:
        raise NoCamerasError(
            "no two frames show enough of the same static things from different places: move the camera sideways, "
            "slower and over textured things, or take frames closer in time (--fps, --count)"
        )
    return _result(best, names)


def _readers(model: str, masks: Path | None, weak: bool) -> tuple[Any, Any]:
    reading, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reading.camera_model = model
    if masks is not None:
        reading.mask_path = masks
    extraction.sift.max_num_features = MAX_FEATURES
    if weak:
        extraction.sift.peak_threshold = WEAK_PEAK
    return reading, extraction


def _extract(folder: Path, names: list[str], work: Path, options: tuple[Any, Any]) -> None:
    files = [f"{name}.png" for name in names]
    database, one_lens = work / "database.db", pycolmap.CameraMode.SINGLE
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(database, folder, files, one_lens, *options, pycolmap.Device.cpu)
    _check_features(database, len(names))


def _largest(folder: Path, count: int, work: Path, thorough: bool) -> Any:
    """The largest reconstruction; None if there is none."""
    exhaustive = thorough and count <= EXHAUSTIVE_FRAMES
    best = _matched(folder, work, "first", exhaustive)
    few = best is None or best.num_reg_images() < 0.9 * count
    if few and not exhaustive and count <= FALLBACK_FRAMES:
        again = _matched(folder, work, "again", True)
        if best is None or (again is not None and again.num_reg_images() > best.num_reg_images()):
            best = again
    return best


def _check_features(database: Path, count: int) -> None:
    opened = pycolmap.Database.open(database)
    try:
        features = opened.num_keypoints() / count
    finally:
        opened.close()
    if features < MIN_FEATURES:
        raise NoCamerasError(
            f"the pictures have hardly any texture where nothing moves: {features:.0f} features a frame, at least "
            f"{MIN_FEATURES} are needed; film textured things, in more light, or check the masks"
        )


def _matched(folder: Path, work: Path, name: str, exhaustive: bool) -> Any:
    database, out = work / "database.db", work / name
    if exhaustive:
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
    else:
        pairs = pycolmap.SequentialPairingOptions()
        pairs.overlap, pairs.quadratic_overlap, pairs.loop_detection = OVERLAP, True, False
        pycolmap.match_sequential(database, pairing_options=pairs, device=pycolmap.Device.cpu)
    out.mkdir()
    models = pycolmap.incremental_mapping(database, folder, out)
    return max(models.values(), key=lambda m: m.num_reg_images(), default=None)


def _result(model: Any, names: list[str]) -> Cameras:
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    if len(images) < max(MIN_REGISTERED * len(names), 3):
        raise NoCamerasError(
            f"only {len(images)} of {len(names)} frames could be placed: too much moves, the camera moves too fast, "
            "or the pictures have too little texture; try more frames (--fps, --count), a slower part of the video, "
            "or masks of what moves (--masks FOLDER)"
        )
    poses = np.array([i.cam_from_world().matrix() for i in images])
    points = [p for p in model.points3D.values() if p.track.length() >= 3 and p.error <= MAX_ERROR]
    found = Cameras(
        [Path(i.name).stem for i in images],
        _lens(images[0].camera),
        poses,
        np.array([p.xyz for p in points]).reshape(-1, 3),
        float(model.compute_mean_reprojection_error()),
        _angle(model, points),
    )
    if found.angle < MIN_ANGLE or len(points) < MIN_POINTS:
        raise NoCamerasError(
            f"the camera hardly changes its place: {len(points)} points could be placed, seen under "
            f"{found.angle:.1f}°; at least {MIN_POINTS} and {MIN_ANGLE}° are needed; walk around the scene "
            "instead of turning in one place"
        )
    return found


def _angle(model: Any, points: list[Any]) -> float:
    largest = []
    for point in points[:: max(1, len(points) // 500)]:
        centers = [model.images[e.image_id].projection_center() for e in point.track.elements]
        rays = np.array(centers) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        largest.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return float(np.median(largest)) if largest else 0.0


def _lens(camera: Any) -> Lens:
    """COLMAP's camera as ours; both measure from the corner of the picture."""
    v: dict[str, float] = dict(zip(camera.params_info.replace(" ", "").split(","), camera.params.tolist(), strict=True))
    across = v.get("fx", v.get("f", 0.0))
    return Lens(
        camera.width,
        camera.height,
        (across, v.get("fy", across)),
        (v["cx"], v["cy"]),
        (v.get("k1", v.get("k", 0.0)), v.get("k2", 0.0), 0.0),
        (v.get("p1", 0.0), v.get("p2", 0.0)),
    )
