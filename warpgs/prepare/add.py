"""Adds what a capture lacks, with its own cameras: masks, depth, points.

The methods of ``MASKERS`` and ``DEPTHS`` work on the frames of one camera, with one lens. If these have lenses of their
own, they are resampled to one pinhole camera, and results to each frame as its file has it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from warpgs.captures.opening import load_capture
from warpgs.command_line.progress import progress
from warpgs.data import writer
from warpgs.data.camera_files import read_camera
from warpgs.data.camera_ids import with_camera_ids
from warpgs.data.capture import Capture
from warpgs.data.depth_points import DepthView, points_of_views
from warpgs.data.images import decode, is_bright, read_mask
from warpgs.data.lens import Lens
from warpgs.data.loaders import LOADERS, LoadOptions, is_capture, recognize, require_finished
from warpgs.data.loaders.nerfies import NerfiesLoader, find_depth, find_mask
from warpgs.data.missing import missing_capture
from warpgs.data.resized import resize_mask
from warpgs.data.results.checked import checked
from warpgs.data.results.depth import read_depths
from warpgs.data.results.masks import read_masks
from warpgs.data.results.tracks import read_tracked_points
from warpgs.data.sampling import evenly_spaced_indices
from warpgs.data.tracks import FILE, make_tracks, read_tracks, write_tracks
from warpgs.data.units import SceneUnits, read_units
from warpgs.errors import counted, not_one_of
from warpgs.files import read_json, write_json
from warpgs.locks import lock_folder

from .cameras.posed_frames import PosedFrames, common_lens, resampled
from .cameras.recovered import are_apart
from .checks import MIN_FOR_MOTION
from .contact_sheet import choose_evenly, colored_depth, overlay_mask, write_contact_sheet
from .depth.estimate import MAX_SIDE, as_half
from .depth.methods import DEPTHS
from .frames.images import resize_to_side
from .masks.masker import WORKING_SIDE, DynamicMasks
from .masks.methods import MASKERS
from .options import PARTS, AddOptions, unread
from .weights import find_weights

MAX_POINT_FRAMES = 40
"""Number of frames, evenly spread, that points are taken from."""


def add_parts(root: Path, options: AddOptions, log: Callable[[str], None] | None = None) -> None:
    """Adds masks, depth, points or tracks that a capture lacks; what it has stays as it is.

    Args:
        root: Capture in the layout of warpgs, or of NeRF-DS, HyperNeRF or DyCheck.
        options: What to add and how.
        log: Receives a line per part; None shows nothing, progress bars included.

    Raises:
        ValueError: If an option is invalid, the capture is damaged, of another layout or unsuitable.
        ImportError: If the package of a network is missing.
        OSError: If a file cannot be written; the message names it.
    """
    _check_options(options)
    if not root.exists():
        raise ValueError(missing_capture(root, is_capture))
    require_finished(root)
    layout = recognize(root)
    loader = LOADERS[layout]
    if not isinstance(loader, NerfiesLoader):
        raise ValueError(f"{root} has the layout {layout}: first copy it with warpgs import, then add to the copy")
    with lock_folder(root, "prepared"):
        capture = with_camera_ids(loader.load(root, LoadOptions(), incomplete_masks=True))
        if any(camera.is_panorama for camera in capture.cameras.values()):
            raise ValueError(f"{root} is of panoramas, whose masks and depth warpgs prepare makes from the video only")
        job = _Job(root, layout, loader.default_factor, capture, read_units(root / "scene.json"), options, log)
        for part in PARTS:
            if part in options.parts:
                getattr(job, f"add_{part}")()


def _check_options(options: AddOptions) -> None:
    if not options.parts or not set(options.parts) <= set(PARTS):
        raise ValueError(f"--add must be one or more of {', '.join(PARTS)}, got {','.join(options.parts) or 'nothing'}")
    for name, value, methods in (("masks", options.masks, MASKERS), ("depth", options.depth, DEPTHS)):
        known = [method for method, implementation in methods.items() if implementation is not None]
        if value not in known and not Path(value).exists():
            option = f"to add {name}, if not from an existing file or folder, --{name}"
            raise ValueError(not_one_of(option, value, known))
    if ("tracks" in options.parts) != (options.tracks is not None):
        raise ValueError("--add tracks and --tracks FILE belong together")


class _Depth(NamedTuple):
    """Frames at working size, their static masks and inverse depth."""

    frames: PosedFrames
    static: list[Bool[np.ndarray, "H W"]]
    planes: Sequence[np.ndarray]


@dataclass(frozen=True)
class _Job:
    """One call of ``add_parts``.

    ``posed`` holds a camera's frames by the first of them and their resize factor, ``estimated`` depth by the first
    frame and the method.
    """

    root: Path
    layout: str
    factor: int
    capture: Capture
    units: SceneUnits
    options: AddOptions
    log: Callable[[str], None] | None
    posed: dict[tuple[str, float], PosedFrames] = field(default_factory=dict)
    estimated: dict[tuple[str, str], _Depth] = field(default_factory=dict)

    def add_masks(self) -> None:
        """Writes masks of the frames that lack them, and masks.png."""
        videos = self._videos()
        names = [name for video in videos for name in video]
        # The loader reads one of the two folders: those in mask/ would be lost to it if new ones went to the other.
        folder = self._mask_folder()
        files = {name: self._mask_files(folder, name) for name in names}
        missing = [name for name in names if not files[name]]
        incomplete = any(len(found) < len(self._factors()) for found in files.values())
        if incomplete and folder == self.root / "mask" and folder.is_dir():
            raise ValueError(f"{self.root} has masks in mask/, but new ones go to resized_mask/: rename mask/ to that")
        if folder == self.root / "resized_mask":
            self._complete_sizes(files)
        if not missing:
            self._say("masks: all frames have them" + unread(self.options.masks, MASKERS, "their files"))
            return
        lacking = [video for video in videos if not set(video).isdisjoint(missing)]
        for video in lacking:
            if len(video) < MIN_FOR_MOTION and self.options.masks in MASKERS:
                whose = f" of the camera of {video[0]}" if len(videos) > 1 else ""
                raise ValueError(
                    f"{len(video)} frames{whose} are too few to find what moves, at least {MIN_FOR_MOTION} are needed: "
                    "give masks of what moves (--masks FOLDER)"
                )
        sheets, fractions = [], list[float]()
        for video in lacking:
            masks = self._estimate_masks(video, set(missing))
            images = self._posed(video, WORKING_SIDE).images
            shown = choose_evenly(len(video), len(lacking))
            sheets.append({video[k]: overlay_mask(images[k], masks[k]) for k in shown})
            fractions += [float(mask.mean()) for mask in masks]
        write_contact_sheet(self.root / "masks.png", sheets)
        fraction = np.mean(fractions)
        self._say(f"masks: {counted(len(missing), 'frame')}, {fraction:.1%} of the pixels move: look at masks.png")

    def _estimate_masks(self, video: list[str], missing: set[str]) -> DynamicMasks:
        """The masks of a camera's frames at working size, of which those of the ``missing`` ones are written."""
        if self.options.masks not in MASKERS:
            return self._copy_masks(video, missing)
        method = MASKERS[self.options.masks]
        assert method is not None
        folder = find_weights(method.network, self.options.weights)
        frames = self._posed(video, WORKING_SIDE)
        if {"depth", "points"} & set(self.options.parts):
            frames.halved.triangulated = {}
        masks = method.find(frames, folder, self.log is None)
        self._keep_layout_of_estimates(missing)
        for name, mask in zip(video, masks, strict=True):
            if name in missing:
                lens = self._lens(name)
                dynamic = resampled(mask.astype(np.float32), frames.lens, lens, cv2.INTER_LINEAR) > 0.5
                writer.write_mask(self.root, name, ~dynamic, self._factors())
        return masks

    def _copy_masks(self, video: list[str], missing: set[str]) -> DynamicMasks:
        """The same from the file or folder of a network."""
        images, masks = self._posed(video, WORKING_SIDE).images, []
        found = checked(read_masks, Path(self.options.masks), video, self._sizes(video))
        self._keep_layout_of_estimates(missing)
        for name, image, mask in zip(video, images, found, strict=True):
            if name in missing:
                writer.write_mask(self.root, name, ~mask, self._factors())
            masks.append(~resize_mask(~mask, image.shape[1::-1]))
        return masks

    def _sizes(self, names: list[str]) -> list[tuple[int, int]]:
        """Width and height of frames in full size."""
        return [(lens.width, lens.height) for lens in map(self._lens, names)]

    def _keep_layout_of_estimates(self, missing: set[str]) -> None:
        self._keep_layout({} if missing.isdisjoint(self.capture.train) else {"masks": writer.ESTIMATED})

    def _keep_layout(self, entries: dict[str, str]) -> None:
        """Names the layout in dataset.json, because masks in full size make another dataset of it, and adds entries.

        Call it before masks are written: what comes after it may fail.
        """
        path = self.root / "dataset.json"
        write_json(path, {**read_json(path), "layout": self.layout, **entries})

    def _factors(self) -> list[int]:
        """The downscaling factors of the images, the largest images first."""
        return sorted(int(p.name[:-1]) for p in (self.root / "rgb").glob("*x") if p.name[:-1].isdecimal())

    def _mask_folder(self) -> Path:
        """The folder whose masks the loader reads; it may not exist."""
        folder = self.root / "resized_mask"
        return folder if folder.is_dir() else self.root / "mask"

    def _mask_files(self, folder: Path, name: str) -> dict[int, Path]:
        """The mask files of a frame by their downscaling factors."""
        found = {factor: find_mask(folder, factor, name) for factor in self._factors()}
        return {factor: path for factor, path in found.items() if path is not None}

    def _complete_sizes(self, files: dict[str, dict[int, Path]]) -> None:
        """Writes masks of frames that have one in another size, from the largest of a frame's ``files``."""
        completed = 0
        for name, found in files.items():
            lacking = [factor for factor in self._factors() if factor not in found]
            if found and lacking:
                if not completed:
                    self._keep_layout({})
                completed += 1
                static = is_bright(found[min(found)], decode(found[min(found)])).astype(np.uint8)
                lens = self._lens(name)
                full = cv2.resize(static, (lens.width, lens.height), interpolation=cv2.INTER_NEAREST) > 0
                writer.write_mask(self.root, name, full, lacking)
        if completed:
            self._say(f"masks: {counted(completed, 'frame')} had them in some sizes only")

    def add_depth(self) -> None:
        """Writes depth of the frames that lack it, and depth.png; not of iPhone captures, whose depth is in metres."""
        if self.layout == "iphone":
            self._say("depth: that of the sensor stays")
            return
        videos = self._videos()
        missing = {name for video in videos for name in video if find_depth(self.root, self.factor, name) is None}
        if not missing:
            self._say("depth: all frames have it" + unread(self.options.depth, DEPTHS, "its files"))
            return
        seen_apart = self._seen_apart(videos, self.options.depth) if self.options.depth in DEPTHS else videos
        chosen = [video for video in seen_apart if not missing.isdisjoint(video)]
        sheets, known = list[dict[str, UInt8[np.ndarray, "H W 3"]]](), list[float]()
        for video in chosen:
            shown = {video[k] for k in choose_evenly(len(video), len(chosen))}
            sheets.append({})
            for name, plane in zip(video, self._planes(video), strict=True):
                if name in missing:
                    writer.write_depth(self.root, name, as_half(plane))
                if name in shown:
                    sheets[-1][name] = colored_depth(plane)
                known.append(float(np.isfinite(plane).mean()))
        if not chosen:
            self._say("depth: all frames of cameras that move have it")
            return
        write_contact_sheet(self.root / "depth.png", sheets)
        count = len(missing & {name for video in chosen for name in video})
        self._say(f"depth: {counted(count, 'frame')}, known on {np.mean(known):.0%} of the pixels: look at depth.png")

    def _planes(self, video: list[str]) -> Iterator[Float[np.ndarray, "H W"]]:
        """Inverse depth of a camera's frames, estimated or from the file or folder of a network."""
        if self.options.depth not in DEPTHS:
            yield from checked(read_depths, Path(self.options.depth), video, self._sizes(video))
            return
        frames, _, planes = self._depth(video, self.options.depth)
        width = frames.lens.width
        for name, plane in zip(video, planes, strict=True):
            own = self._lens(name)
            own = own.resized(width, round(width * own.height / own.width))
            yield resampled(plane, frames.lens, own, cv2.INTER_NEAREST)

    def add_tracks(self) -> None:
        """Writes tracks.npz from the file of a network, if the capture has no tracks."""
        path, frames = self.options.tracks, self.capture.film
        assert path is not None
        if read_tracks(self.root, frames) is not None:
            self._say("tracks: they are there" + unread(str(path), (), FILE))
            return
        (size,) = self._sizes([self.capture.train[0]])
        found = read_tracked_points(path, size)
        tracks = make_tracks(path, frames, *found, size)
        write_tracks(self.root, *found, size)
        share, count = tracks.visible.mean(), len(tracks.frames)
        self._say(f"tracks: {len(found.positions)} points, seen in {share:.0%} of {count} frames")

    def add_points(self) -> None:
        """Writes points.npy and point_colors.npy, from optical flow, if the capture has no points."""
        if len(self.capture.points):
            self._say(f"points: {len(self.capture.points)} are there")
            return
        videos, views = self._seen_apart(self._videos(), "flow"), []
        for video in videos:
            frames, static, planes = self._depth(video, "flow")
            views += [
                DepthView(frames.images[k], planes[k], static[k], frames.lens, frames.poses[k])
                for k in evenly_spaced_indices(len(video), max(1, MAX_POINT_FRAMES // len(videos)))
            ]
        points, colors = points_of_views(views)
        if len(points) == 0:
            raise ValueError(f"{self.root}: no points were found: the camera hardly moves, or its poses are wrong")
        writer.write_points(self.root, points / self.units.scale + self.units.center, colors)
        self._say(f"points: {len(points)}")

    def _depth(self, video: list[str], depth: str) -> _Depth:
        """The depth of a camera's frames at working size; the same for depth and points."""
        key = video[0], depth
        if key not in self.estimated:
            method = DEPTHS[depth]
            assert method is not None
            folder = find_weights(method.network, self.options.weights)
            frames = self._posed(video, MAX_SIDE, max_factor=1.0)
            static = self._static(video, frames.lens)
            planes = method.estimate(frames, [~mask for mask in static], folder, self.log is None)
            self.estimated[key] = _Depth(frames, static, planes)
        return self.estimated[key]

    def _seen_apart(self, videos: list[list[str]], depth: str) -> list[list[str]]:
        """The videos that a method can estimate the depth of: those of cameras that move, if it needs parallax.

        Raises:
            ValueError: If there are none.
        """
        method = DEPTHS[depth]
        assert method is not None
        found = [video for video in videos if not method.needs_parallax or are_apart(self._centers(video))]
        if not found:
            raise ValueError(f"{self.root}: each camera stays at one place, where optical flow shows no depth")
        return found

    def _centers(self, names: list[str]) -> Float[np.ndarray, "F 3"]:
        return np.array([self.capture.cameras[name].position.double().numpy() for name in names])

    def _videos(self) -> list[list[str]]:
        """The frames of each camera that trains, by time; its evaluation frames are at times of their own."""
        cameras, train = self.capture.cameras, {*self.capture.train}
        videos = []
        for frames in self.capture.by_camera([*self.capture.train, *self.capture.val]).values():
            times = {cameras[name].time for name in frames if name in train}
            videos.append([name for name in frames if name in train or cameras[name].time not in times])
        return [video for video in videos if not train.isdisjoint(video)]

    def _posed(self, names: list[str], side: int, max_factor: float = np.inf) -> PosedFrames:
        """The frames as one lens sees them, with the longer side resized to ``side``."""
        sizes = {self.capture.cameras[name].size for name in names}
        if len(sizes) > 1:
            raise ValueError(f"{self.root} has images of one camera in several sizes, which cannot be compared")
        key = names[0], min(max_factor, side / max(sizes.pop()))
        if key not in self.posed:
            self.posed[key] = self._resized(names, side, max_factor)
        return self.posed[key]

    def _resized(self, names: list[str], side: int, max_factor: float) -> PosedFrames:
        common = common_lens([Lens.of(self.capture.cameras[name]) for name in names])
        images = []
        for name in progress(names, "reading images", self.log is None):
            frame = self.capture.frame(name)
            small = resize_to_side(frame.image.numpy(), side, max_factor)
            height, width = small.shape[:2]
            own = Lens.of(frame.camera).resized(width, height)
            images.append(resampled(small, own, common.resized(width, height), cv2.INTER_LINEAR))
        poses = np.array([self.capture.cameras[name].viewmat[:3].double().numpy() for name in names])
        height, width = images[0].shape[:2]
        return PosedFrames(images, common.resized(width, height), poses, self._points(names))

    def _points(self, names: list[str]) -> Float[np.ndarray, "P 3"]:
        """The capture's points; without any, positions before the cameras, as far away as the scene's center."""
        if len(self.capture.points):
            return self.capture.points.double().numpy()
        cameras = [self.capture.cameras[name] for name in names[:: max(1, len(names) // 20)]]
        forward = [camera.viewmat[2, :3].double().numpy() for camera in cameras]
        centers = [camera.position.double().numpy() for camera in cameras]
        distance = max(0.1, float(np.median(np.linalg.norm(centers, axis=1))))
        return np.array([center + distance * axis for center, axis in zip(centers, forward, strict=True)])

    def _static(self, names: list[str], lens: Lens) -> list[Bool[np.ndarray, "H W"]]:
        """Static masks of the frames as the common lens sees them; all true where there is none."""
        load_capture(self.root)  # refuses masks of some training frames only
        return [self._static_mask(name, lens) for name in names]

    def _static_mask(self, name: str, lens: Lens) -> Bool[np.ndarray, "H W"]:
        path = find_mask(self._mask_folder(), self.factor, name)
        if path is None:
            return np.ones((lens.height, lens.width), bool)
        camera, own = read_camera(self.root / f"camera/{name}.json", self.units, self.factor, 0.0)
        dynamic = ~read_mask(path, camera.size)
        return resampled(dynamic.astype(np.float32), own, lens, cv2.INTER_LINEAR) < 0.5

    def _lens(self, name: str) -> Lens:
        """The lens of a frame's full-size file."""
        return read_camera(self.root / f"camera/{name}.json", self.units, 1, 0.0)[1]

    def _say(self, line: str) -> None:
        if self.log is not None:
            self.log(line)
