"""``warpgs export``: writes a trained scene for other programs."""

import dataclasses
import math

from warpgs.data.capture import background_color
from warpgs.errors import not_one_of
from warpgs.runs.opening import open_scene
from warpgs.runs.run import Run
from warpgs.runs.scene_file import SceneFile, SceneSequence
from warpgs.runs.trained import TrainedScene
from warpgs.video.camera_paths import MAX_FRAMES

from .camera_writers import CAMERA_FORMATS, CameraSet, write_cameras
from .job import Job, Writer
from .moving import SECONDS
from .options import Export
from .page import MAX_KEYS
from .share import check_url
from .writers import WRITERS

COUNTS = {"frames": MAX_FRAMES, "keys": MAX_KEYS}
"""Options that are counts, and their maxima."""

REFLECTIONS_NOTE = "no format holds reflections: dynamic Gaussians have the colours of their spherical harmonics alone"
"""A line about scenes of ``model.reflections``."""

SKY_NOTE = "--format {} holds no sky, which was behind the Gaussians in training: only {} do"
"""A line about scenes under a sky."""

POSITIVE = ("seconds", "max_megabytes", "precision", "voxel")
"""Options that are positive numbers."""


def export_run(options: Export) -> str:
    """Exports a run as the options say; returns a summary to print.

    Raises:
        ValueError: If the run or an option cannot be used, or a page would be too large.
        OSError: If a file cannot be written.
    """
    _check_format(options)
    _check_out(options)
    _check_values(options)
    run = open_scene(options.run_folder, "cpu", options.data)
    writer = WRITERS[options.format]
    job = Job(run, options, writer.has_objects)
    _check_sequence(job.clouds.scene, options)
    if job.clouds.scene.scene.dome is not None:
        job.notes += [] if writer.has_sky else [SKY_NOTE.format(options.format, _with_sky())]
    elif not writer.has_background and not isinstance(run, SceneFile):
        job.notes.append(_background_note(run))
    if job.clouds.scene.scene.light is not None:
        job.notes.append(REFLECTIONS_NOTE)
    cameras = [] if options.cameras is None else [_cameras(job, writer)]  # first: without a capture nothing is written
    return "\n".join([writer.write(job), *cameras, *job.notes])


def _cameras(job: Job, writer: Writer) -> str:
    """Writes the cameras next to the file of the scene; returns a summary."""
    options, folder = job.options, job.folder.parent if job.options.is_out_file(writer.suffix) else job.folder
    if job.capture is None:
        raise ValueError(f"--cameras needs the cameras of the capture: {job.capture_note.partition('because ')[2]}")
    cameras = CameraSet.of(job.capture, job.rotation(writer.y_up), options.seconds or SECONDS)
    return write_cameras(folder / "cameras", options.cameras or "", cameras)


def _background_note(run: Run) -> str:
    """A line about the colour behind everything, for files that do not have it."""
    color = "#" + "".join(f"{round(255 * value):02x}" for value in background_color(run.config.background))
    return f"behind the Gaussians was {color} in training: give the viewer this background, as gaps show it"


def _with_sky() -> str:
    return " and ".join(name for name, writer in WRITERS.items() if writer.has_sky)


def _check_format(options: Export) -> None:
    """Refuses an unknown format, and options that do not apply to the format."""
    if options.format not in WRITERS:
        raise ValueError(not_one_of("--format", options.format, WRITERS))
    if options.cameras is not None and options.cameras not in CAMERA_FORMATS:
        raise ValueError(not_one_of("--cameras", options.cameras, CAMERA_FORMATS))
    specific = {name for writer in WRITERS.values() for name in writer.options}
    specific -= {"seconds"} if options.cameras == "usd" else set()
    for field in dataclasses.fields(Export):
        if field.name not in specific or field.name in WRITERS[options.format].options:
            continue
        if getattr(options, field.name) != field.default:
            formats = ", ".join(name for name, writer in WRITERS.items() if field.name in writer.options)
            raise ValueError(f"{_flag(field.name)} is for --format {formats}, not for {options.format}")


def _check_out(options: Export) -> None:
    """Refuses a file as ``--out`` that is not of the format, or that is one for several.

    A new path with a suffix that begins with a letter, such as scene.gltf, is taken as a file; run.2 is a folder.
    """
    out, formats = options.out, [name for name, writer in WRITERS.items() if options.is_out_file(writer.suffix)]
    if not formats:
        if out is not None and out.suffix[1:2].isalpha() and not out.is_dir():
            known = ", ".join(dict.fromkeys(writer.suffix for writer in WRITERS.values() if writer.suffix))
            raise ValueError(
                f"--out {out}: no format has files that end with {out.suffix}, only {known}; to export into "
                "a folder of this name, create it first"
            )
        return
    if options.format not in formats:
        raise ValueError(f"--out {out} is a file of --format {' and '.join(formats)}, not of {options.format}")
    if options.frames is not None or options.layers == "apart":
        several = "--layers apart" if options.frames is None else "--frames"
        raise ValueError(f"{several} writes several files: --out must be a folder, not a file as {out}")


def _check_sequence(scene: TrainedScene, options: Export) -> None:
    """Refuses to write a file that moves of a sequence of files that have other Gaussians at other times."""
    moves = "frames" not in WRITERS[options.format].options
    if moves and isinstance(scene, SceneSequence) and not scene.has_same_gaussians():
        raise ValueError(f"--format {options.format} needs the same number of Gaussians in all files of a sequence")


def _check_values(options: Export) -> None:
    """Refuses values that are out of range."""
    if options.data is not None and not options.data.is_dir():
        raise ValueError(f"--data {options.data} is not a folder")
    if options.time is not None and options.frames is not None:
        raise ValueError("--frames are spread over all times: omit --time")
    if options.time is not None and not 0 <= options.time <= 1:
        raise ValueError(f"--time must be in [0, 1], got {options.time}")
    for name, maximum in COUNTS.items():
        value = getattr(options, name)
        if value is not None and not 1 <= value <= maximum:
            raise ValueError(f"{_flag(name)} must be between 1 and {maximum:,}, got {value}")
    for name in POSITIVE:
        value = getattr(options, name)
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{_flag(name)} must be positive, got {value}")
    if options.url is not None:
        check_url(options.url)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"
