"""COLMAP's mapping: from the matches in static regions to a reconstruction, and its refinement."""

import copy
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see ``colmap``
import numpy as np
import pycolmap

from warpgs.data.colmap import PANORAMA

from .features import SEED, Job, Report, match, static_database
from .focal_guess import calibrated, confirms, focal_of, is_plausible, read_focals
from .matches import all_pairs, revisit_pairs

FALLBACK_FRAMES = 250
"""Number of frames up to which all pairs are matched if matching along the sequence has lost some frames."""

ENOUGH = 0.9
"""Fraction of the frames with cameras below which another way to find them is tried."""

GLOBAL_TRACKS = 500
"""Tracks per frame that global mapping starts from, the longest; of 50 frames of 480×270 with 2,250 features each it
places as many as from all tracks, in 28 instead of 71 s of processor time. From 200, it fails with little parallax."""

MIN_OBSERVED = 30
"""Number of points that a frame must see to have a camera, as in incremental mapping."""

MAX_DEPTH_RATIO = 3.0
"""Maximum ratio of the median depths of the points that two consecutive frames see. Of 34 reconstructions of DAVIS's
clips whose cameras are right it is 1.4 at most, with every fourth frame 1.8; where the scale breaks, 6 to 10⁷."""

MAX_SKIPPED = 2
"""Maximum number of consecutive frames with a scale of their own between frames of one scale."""

MIN_PARALLEL = 1_000
"""Number of residuals from which on bundle adjustment uses all cores; COLMAP's 50,000 leave most videos to one."""

FIRST_OF_FEW, NEXT_OF_FEW = 40, 15
"""Number of matches that the first two of a few images must have, and each other one with the points that are known;
COLMAP's 100 and 30 leave cameras out that see little in common."""

TOLERANCE = 1e-6
"""Relative change of the cost at which the last bundle adjustment ends. With COLMAP's default, 0, it goes on for 100
iterations: 86 frames of 512×384 took 2.2 s instead of 0.5 s, with the same reprojection error and camera centres."""

LOSS_SCALE = 1.0
"""Error from which on Huber's loss counts an observation linearly [px], as in COLMAP's global mapping. By least
squares, matches that are slightly wrong pull the cameras."""

MAX_ERROR, MIN_TRIANGULATION_ANGLE = 4.0, 1.5
"""Limits for the points that are kept [px, degrees]; incremental mapping has the same."""

MIN_ADJUSTED_ANGLE = 0.3
"""Minimum triangulation angle of the points that refine the cameras [degrees]: far points tell how they are turned."""


def reconstruct(job: Job, database: Path, report: Report) -> tuple[Any, Job]:
    """The reconstruction, or None, and the job with the focal length that was held, if one was.

    Where the frames hardly tell the focal length, bundle adjustment may end anywhere. If that is implausible, they are
    mapped again with COLMAP's guess held, and the reconstruction that explains more is kept: some lenses are long.
    """
    model = _map(job, database, report)
    if model is None or not job.guesses_focal or len(job.groups) > 1 or is_plausible(model):
        return model, job
    held = replace(job, focal=read_focals(database)[0])
    return max(((_map(held, database, report), held), (model, job)), key=lambda found: explained(found[0]))


def explained(model: Any) -> float:
    """How much of the matches a reconstruction explains: MSAC's score (Torr and Zisserman 2000) of its observations."""
    points = () if model is None else model.points3D.values()
    return sum(point.track.length() * max(MAX_ERROR**2 - point.error**2, 0.0) for point in points)


def _map(job: Job, database: Path, report: Report) -> Any:
    """The reconstruction with the most frames, by global, else incremental mapping, else with all pairs; or None."""
    count, attempts = len(job.names), [_map_globally(job, database, report)]
    if not _is_enough(job, attempts[0]):
        attempts.append(_map_incrementally(job, database, report))
        if count <= FALLBACK_FRAMES and not any(_is_enough(job, model) for model in attempts):
            match(job, all_pairs(count), report)
            attempts.append(_map_incrementally(job, static_database(job), report))
    return max(attempts, key=lambda model: (_num_cameras(model), _size(model)))


def _is_enough(job: Job, model: Any) -> bool:
    """Whether nearly all frames, and some of each camera, are placed."""
    return _size(model) >= ENOUGH * len(job.names) and (len(job.groups) == 1 or _num_cameras(model) == len(job.groups))


def _num_cameras(model: Any) -> int:
    placed = () if model is None else model.images.values()
    return len({image.camera_id for image in placed if image.has_pose})


def _size(model: Any) -> int:
    return 0 if model is None else int(model.num_reg_images())


def _pipeline_options(job: Job) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.random_seed = SEED
    options.ba_refine_focal_length = job.finds_focal
    options.ba_refine_extra_params = job.params is None
    if job.stands_still:
        options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = FIRST_OF_FEW, NEXT_OF_FEW
    return options


def _map_globally(job: Job, database: Path, report: Report) -> Any:
    report("cameras", 0, len(job.names))
    start = calibrated(database) if job.guesses_focal else database
    model = _map_from(job, start)
    if start == database:
        return model
    is_confirmed = _is_enough(job, model) and confirms(model, start)
    start.unlink()  # a copy
    if is_confirmed:
        return model
    return max(model, _map_from(job, database), key=explained)


