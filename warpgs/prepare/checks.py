"""Checks of the options before a preparation starts, and of the number of frames once they are taken."""

import math
from collections.abc import Sequence
from pathlib import Path

from warpgs.data.loaders import is_capture
from warpgs.data.writer import check_holdout, held_out
from warpgs.errors import command, not_one_of, similar_path, suggestion

from .cameras.intrinsics import read_intrinsics
from .depth.methods import DEPTHS
from .frames.offsets import check_offsets
from .frames.take import Frames, check_selection
from .masks.methods import MASKERS
from .options import MIN_FRAMES, Options
from .weights import find_weights

MIN_FOR_MOTION = 10
"""Minimum number of frames to find what moves; with fewer, some lack three far frames (``revisits``)."""


def check_options(sources: Sequence[Path], root: Path, options: Options) -> None:
    """Checks the options, that no source is a capture, and that the capture's folder does not contain what is read.

    Raises:
        ValueError: If a value is invalid, the source is a capture, or a folder or the weights of a network are missing.
        ImportError: If the package of a network is missing.
    """
    check_selection(options.selection)
    check_offsets(options.offsets, len(sources))
    if len(sources) > 1:
        _check_several(sources, options)
    if options.focal is not None and not 0.0 < options.focal < math.inf:
        raise ValueError(f"--focal must be positive, got {options.focal}")
    if options.intrinsics is not None:
        if options.focal is not None or options.lens != Options().lens:
            raise ValueError("--intrinsics says all about the lens: omit --focal and --lens")
        read_intrinsics(options.intrinsics)
    if options.camera != "moving" and options.lens != Options().lens:
        raise ValueError(
            f"--lens {options.lens} needs a camera that moves: with --camera {options.camera}, use --intrinsics"
        )
    if options.has_panoramas:
        _check_panoramas(sources, options)
    _check_evaluation(sources, options)
    if options.masks not in MASKERS and not Path(options.masks).is_dir():
        close = suggestion(options.masks, MASKERS) or similar_path(Path(options.masks))
        raise ValueError(
            f"--masks must be {', '.join(MASKERS)} or a folder of masks; {options.masks} is not a folder{close}"
        )
    if options.depth_method not in DEPTHS:
        raise ValueError(not_one_of("--depth", options.depth_method, DEPTHS))
    if options.camera != "moving" and options.depth == "flow":
        raise ValueError(
            f"--depth flow needs a camera that moves, with --camera {options.camera} there is no parallax: use --depth "
            "anything (a network) or none"
        )
    _check_networks(options)
    _check_paths(sources, root, options)


def _check_evaluation(sources: Sequence[Path], options: Options) -> None:
    check_holdout(options.holdout)
    if len({*find_videos([*map(str, sources)], options.holdout_camera)}) == len(sources):
        raise ValueError(f"--holdout-camera {' '.join(options.holdout_camera)} leaves no camera to train on")


def find_videos(sources: Sequence[str], names: Sequence[str]) -> list[int]:
    """Indices of the videos of these names: paths, names of files, or these without their ending.

    Args:
        sources: Paths of all videos.
        names: As ``Options.holdout_camera``.

    Raises:
        ValueError: If a name is of no video, or of several.
    """
    found = []
    for name in names:
        fitting = [k for k, source in enumerate(sources) if name in (source, Path(source).name, Path(source).stem)]
        if not fitting:
            raise ValueError(not_one_of("--holdout-camera", name, (Path(source).name for source in sources)))
        if len(fitting) > 1:
            paths = " or ".join(sources[k] for k in fitting)
            raise ValueError(f"--holdout-camera {name} may be {paths}: give its path")
        found += fitting
    return found


def _check_panoramas(sources: Sequence[Path], options: Options) -> None:
    if len(sources) > 1:
        raise ValueError("--lens EQUIRECTANGULAR is for one video: several cameras must be perspective or fisheye ones")
    if options.focal is not None:
        raise ValueError("--lens EQUIRECTANGULAR says all about the lens: omit --focal")
    if options.depth_method == "anything":
        raise ValueError("--depth anything knows no panoramas: use --depth flow or none")


def _check_several(sources: Sequence[Path], options: Options) -> None:
    if options.camera != "moving":
        raise ValueError(f"--camera {options.camera} is for one video: of several, each may move or stand still")
    seen: set[Path] = set()
    for source in sources:
        if source.is_dir():
            raise ValueError(f"{source} is a folder: several sources must be videos, whose times are known")
        if not source.exists():
            raise ValueError(f"{source} is missing: expected a video{similar_path(source)}")
        if source.resolve() in seen:
            raise ValueError(f"{source} is given twice")
        seen.add(source.resolve())


def _check_paths(sources: Sequence[Path], root: Path, options: Options) -> None:
    if root.exists() and not root.is_dir():
        raise ValueError(f"{root} is a file: choose another folder")
    if is_capture(sources[0]):
        raise ValueError(
            f"{sources[0]} is a capture: {command('train', '--data', sources[0])} trains on it; prepare needs a video "
            "or a folder of images alone"
        )
    inputs = [("source", source) for source in sources]
    inputs += [("masks", Path(options.masks))] if options.masks not in MASKERS else []
    inputs += [("intrinsics", options.intrinsics)] if options.intrinsics is not None else []
    inputs += [("weights", options.weights)] if options.weights is not None else []
    for name, path in inputs:
        if root.resolve() in (path.resolve(), *path.resolve().parents):
            raise ValueError(f"{root} contains the {name} {path}: choose a separate folder for the capture")


def _check_networks(options: Options) -> None:
    methods = MASKERS.get(options.masks), DEPTHS[options.depth_method]
    networks = [method.network for method in methods if method is not None and method.network is not None]
    if options.weights is not None and not networks:
        known = [method.network.option for method in (*MASKERS.values(), *DEPTHS.values()) if method and method.network]
        raise ValueError(f"--weights is for {' and '.join(known)}: neither is used")
    for network in networks:
        find_weights(network, options.weights)


def needed_frames(options: Options) -> int:
    """Number of frames that each video must give."""
    return MIN_FRAMES if MASKERS.get(options.masks) is None else MIN_FOR_MOTION


def check_frames(videos: Sequence[Frames], options: Options) -> None:
    """Checks that the options are possible with the frames of some videos.

    Raises:
        ValueError: If one has too few frames, or several of other sizes have one lens.
    """
    if len({(video.width, video.height, video.factor) for video in videos}) > 1 and (
        options.focal is not None or options.intrinsics is not None
    ):
        raise ValueError("--focal and --intrinsics are of all videos, which have several sizes: omit them")
    held_out_videos = find_videos([video.source for video in videos], options.holdout_camera)
    for k, video in enumerate(videos):
        if options.has_panoramas and abs(video.width - 2 * video.height) > 2:
            raise ValueError(
                f"--lens EQUIRECTANGULAR needs frames twice as wide as high, those of {video.source} are "
                f"{video.width}×{video.height}: export the whole sphere from the camera's program"
            )
        count, whose = len(video.taken), f" of {video.source}" if len(videos) > 1 else ""
        if count < (needed := needed_frames(options)):
            raise ValueError(
                f"{count} frames{whose} are too few to find what moves, at least {needed} are needed: take "
                "more (--fps, --count), or give masks of what moves (--masks FOLDER, --masks none if nothing does)"
            )
        if k not in held_out_videos:
            held_out([""] * count, options.holdout)
