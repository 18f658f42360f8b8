"""A job for COLMAP, and the features and matches of its frames."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  before pycolmap, see ``colmap``
import numpy as np
import pycolmap

from warpgs.data.colmap import PANORAMA
from warpgs.files import write_png

from ..frames.circle import circle_of
from .matches import Pair, cross_pairs, has_features, keep_static, sequence_pairs
from .recovered import NoCamerasError

MAX_FEATURES = 2048
"""Maximum number of features per frame, of which COLMAP keeps the coarsest; matching takes the square of its time. Of
120 frames of 960×540, the first pass took 116 s instead of 174 with 4,096, with 0.50 instead of 0.48 px."""

WEAK_PEAK = 0.002
"""Minimum contrast of weak features; COLMAP's default is 0.0067."""

MIN_FEATURES = 60
"""Minimum number of features per frame; with fewer, the frames lack texture."""

FISHEYE, FISHEYE_FOCAL = "OPENCV_FISHEYE", 0.5
"""The model of fisheye lenses, and the focal length over the longer side that it starts from: 115° across."""

CHUNK = 16
"""Number of frames whose features are extracted, or that are matched with others, between two reports."""

SEED = 0
"""Seed of everything that COLMAP draws. Without one of its own, what each of several threads draws depends on what it
did before, so on the order in which pairs of frames were taken."""

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
        cameras: Index of each frame's camera, ascending; empty if there is one. A camera of one frame stands still.
        times: Time of each frame on the clock of all cameras [ms].
        sources: Video of each camera, for messages. All three are needed for several cameras only.
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
    cameras: list[int] = field(default_factory=list)
    times: list[int] = field(default_factory=list)
    sources: list[str] = field(default_factory=list)

    @property
    def groups(self) -> list[list[int]]:
        """Indices of the frames of each camera."""
        if not self.cameras:
            return [[*range(len(self.names))]]
        return [[k for k, own in enumerate(self.cameras) if own == camera] for camera in sorted({*self.cameras})]

    @property
    def stands_still(self) -> bool:
        """Whether each of several cameras has one image: these have to tell everything."""
        return len(self.groups) == len(self.names) > 1

    @property
    def unmasked(self) -> set[str]:
        """Names of the images without anything that moves, which have no masks."""
        return {self.files[group[0]] for group in self.groups if len(group) == 1}

    @property
    def first_pairs(self) -> list[Pair]:
        """Pairs of frames to match before anything is known: along each sequence, and across the cameras."""
        along = [(group[a], group[b]) for group in self.groups for a, b in sequence_pairs(len(group))]
        return along + cross_pairs(self.groups, self.times)

    @property
    def database(self) -> Path:
        """Database of all features and matches."""
        return Path(self.work) / ("weak.db" if self.weak_features else "features.db")

    @property
    def sees_all(self) -> bool:
        """Whether the frames are panoramas."""
        return self.lens == PANORAMA

    @property
    def finds_focal(self) -> bool:
        """Whether the focal length is unknown."""
        return self.focal is None and self.params is None

    @property
    def guesses_focal(self) -> bool:
        """Whether the focal length is unknown and starts from that of a normal lens."""
        return self.finds_focal and self.lens != FISHEYE

    @property
    def files(self) -> list[str]:
        """Names of the images."""
        return [f"{name}.png" for name in self.names]


def extract_and_match(job: Job, report: Report) -> None:
    """Features and matches along the sequence, unless they are in the database.

    A few cameras that stand still, far apart, get features that bear other perspectives (affine shape, Mikolajczyk and
    Schmid 2004; domain-size pooling, Dong and Soatto 2015), and matches that fit the first ones. Of six cameras 17°
    apart, pairs of neighbours had 29 to 54 matches without them, 67 to 113 with them.
    """
    finished = job.database.with_suffix(".done")
    if finished.exists() and has_features(job.database, job.files, len(job.first_pairs)):
        return
    finished.unlink(missing_ok=True)
    for end in ("", "-wal", "-shm"):  # a new database cannot be made next to the log of another one
        Path(f"{job.database}{end}").unlink(missing_ok=True)
    pycolmap.Database.open(job.database).close()
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = MAX_FEATURES
    extraction.sift.max_num_orientations = 1
    extraction.sift.estimate_affine_shape = extraction.sift.domain_size_pooling = job.stands_still
    if job.weak_features or job.stands_still:
        extraction.sift.peak_threshold = WEAK_PEAK
    for camera, group in enumerate(job.groups, 1):
        _extract(job, camera, [job.files[k] for k in group], extraction, report)
    match(job, job.first_pairs, report)
    finished.touch()


def _extract(job: Job, camera: int, files: list[str], extraction: Any, report: Report) -> None:
    """Features of the images of a camera, which is the ``camera``-th in the database, from 1 on.

    Images get their numbers before: extraction would number them as its threads finish, in another order every time,
    and matches depend on which image of a pair is the first.
    """
    reading, single = pycolmap.ImageReaderOptions(), pycolmap.CameraMode.SINGLE
    reading.camera_model = job.lens
    if (params := _starting_parameters(job, files[0])) is not None:
        reading.camera_params = ",".join(map(str, params))
    if job.lens == FISHEYE and (circle := circle_of(Path(job.folder), [Path(file).stem for file in files])) is not None:
        reading.camera_mask_path = job.database.with_suffix(f".circle{camera}.png")
        write_png(reading.camera_mask_path, circle.astype(np.uint8) * 255)
    for start in range(0, len(files), CHUNK):
        report("features", job.files.index(files[start]), len(job.files))
        chunk = files[start : start + CHUNK]
        pycolmap.import_images(job.database, job.folder, single, chunk, reading)
        pycolmap.extract_features(job.database, job.folder, chunk, single, reading, extraction, pycolmap.Device.cpu)
        reading.existing_camera_id = camera


def _starting_parameters(job: Job, file: str) -> list[float] | None:
    """Parameters of the lens that are known, or that a fisheye lens starts from; None for COLMAP's own guess."""
    if job.params is not None or (job.focal is None and job.lens != FISHEYE):
        return job.params
    first = pycolmap.Bitmap.read(Path(job.folder) / file, False)
    focal = job.focal or FISHEYE_FOCAL * max(first.width, first.height)
    return list(pycolmap.Camera.create_from_model_name(1, job.lens, focal, first.width, first.height).params)


def match(job: Job, pairs: Sequence[tuple[int, int]], report: Report) -> None:
    """Matches the features of pairs of frames; those that are in the database already are skipped by COLMAP."""
    listed = job.database.with_suffix(".pairs.txt")
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = listed
    matching = pycolmap.FeatureMatchingOptions()
    matching.guided_matching = job.stands_still
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    step = max(1, len(pairs) * CHUNK // max(len(job.names), 1))
    for start in range(0, len(pairs), step):
        report("matches", start, len(pairs))
        lines = [f"{job.files[a]} {job.files[b]}\n" for a, b in pairs[start : start + step]]
        listed.write_text("".join(lines), "utf-8")
        pycolmap.match_image_pairs(job.database, matching, options, verification, pycolmap.Device.cpu)


def static_database(job: Job) -> Path:
    """A copy of the database with the matches in static regions of the job's frames."""
    database = job.database.with_suffix(".static.db")
    shutil.copyfile(job.database, database)
    counts = keep_static(database, None if job.masks is None else Path(job.masks), job.files, job.unmasked)
    for camera, group in enumerate(job.groups):
        features = sum(counts[k] for k in group) / len(group)
        if features >= MIN_FEATURES:
            continue
        of = f" of {job.sources[camera]}" if job.sources else ""
        where, remedy = "", "record textured objects, in more light"
        if job.masks is not None:
            where, remedy = " in static regions", f"{remedy}, or check the masks, in which 0 must mean dynamic"
        raise NoCamerasError(
            f"the frames{of} have hardly any texture{where}: {features:.0f} features per frame, at least "
            f"{MIN_FEATURES} are needed; {remedy}"
        )
    return database
