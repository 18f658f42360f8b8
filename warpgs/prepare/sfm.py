"""Structure from motion with COLMAP (pycolmap): cameras and sparse points of a video's frames.

SIFT features in static regions, matching, incremental mapping with bundle adjustment; one lens for all frames.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  pycolmap before OpenCV breaks OpenCV's PNG files: both bring a zlib (seen with 5.0 and 4.2)
import numpy as np
import pycolmap

from warpgs.data.lens import Lens

from .cameras import Cameras
from .options import LensModel

EXHAUSTIVE_FRAMES = 100
"""Number of frames up to which all pairs are matched; in longer sequences, each with the next and some later ones."""

FALLBACK_FRAMES = 250
"""Number of frames up to which all pairs are matched if matching along the sequence has lost some frames."""

OVERLAP = 10
"""Number of next frames that each frame is matched with, in addition to those at powers of two."""

MAX_FEATURES = 4096
"""Maximum number of features per frame; the time for matching grows with its square."""

WEAK_PEAK = 0.002
"""Minimum contrast of weak features; COLMAP's default is 0.0067."""

MIN_FEATURES = 60
"""Minimum number of features per frame; with fewer, the frames lack texture."""

MIN_REGISTERED = 0.5
"""Minimum fraction of the frames that get a camera."""

MIN_ANGLE = 1.0
"""Minimum of the median triangulation angle [degrees]; with less, depth is undetermined."""

MIN_POINTS = 100
"""Minimum number of points; a camera that only rotates gives some by chance."""

MAX_ERROR = 2.0
"""Maximum mean reprojection error of a point [px]; others are omitted."""


class NoCamerasError(ValueError):
    """The cameras cannot be recovered from the frames."""


@dataclass(frozen=True)
class Settings:
    """How to recover cameras.

    Attributes:
        lens: COLMAP's lens model.
        masks: Folder of masks <name>.png.png; features are extracted where they are not 0.
        thorough: Whether to match all pairs of up to ``EXHAUSTIVE_FRAMES`` frames, not only along the sequence.
        weak_features: Whether to use features of low contrast too: more on plain surfaces, but less exact.
    """

    lens: LensModel = "SIMPLE_RADIAL"
    masks: Path | None = None
    thorough: bool = True
    weak_features: bool = False


def recover_cameras(folder: Path, names: list[str], work: Path, settings: Settings) -> Cameras:
    """The cameras of the frames <folder>/<name>.png.

    Args:
        folder: Folder of the frames.
        names: Names of the frames.
        work: Folder for COLMAP's files, emptied before and removed afterwards.
        settings: How to recover cameras.

    Raises:
        NoCamerasError: If the frames are not suitable; the message says why and what to try.
        ValueError: If COLMAP itself failed.
    """
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 4  # errors are raised as exceptions
    try:
        _extract(folder, names, work, settings)
        best = _largest(folder, len(names), work, settings.thorough)
    except (RuntimeError, IndexError) as error:
        raise ValueError(f"COLMAP failed on {folder}: {error}") from error
    finally:
        pycolmap.logging.minloglevel = level
        shutil.rmtree(work, ignore_errors=True)
    if best is None:
        raise NoCamerasError(
            "no two frames show enough of the same static surfaces from different positions: move the camera sideways, "
            "slower and past textured objects, or take frames closer in time (--fps, --count)"
        )
    return _cameras(best, names, settings.weak_features)


def _extract(folder: Path, names: list[str], work: Path, settings: Settings) -> None:
    reading, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reading.camera_model = settings.lens
    if settings.masks is not None:
        reading.mask_path = settings.masks
    extraction.sift.max_num_features = MAX_FEATURES
    if settings.weak_features:
        extraction.sift.peak_threshold = WEAK_PEAK
    files = [f"{name}.png" for name in names]
    database, one_lens = work / "database.db", pycolmap.CameraMode.SINGLE
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(database, folder, files, one_lens, reading, extraction, pycolmap.Device.cpu)
    _check_features(database, len(names))


def _largest(folder: Path, count: int, work: Path, thorough: bool) -> Any:
    """The reconstruction with the most frames; None if there is none."""
    exhaustive = thorough and count <= EXHAUSTIVE_FRAMES
    best = _reconstruct(folder, work, "first", exhaustive)
    few = best is None or best.num_reg_images() < 0.9 * count
    if few and not exhaustive and count <= FALLBACK_FRAMES:
        again = _reconstruct(folder, work, "again", True)
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
            f"the frames have hardly any texture in static regions: {features:.0f} features per frame, at least "
            f"{MIN_FEATURES} are needed; record textured objects, in more light, or check the masks"
        )


def _reconstruct(folder: Path, work: Path, name: str, exhaustive: bool) -> Any:
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


def _cameras(model: Any, names: list[str], weak_features: bool) -> Cameras:
    images = sorted((i for i in model.images.values() if i.has_pose), key=lambda i: i.name)
    if len(images) < max(MIN_REGISTERED * len(names), 3):
        raise NoCamerasError(
            f"cameras were found for only {len(images)} of {len(names)} frames: too much moves, the camera moves too "
            "fast, or the frames have too little texture; try more frames (--fps, --count), a slower part of the "
            "video, or masks of what moves (--masks FOLDER)"
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
        weak_features,
    )
    if found.angle < MIN_ANGLE or len(points) < MIN_POINTS:
        raise NoCamerasError(
            f"the camera hardly moves: {len(points)} points at a median triangulation angle of {found.angle:.1f}° were "
            f"found; at least {MIN_POINTS} and {MIN_ANGLE}° are needed; walk around the scene instead of turning on "
            "the spot"
        )
    return found


def _angle(model: Any, points: list[Any]) -> float:
    """Median triangulation angle of some points [degrees]: the largest angle between two rays to a point."""
    largest = []
    for point in points[:: max(1, len(points) // 500)]:
        centers = [model.images[e.image_id].projection_center() for e in point.track.elements]
        rays = np.array(centers) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        largest.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return float(np.median(largest)) if largest else 0.0


def _lens(camera: Any) -> Lens:
    """COLMAP's camera as a lens; both measure from the corner of the image."""
    v: dict[str, float] = dict(zip(camera.params_info.replace(" ", "").split(","), camera.params.tolist(), strict=True))
    focal = v.get("fx", v.get("f", 0.0))
    return Lens(
        camera.width,
        camera.height,
        (focal, v.get("fy", focal)),
        (v["cx"], v["cy"]),
        (v.get("k1", v.get("k", 0.0)), v.get("k2", 0.0), 0.0),
        (v.get("p1", 0.0), v.get("p2", 0.0)),
    )
