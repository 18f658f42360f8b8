"""Runs COLMAP (pycolmap) in a process of its own: features, matches, mapping, refinement. ``sfm`` starts it.

The process reads a job as one line of JSON, and ends when its input ends. It writes lines of JSON: progress
(``label``, ``done``, ``total``), and at last an ``error`` or the ``result``. Features and matches stay in the work
folder, so that they are computed once, whatever is masked later.
"""

import json
import os
import sys
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2  # noqa: F401  pycolmap before OpenCV breaks OpenCV's PNG files: both bring a zlib (seen with 5.0 and 4.2)
import numpy as np
import pycolmap
from jaxtyping import Float

from warpgs.data.colmap import lens_of_parameters
from warpgs.data.lens import Lens
from warpgs.data.turning import find_turning

from .features import Job, Report, extract_and_match, static_database
from .mapping import reconstruct, refine
from .matches import verified_matches
from .model import cameras_of_model, read_model
from .recovered import MISLED, Cameras, NoCamerasError, save_all
from .rotations import find_directions


def run(job: Job, report: Report) -> list[Cameras]:
    """The frames of each camera, posed.

    Raises:
        NoCamerasError: If the frames are not suitable; the message says why and what to try.
    """
    work = Path(job.work)
    pycolmap.set_random_seed(0)
    extract_and_match(job, report)
    database = static_database(job)
    if job.turns:
        report("directions", 0, 1)
        return [_find_directions(job, database)]
    model_folder = work / "model"
    model = read_model(model_folder) if job.refine else None
    if model is not None:
        error = model.compute_mean_reprojection_error()
        model = refine(job, model, report)
        if model.compute_mean_reprojection_error() < MISLED * error:
            model = None  # dynamic objects had misled the cameras: refined, they stay near what they were
    done = job
    if model is None:
        if len(job.groups) == 1:
            _check_parallax(job, database)
        model, done = reconstruct(job, database, report)
        if model is not None and job.thorough:
            model = refine(done, model, report)
    if model is None:
        raise NoCamerasError(unmatched(len(job.groups)))
    if not job.refine:
        model_folder.mkdir(exist_ok=True)
        model.write(model_folder)
    groups = [[job.names[k] for k in group] for group in job.groups]
    found = cameras_of_model(model, groups, job.sources, job.weak_features)
    return [replace(camera, has_held_focal=done.focal != job.focal) for camera in found]


def unmatched(num_cameras: int) -> str:
    """Why frames have no cameras if no two of them match, and what to do."""
    advice = (
        "move the camera sideways, slower and past textured objects, or take frames closer in time (--fps, --count)"
        if num_cameras == 1
        else "put neighbouring cameras at most 20° apart, with texture in view, keep more pixels (--longest-side), or "
        "add a video that walks past what all of them see"
    )
    return f"no two frames show enough of the same static surfaces from different positions: {advice}"


def _check_parallax(job: Job, database: Path) -> None:
    matches, size = verified_matches(database)
    pairs, focal = [*matches.values()], job.focal
    if job.params is not None:
        lens = lens_of_parameters(job.lens, size, job.params)
        pairs = [_ahead(*pair, lens) for pair in pairs] if job.sees_all else pairs
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


def _ahead(
    first: Float[np.ndarray, "M 2"], second: Float[np.ndarray, "M 2"], lens: Lens
) -> tuple[Float[np.ndarray, "A 2"], Float[np.ndarray, "A 2"]]:
    """The matches that both frames see at most 60° from the axis, where a pinhole could, too."""
    kept = np.minimum(*(lens.unit_rays(positions)[:, 2] for positions in (first, second))) > 0.5
    return first[kept], second[kept]


def _undistorted(positions: Float[np.ndarray, "M 2"], lens: Lens) -> Float[np.ndarray, "M 2"]:
    """Positions as a pinhole camera with the lens' focal length and its axis in the middle sees them."""
    rays = np.stack(lens.unproject(positions[:, 0], positions[:, 1]), 1)
    return lens.focal[0] * rays + np.array([lens.width, lens.height]) / 2.0


def _find_directions(job: Job, database: Path) -> Cameras:
    """The cameras of a camera that only turns."""
    matches, size = verified_matches(database)
    index = {file: k for k, file in enumerate(job.files)}
    pairs = {(index[a], index[b]): m for (a, b), m in matches.items() if a in index and b in index}
    lens = Lens.centered(job.focal or 1.0, size)  # found unless it is known
    if job.params is not None:
        lens = lens_of_parameters(job.lens, size, job.params)
    finds_distortion = job.params is None and "PINHOLE" not in job.lens
    return find_directions(job.names, pairs, lens, finds_focal=job.finds_focal, finds_distortion=finds_distortion)


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
        save_all(cameras, Path(job.work) / "cameras")
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