def _map_from(job: Job, database: Path) -> Any:
    """The reconstruction by global mapping that starts from the database's focal length."""
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = SEED
    options.mapper.track_required_tracks_per_view = GLOBAL_TRACKS
    options.mapper.ba_skip_fixed_rotation_stage = True  # saves a stage; camera centres as before
    _set_adjustment(options.mapper.bundle_adjustment, job)
    try:
        models = pycolmap.global_mapping(database, job.folder, _empty(job, "mapping"), options)
    except (RuntimeError, ValueError):  # it raises if it finds no geometry
        return None
    return max((continuous(_supported(model)) for model in models.values()), key=_size, default=None)


def _set_adjustment(adjustment: Any, job: Job) -> None:
    """What bundle adjustment refines, and from which size on it uses all cores."""
    adjustment.refine_focal_length = job.finds_focal
    adjustment.refine_extra_params = job.params is None
    adjustment.ceres.min_num_residuals_for_cpu_multi_threading = MIN_PARALLEL


def _supported(model: Any) -> Any:
    """The reconstruction without frames that see too few of its points: global mapping places every frame."""
    for image in [*model.images.values()]:
        if image.has_pose and image.num_points3D < MIN_OBSERVED:
            model.deregister_frame(image.frame_id)
    return model


def continuous(model: Any) -> Any:
    """The reconstruction without frames that have a scale of their own; each camera's longest sequence of one remains.

    Frames that share few points with those before them, or hardly move, may end anywhere on the rays to these points.
    At most ``MAX_SKIPPED`` of them in a row are skipped; more end a sequence, because what comes after them hangs on
    them. Frames that see no point, such as those that are masked as a whole, are removed, too, but do not end it.
    """
    placed = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    images = [image for image in placed if any(point.has_point3D() for point in image.points2D)]
    kept = set()
    for camera in {image.camera_id for image in images}:
        own = [image for image in images if image.camera_id == camera]
        sequence = _longest_sequence([float(np.log(_median_depth(model, image))) for image in own])
        kept |= {own[k].image_id for k in sequence}
    for image in placed:
        if image.image_id not in kept:
            model.deregister_frame(image.frame_id)
    return model


def _longest_sequence(log_depths: list[float]) -> list[int]:
    """Indices of the frames of the longest sequence of one scale, see ``continuous``; the first one if several are."""
    sequences: list[list[int]] = []  # the longest one that ends in each frame
    for k, depth in enumerate(log_depths):
        before = sequences[max(0, k - MAX_SKIPPED - 1) : k]
        fitting = [s for s in before if s and abs(log_depths[s[-1]] - depth) <= math.log(MAX_DEPTH_RATIO)]
        sequences.append([] if math.isnan(depth) else [*max(fitting, key=len, default=[]), k])
    return max(sequences, key=len, default=[])


def _median_depth(model: Any, image: Any) -> float:
    """Median depth of the points that a frame sees, of a panorama their distance; NaN if most are behind it."""
    seen = [model.points3D[point.point3D_id].xyz for point in image.points2D if point.has_point3D()]
    if image.camera.model.name == PANORAMA:
        return float(np.median(np.linalg.norm(np.array(seen) - image.projection_center(), axis=1)))
    pose = image.cam_from_world().matrix()
    depth = float(np.median(np.array(seen) @ pose[2, :3] + pose[2, 3]))
    return depth if depth > 0.0 else math.nan


def _map_incrementally(job: Job, database: Path, report: Report) -> Any:
    placed = [1]

    def count() -> None:
        placed[0] = min(placed[0] + 1, len(job.names))  # a second reconstruction counts from there
        report("cameras, by incremental mapping", placed[0], len(job.names))

    report("cameras, by incremental mapping", 0, len(job.names))
    models = pycolmap.incremental_mapping(
        database, job.folder, _empty(job, "mapping"), _pipeline_options(job), next_image_callback=count
    )
    return max(map(continuous, models.values()), key=_size, default=None)


def refine(job: Job, model: Any, report: Report) -> Any:
    """The reconstruction with points triangulated again from static matches, revisits included, and adjusted.

    A plausible focal length that adjustment makes implausible is held instead.
    """
    if job.thorough:
        match(job, revisit_pairs(model, job.files, job.groups, job.sees_all), report)
    report("refinement", 0, 1)
    refined = _adjusted(job, copy.deepcopy(model))
    if job.guesses_focal and len(job.groups) == 1 and is_plausible(model) and not is_plausible(refined):
        refined = _adjusted(replace(job, focal=focal_of(model)), model)
    return continuous(refined)


def _adjusted(job: Job, model: Any) -> Any:
    """The reconstruction, which is changed, with points from static matches after bundle adjustment.

    Cameras that were wrong at first see few of their points; so these are triangulated twice.
    """
    options, database = _pipeline_options(job), static_database(job)
    options.triangulation.min_angle = options.mapper.filter_min_tri_angle = MIN_ADJUSTED_ANGLE
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.solver_options.function_tolerance = TOLERANCE
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.HUBER
    adjustment.ceres.loss_function_scale = LOSS_SCALE
    _set_adjustment(adjustment, job)
    for _ in range(2):
        folder = _empty(job, "refinement")
        model = pycolmap.triangulate_points(model, database, job.folder, folder, clear_points=True, options=options)
        pycolmap.bundle_adjustment(model, adjustment)
        model.normalize()  # adjustment keeps the distance of two cameras, however wrong it was
    pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR, MIN_TRIANGULATION_ANGLE)
    return model


def _empty(job: Job, name: str) -> Path:
    folder = Path(job.work) / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder
