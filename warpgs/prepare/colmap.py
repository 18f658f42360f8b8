"""Runs COLMAP (pycolmap) in a process of its own: features, matches, mapping, refinement. ``sfm`` starts it.

The process reads a job as one line of JSON, and ends when its input ends. It writes lines of JSON: progress
(``label``, ``done``, ``total``), and at last an ``error`` or the ``result``. Features and matches stay in the work
folder, so that they are computed once, whatever is masked later.
"""

import json
import os
import shutil
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  pycolmap before OpenCV breaks OpenCV's PNG files: both bring a zlib (seen with 5.0 and 4.2)
import numpy as np
import pycolmap
from jaxtyping import Float

from warpgs.data.colmap import lens_of_parameters
from warpgs.data.lens import Lens
from warpgs.data.turning import find_turning

from .cameras import MISLED, Cameras, NoCamerasError
from .focal_guess import calibrated, confirms
from .matches import all_pairs, has_features, keep_static, revisit_pairs, sequence_pairs, verified_matches
from .model import cameras_of_model, read_model
from .rotations import find_directions

FALLBACK_FRAMES = 250
"""Number of frames up to which all pairs are matched if matching along the sequence has lost some frames."""

MAX_FEATURES = 2048
"""Maximum number of features per frame, of which COLMAP keeps the coarsest; matching takes the square of its time. Of
120 frames of 960×540, the first pass took 116 s instead of 174 with 4,096, with 0.50 instead of 0.48 px."""

WEAK_PEAK = 0.002
"""Minimum contrast of weak features; COLMAP's default is 0.0067."""

MIN_FEATURES = 60
"""Minimum number of features per frame; with fewer, the frames lack texture."""

ENOUGH = 0.9
"""Fraction of the frames with cameras below which another way to find them is tried."""

FISHEYE, FISHEYE_FOCAL = "OPENCV_FISHEYE", 0.5
"""The model of fisheye lenses, and the focal length over the longer side that it starts from: 115° across."""

CHUNK = 16
"""Number of frames whose features are extracted, or that are matched with others, between two reports."""

GLOBAL_TRACKS = 500
"""Tracks per frame that global mapping starts from, the longest; of 50 frames of 480×270 with 2,250 features each it
places as many as from all tracks, in 28 instead of 71 s of processor time. From 200, it fails with little parallax."""

MIN_OBSERVED = 30
"""Number of points that a frame must see to have a camera, as in incremental mapping."""

MIN_PARALLEL = 1_000
"""Number of residuals from which on bundle adjustment uses all cores; COLMAP's 50,000 leave most videos to one."""

TOLERANCE = 1e-6
"""Relative change of the cost at which the last bundle adjustment ends. With COLMAP's default, 0, it goes on for 100
iterations: 86 frames of 512×384 took 2.2 s instead of 0.5 s, with the same reprojection error and camera centres."""

MAX_ERROR, MIN_TRIANGULATION_ANGLE = 4.0, 1.5
"""Limits for the points that are kept while cameras are refined [px, degrees]; incremental mapping has the same."""

Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Job:
    """What to do.

    Attributes:
        folder: Folder of the frames <name>.png.
        names: Names of the frames.
        work: Folder for the database and the reconstruction.
        lens: COLMAP's lens model.
        params: Its known parameters, which are kept; None to find them.
        turns: Whether the camera only turns.
        masks: Folder of masks <name>.png.png, 0 = dynamic.
        thorough: Whether to match frames far apart in time that see the same points, and to refine with them.
        weak_features: Whether to use features of low contrast.
        focal: Known focal length [px], which is kept; None to find it.
        refine: Whether to refine the reconstruction in the work folder instead of mapping from nothing, unless that
            shows that it was misled.
    """

    folder: str
    names: list[str]
    work: str
    lens: str
    masks: str | None
    thorough: bool
    weak_features: bool
    focal: float | None
    refine: bool
    params: list[float] | None = None
    turns: bool = False

    @property
    def database(self) -> Path:
        """Database of all features and matches."""
        return Path(self.work) / ("weak.db" if self.weak_features else "features.db")

    @property
    def finds_focal(self) -> bool:
        """Whether the focal length is unknown."""
        return self.focal is None and self.params is None

    @property
    def files(self) -> list[str]:
        """Names of the images."""
        return [f"{name}.png" for name in self.names]


def run(job: Job, report: Report) -> Cameras:
    """The cameras of the frames.

    Raises:
        NoCamerasError: If the frames are not suitable; the message says why and what to try.
    """
    work = Path(job.work)
    pycolmap.set_random_seed(0)
    _extract_and_match(job, report)
    database = _static_database(job)
    if job.turns:
        report("directions", 0, 1)
        return _find_directions(job, database)
    model_folder = work / "model"
    model = read_model(model_folder) if job.refine else None
    if model is not None:
        error = model.compute_mean_reprojection_error()
        model = _refine(job, model, report)
        if model.compute_mean_reprojection_error() < MISLED * error:
            model = None  # dynamic objects had misled the cameras: refined, they stay near what they were
    if model is None:
        _check_parallax(job, database)
        model = _map(job, database, report)
        if model is not None and job.thorough:
            model = _refine(job, model, report)
    if model is None:
        raise NoCamerasError(
            "no two frames show enough of the same static surfaces from different positions: move the camera sideways, "
            "slower and past textured objects, or take frames closer in time (--fps, --count)"
        )
    if not job.refine:
        model_folder.mkdir(exist_ok=True)
        model.write(model_folder)
    return cameras_of_model(model, job.names, job.weak_features)


def _extract_and_match(job: Job, report: Report) -> None:
    """Features and matches along the sequence, unless they are in the database."""
    finished = job.database.with_suffix(".done")
    if finished.exists() and has_features(job.database, job.files):
        return
    finished.unlink(missing_ok=True)
    job.database.unlink(missing_ok=True)
    reading, extraction = pycolmap.ImageReaderOptions(), pycolmap.FeatureExtractionOptions()
    reading.camera_model = job.lens
    if (params := _starting_parameters(job)) is not None:
        reading.camera_params = ",".join(map(str, params))
    extraction.sift.max_num_features = MAX_FEATURES
    extraction.sift.max_num_orientations = 1
    if job.weak_features:
        extraction.sift.peak_threshold = WEAK_PEAK
    files, single = job.files, pycolmap.CameraMode.SINGLE
    for start in range(0, len(files), CHUNK):
        report("features", start, len(files))
        chunk = files[start : start + CHUNK]
        pycolmap.extract_features(job.database, job.folder, chunk, single, reading, extraction, pycolmap.Device.cpu)
        reading.existing_camera_id = 1
    _match(job, sequence_pairs(len(files)), report)
    finished.touch()


def _starting_parameters(job: Job) -> list[float] | None:
    """Parameters of the lens that are known, or that a fisheye lens starts from; None for COLMAP's own guess."""
    if job.params is not None or (job.focal is None and job.lens != FISHEYE):
        return job.params
    first = pycolmap.Bitmap.read(Path(job.folder) / job.files[0], False)
    focal = job.focal or FISHEYE_FOCAL * max(first.width, first.height)
    return list(pycolmap.Camera.create_from_model_name(1, job.lens, focal, first.width, first.height).params)


def _match(job: Job, pairs: Sequence[tuple[int, int]], report: Report) -> None:
    """Matches the features of pairs of frames; those that are in the database already are skipped by COLMAP."""
    listed = job.database.with_suffix(".pairs.txt")
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = listed
    step = max(1, len(pairs) * CHUNK // max(len(job.names), 1))
    for start in range(0, len(pairs), step):
        report("matches", start, len(pairs))
        lines = [f"{job.files[a]} {job.files[b]}\n" for a, b in pairs[start : start + step]]
        listed.write_text("".join(lines), "utf-8")
        pycolmap.match_image_pairs(job.database, pairing_options=options, device=pycolmap.Device.cpu)


def _static_database(job: Job) -> Path:
    """A copy of the database with the matches in static regions of the job's frames."""
    database = job.database.with_suffix(".static.db")
    shutil.copyfile(job.database, database)
    features = keep_static(database, None if job.masks is None else Path(job.masks), job.files)
    if features < MIN_FEATURES:
        raise NoCamerasError(
            f"the frames have hardly any texture in static regions: {features:.0f} features per frame, at least "
            f"{MIN_FEATURES} are needed; record textured objects, in more light, or check the masks"
        )
    return database


def _check_parallax(job: Job, database: Path) -> None:
    matches, size = verified_matches(database)
    pairs, focal = [*matches.values()], job.focal
    if job.params is not None:
        lens = lens_of_parameters(job.lens, size, job.params)
        pairs, focal = [(_undistorted(a, lens), _undistorted(b, lens)) for a, b in pairs], lens.focal[0]
    turning = find_turning(pairs, size, focal)
    if turning is None:
        return
    if turning.stands_still:
        raise NoCamerasError(
            f"the camera stands still: static surfaces move by {turning.displacement:.1%} of the image at most; depth "
            "is undetermined; move the camera sideways, or find masks alone with --camera still"
        )
    if turning.only_turns:
        # Before a plane, moving sideways looks like turning with a long focal length.
        known = "; if it does move, past a wall or over flat ground, give its focal length: --focal PX"
        raise NoCamerasError(
            f"the camera only turns: a rotation explains {turning.explained:.0%} of the matches between frames, so "
            "depth is undetermined; walk around the scene or move the camera sideways instead of turning on the spot"
            + (known if job.finds_focal else "")
            + "; masks alone are found with --camera turning"
        )


def _undistorted(positions: Float[np.ndarray, "M 2"], lens: Lens) -> Float[np.ndarray, "M 2"]:
    """Positions as a pinhole camera with the lens' focal length and its axis in the middle sees them."""
    rays = np.stack(lens.unproject(positions[:, 0], positions[:, 1]), 1)
    return lens.focal[0] * rays + np.array([lens.width, lens.height]) / 2.0


def _find_directions(job: Job, database: Path) -> Cameras:
    """The cameras of a camera that only turns."""
    matches, (width, height) = verified_matches(database)
    index = {file: k for k, file in enumerate(job.files)}
    pairs = {(index[a], index[b]): m for (a, b), m in matches.items() if a in index and b in index}
    focal = job.focal or 1.0  # found unless it is known
    lens = Lens(width, height, (focal, focal), (width / 2.0, height / 2.0))
    if job.params is not None:
        lens = lens_of_parameters(job.lens, (width, height), job.params)
    finds_distortion = job.params is None and "PINHOLE" not in job.lens
    return find_directions(job.names, pairs, lens, finds_focal=job.finds_focal, finds_distortion=finds_distortion)


def _map(job: Job, database: Path, report: Report) -> Any:
    """The reconstruction with the most frames, by global, else incremental mapping, else with all pairs; or None."""
    count, attempts = len(job.names), [_map_globally(job, database, report)]
    if _size(attempts[0]) < ENOUGH * count:
        attempts.append(_map_incrementally(job, database, report))
        if max(map(_size, attempts)) < ENOUGH * count <= ENOUGH * FALLBACK_FRAMES:
            _match(job, all_pairs(count), report)
            attempts.append(_map_incrementally(job, _static_database(job), report))
    return max(attempts, key=_size)


def _size(model: Any) -> int:
    return 0 if model is None else int(model.num_reg_images())


def _mapping_options(job: Job) -> Any:
    options = pycolmap.IncrementalPipelineOptions()
    options.extract_colors = False
    options.ba_refine_focal_length = job.finds_focal
    options.ba_refine_extra_params = job.params is None
    return options


def _map_globally(job: Job, database: Path, report: Report) -> Any:
    report("cameras", 0, len(job.names))
    start = calibrated(database) if job.finds_focal and job.lens != FISHEYE else database
    model = _map_from(job, start)
    if start == database:
        return model
    is_confirmed = _size(model) >= ENOUGH * len(job.names) and confirms(model, start)
    start.unlink()  # a copy
    if is_confirmed:
        return model
    found = [m for m in (model, _map_from(job, database)) if m is not None]
    return min(found, key=lambda m: (-_size(m), m.compute_mean_reprojection_error()), default=None)


def _map_from(job: Job, database: Path) -> Any:
    """The reconstruction by global mapping that starts from the database's focal length."""
    options = pycolmap.GlobalPipelineOptions()
    options.mapper.track_required_tracks_per_view = GLOBAL_TRACKS
    options.mapper.ba_skip_fixed_rotation_stage = True  # saves a stage; camera centres as before
    _set_adjustment(options.mapper.bundle_adjustment, job)
    try:
        models = pycolmap.global_mapping(database, job.folder, _empty(job, "mapping"), options)
    except (RuntimeError, ValueError):  # it raises if it finds no geometry
        return None
    model = max(models.values(), key=_size, default=None)
    return None if model is None else _supported(model)


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


def _map_incrementally(job: Job, database: Path, report: Report) -> Any:
    placed = [1]

    def count() -> None:
        placed[0] = min(placed[0] + 1, len(job.names))  # a second reconstruction counts from there
        report("cameras, by incremental mapping", placed[0], len(job.names))

    report("cameras, by incremental mapping", 0, len(job.names))
    models = pycolmap.incremental_mapping(
        database, job.folder, _empty(job, "mapping"), _mapping_options(job), next_image_callback=count
    )
    return max(models.values(), key=_size, default=None)


def _refine(job: Job, model: Any, report: Report) -> Any:
    """The reconstruction with points triangulated again from static matches, revisits included, and adjusted."""
    if job.thorough:
        _match(job, revisit_pairs(model, job.files), report)
    report("refinement", 0, 1)
    options = _mapping_options(job)
    model = pycolmap.triangulate_points(
        model, _static_database(job), job.folder, _empty(job, "refinement"), clear_points=True, options=options
    )
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.print_summary = False
    adjustment.ceres.solver_options.function_tolerance = TOLERANCE
    _set_adjustment(adjustment, job)
    for _ in range(2):
        pycolmap.bundle_adjustment(model, adjustment)
        pycolmap.ObservationManager(model).filter_all_points3D(MAX_ERROR, MIN_TRIANGULATION_ANGLE)
    model.normalize()  # adjustment keeps the distance of two cameras, however wrong it was
    return model


def _empty(job: Job, name: str) -> Path:
    folder = Path(job.work) / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def main() -> None:
    """Does the job on the standard input; ends when the input ends, because then the parent process has ended."""
    job = Job(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_end_with_input, daemon=True).start()
    pycolmap.logging.minloglevel = 4  # errors are raised as exceptions
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # warnings that OpenBLAS prints are not answers

    def write(**fields: Any) -> None:
        print(json.dumps(fields), file=answers, flush=True)

    try:
        cameras = run(job, lambda label, done, total: write(label=label, done=done, total=total))
        cameras.save(Path(job.work) / "cameras")
    except NoCamerasError as error:
        write(error=str(error), unsuitable=True)
    except (RuntimeError, IndexError, ValueError, OSError) as error:
        write(error=str(error), unsuitable=False)
    else:
        write(result="cameras")


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
