"""The steps of a preparation: each checks the disk space, calls the function that does the work, and is journaled."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from warpgs.data.lens import Lens
from warpgs.data.results.masks import read_object_mask
from warpgs.data.writer import held_out_of

from .cameras.intrinsics import read_intrinsics
from .cameras.panorama import views_of
from .cameras.posed_frames import PosedFrames, load_posed_frames
from .cameras.recovered import (
    Cameras,
    NoCamerasError,
    files_of_all,
    load_all,
    require_cameras,
    require_frames,
    save_all,
)
from .cameras.sfm import Settings, Shots, recover_cameras, recover_several
from .checks import check_frames, needed_frames
from .depth.estimate import add_depth, depth_files
from .depth.methods import DEPTHS
from .doubts import doubts_of_lens, doubts_of_masks, doubts_of_motion
from .frames.images import read_images, resize_to_side
from .frames.offsets import common_clock, short_names
from .frames.stillness import require_still
from .frames.take import Frames, take_frames, take_videos
from .journal import Journal
from .masks.background import SIDE, off_background
from .masks.files import Masks, mask_files, write_masks
from .masks.given import find_given_masks
from .masks.masker import WORKING_SIDE, find_masks
from .masks.methods import MASKERS
from .options import Options
from .scene import capture_files, write_capture

MIN_SPACE = 100
"""Disk space that is required before any frame is taken [MB]."""

CAPTURE_BYTES = 16
"""Disk space per pixel of a frame that a preparation needs: the image twice, its mask, depth, and features [bytes]."""

FEATURE_BYTES, MASK_BYTES, IMAGE_BYTES, DEPTH_BYTES = 5, 1, 5, 2
"""Disk space per pixel of a frame that single steps need [bytes]."""

BACKGROUND = "background"
"""Name of the step that finds what does not move with the background, and of the folder with its masks."""

MIN_KEPT = 0.8
"""Minimum fraction of the frames of the first pass that keep a camera in the second, for the second to be used."""

STILL_FOCAL = 1.0
"""Focal length over the longer side of a camera on a tripod whose focal length is unknown: 53° across."""

MAYBE_PANORAMAS = (
    "frames are twice as wide as high, as panoramas are, but they are taken as those of a lens: if this is a 360° "
    "video, give --lens EQUIRECTANGULAR"
)

Names = list[list[str]]
"""Names of the frames of each camera."""


def names_of(cameras: Sequence[Cameras]) -> Names:
    """The names of each camera's frames."""
    return [camera.names for camera in cameras]


def take(sources: Sequence[Path], options: Options, journal: Journal) -> list[Frames]:
    """The selected frames of each source; a capture that is being replaced stays complete until they are all taken."""

    def make(path: Path) -> str:
        new = journal.work / "new"
        shutil.rmtree(new, ignore_errors=True)
        try:
            journal.require_space(MIN_SPACE)
            videos, summary = _take(sources, new, options, journal)
            check_frames(videos, options)
            journal.require_space(sum(video.megabytes(CAPTURE_BYTES) for video in videos))
            journal.clear(keep=new)
            new.rename(path)
        finally:
            shutil.rmtree(new, ignore_errors=True)
        return summary

    return journal.result("frames", Frames.load_all, make, Frames.files)


def _take(sources: Sequence[Path], folder: Path, options: Options, journal: Journal) -> tuple[list[Frames], str]:
    """Writes the frames to a folder; returns them and a summary."""
    if len(sources) == 1:
        video = take_frames(sources[0], folder, options.selection, journal.quiet, journal.notes)
        if options.camera == "still":
            require_still(folder, video.names)
        if video.width == 2 * video.height and not options.has_panoramas:
            journal.notes.append(MAYBE_PANORAMAS)
        return [video], f"{len(video.taken)} of {video.width}×{video.height}"
    clock, starts = common_clock(sources, options.offsets, journal.quiet, needed_frames(options))
    videos = take_videos(sources, folder, options.selection, clock, journal.quiet, journal.notes)
    taken = [
        f"{len(video.taken)} of {video.width}×{video.height} of {name} ({video.prefix}), "
        f"{'which stands still' if video.is_still else 'which moves'}"
        for name, video in zip(short_names(sources), videos, strict=True)
    ]
    return videos, f"{'; '.join(taken)}; {starts}"


@dataclass(frozen=True)
class Steps:
    """The steps after the frames are taken.

    Attributes:
        videos: The frames of each camera.
        options: How to make the capture.
        journal: Runs each step once.
        held_out: Indices of the cameras that are for evaluation as a whole.
    """

    videos: list[Frames]
    options: Options
    journal: Journal
    held_out: Sequence[int] = ()

    @property
    def names(self) -> Names:
        """The names of each video's frames."""
        return [video.names for video in self.videos]

    def recover(
        self,
        name: str,
        names: Names,
        masks: Masks | None = None,
        *,
        thorough: bool = True,
        weak_features: bool = False,
    ) -> list[Cameras]:
        """The cameras of the named frames, from features outside of the masks."""
        folder = masks.folder if masks else None
        settings = replace(self._settings, masks=folder, thorough=thorough, weak_features=weak_features)

        def make(path: Path) -> str:
            if self.options.camera == "still":
                return _save([self._still(names[0])], path, names)
            return _save(self._reconstruct(names, settings), path, names)

        return self._cameras(name, make)

    def _cameras(self, name: str, make: Callable[[Path], str]) -> list[Cameras]:
        count = len(self.videos)
        return self.journal.result(name, partial(load_all, count=count), make, partial(files_of_all, count=count))

    def refine(self, name: str, first: list[Cameras], masks: Masks) -> list[Cameras]:
        """The cameras of the first pass, refined with the matches outside of the masks."""
        settings = replace(self._settings, masks=masks.folder, weak_features=first[0].weak_features, refine=True)
        if first[0].has_held_focal:
            settings = replace(settings, focal=first[0].lens.focal[0])

        def make(path: Path) -> str:
            if self.options.camera == "still":
                return _save(first, path, names_of(first))
            try:
                found = self._reconstruct(names_of(first), settings)
                counts = [
                    (len(new.names), len(old.names), video.source)
                    for new, old, video in zip(found, first, self.videos, strict=True)
                ]
                kept, of, source = min(counts, key=lambda count: count[0] / count[1])
                if kept >= MIN_KEPT * of:
                    held = first[0].has_held_focal
                    return _save([replace(camera, has_held_focal=held) for camera in found], path, names_of(first))
                whose = f" of {source}" if len(first) > 1 else ""
                reason = f"only {kept} of {of} frames{whose} have a camera"
            except NoCamerasError as error:
                reason = str(error)
            # The static regions were sufficient for the first pass; its cameras are as good as without masks.
            save_all(first, path)
            self.journal.notes.append(
                f"the cameras may be wrong: they are from before what moves was masked, because after that {reason}"
            )
            return f"{sum(map(len, names_of(first)))} frames, those of the first pass"

        return self._cameras(name, make)

    def _still(self, names: list[str]) -> Cameras:
        """The cameras of a tripod: all the same."""
        width, height = self.videos[0].width, self.videos[0].height
        focal = self._focal or STILL_FOCAL * max(width, height)
        lens = self._known_lens or Lens.centered(focal, (width, height))
        if self._known_lens is None and self._focal is None:
            self.journal.notes.append(f"the focal length is assumed, {focal:.0f} px: frames of a tripod do not tell it")
        poses = np.tile(np.eye(4)[:3], (len(names), 1, 1))
        return Cameras(names, lens, poses, np.zeros((0, 3)), 0.0, 0.0)

    @property
    def _settings(self) -> Settings:
        """What the options say of every pass."""
        turns = self.options.camera == "turning"
        return Settings(self.options.lens, focal=self._focal, known=self._known_lens, turns=turns)

    @property
    def _focal(self) -> float | None:
        """Known focal length of the frames [px]."""
        return None if self.options.focal is None else self.options.focal * self.videos[0].factor

    @property
    def _known_lens(self) -> Lens | None:
        """Known lens of the frames."""
        width, height, factor = self.videos[0].width, self.videos[0].height, self.videos[0].factor
        if self.options.has_panoramas:
            return Lens.panorama((width, height))
        if self.options.intrinsics is None:
            return None
        source = round(width / factor), round(height / factor)
        return read_intrinsics(self.options.intrinsics, source).resized(width, height)

    def recover_background(self, name: str) -> list[Cameras]:
        """The cameras of all frames, without features that do not move with the background if that suffices."""
        if self.options.camera != "moving" or self.options.has_panoramas or not self._moving:
            return self.recover(name, self.names, thorough=False)
        background = self.find_background(BACKGROUND)
        try:
            return self.recover(name, self.names, background, thorough=False)
        except NoCamerasError:  # too few features, or all parallax is in the masked region
            return self.recover(name, self.names, thorough=False)

    @property
    def _moving(self) -> list[Frames]:
        return [video for video in self.videos if not video.is_still]

    def find_background(self, name: str) -> Masks:
        """Masks of what does not move with the background of each camera that moves, found without cameras."""

        def off(video: Frames) -> list[np.ndarray]:
            images = [resize_to_side(image, SIDE) for image in read_images(video.folder, video.names)]
            size = video.width, video.height
            return [
                cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
                for mask in off_background(images, self.journal.quiet)
            ]

        def make(path: Path) -> str:
            self._require_space(MASK_BYTES)
            summary = write_masks(path, ((video.names, off(video)) for video in self._moving))
            return summary.replace("move", "do not move with it")

        names = [name for video in self._moving for name in video.names]
        return self.journal.result(name, Masks.load, make, self._mask_files(names))

    def find_masks(self, name: str, cameras: list[Cameras], *, half_size: bool = False) -> Masks:
        """The masks of the cameras' frames."""
        masker = MASKERS[self.options.masks]
        assert masker is not None

        def make(path: Path) -> str:
            folder, weights, quiet = self._folder, self.options.weights, self.journal.quiet
            find = partial(find_masks, folder, masker=masker, weights=weights, half_size=half_size, quiet=quiet)
            self._require_space(MASK_BYTES)
            return write_masks(path, ((camera.names, find(camera)) for camera in cameras))

        files = self._mask_files([name for camera in cameras for name in camera.names])
        return replace(self.journal.result(name, Masks.load, make, files), estimated=True)

    def copy_masks(self, name: str) -> Masks:
        """The masks given by the user, in the size of the frames."""

        def make(path: Path) -> str:
            found = [find_given_masks(Path(self.options.masks), video.taken) for video in self.videos]
            self._require_space(MASK_BYTES)
            return write_masks(
                path,
                (
                    (video.names, [read_object_mask(file, (video.width, video.height)) for file in files])
                    for video, files in zip(self.videos, found, strict=True)
                ),
            )

        names = [name for names in self.names for name in names]
        return self.journal.result(name, Masks.load, make, self._mask_files(names))

    def write_capture(self, name: str, cameras: list[Cameras], masks: Masks) -> None:
        """Writes the capture without depth."""

        def make() -> str:
            self._require_space(IMAGE_BYTES)
            summary, notes = write_capture(
                self.journal.root,
                self.videos,
                cameras,
                masks.read_dynamic,
                estimated=masks.estimated,
                val=held_out_of(dict(enumerate(names_of(cameras))), self.options.holdout, self.held_out),
                quiet=self.journal.quiet,
            )
            self.journal.notes += notes
            for video, camera in zip(self.videos, cameras, strict=True):
                whose = f"{video.source}: " if len(cameras) > 1 else ""
                self.journal.notes += [whose + doubt for doubt in self._doubts(video, camera, masks)]
            return summary

        names = [name for camera in cameras for name in camera.names]
        self.journal.step(name, make, lambda: capture_files(self.journal.root, names))

    def _doubts(self, video: Frames, camera: Cameras, masks: Masks) -> list[str]:
        background = self.journal.work / BACKGROUND
        has_background = background.is_dir() and not video.is_still
        off = Masks.load(background).read_dynamic(camera) if has_background else None
        found = doubts_of_masks(masks.read_dynamic(camera), masks.estimated, off)
        if not video.is_still:
            frames = _compared(video.folder, camera).halved
            found += doubts_of_motion(frames, self.journal.quiet)
        is_known = self.options.camera == "still" or self._focal or self._known_lens
        return found if is_known else [*found, *doubts_of_lens(camera)]

    def add_depth(self, name: str, cameras: list[Cameras]) -> None:
        """Adds depth to the capture."""
        method = DEPTHS[self.options.depth_method]

        def make() -> str:
            if method is None:
                return "none"
            self._require_space(DEPTH_BYTES)
            journal = self.journal
            summary, notes = add_depth(journal.root, cameras, method, self.options.weights, journal.quiet)
            journal.notes.extend(notes)
            return summary

        def files() -> list[Path]:
            names = [] if method is None else [n for camera in method.applies_to(cameras) for n in camera.names]
            return depth_files(self.journal.root, names)

        self.journal.step(name, make, files)

    @staticmethod
    def _mask_files(names: Sequence[str]) -> Callable[[Path], list[Path]]:
        return partial(mask_files, names=names)

    def _reconstruct(self, names: Names, settings: Settings) -> list[Cameras]:
        self._require_space(FEATURE_BYTES)
        quiet, work = self.journal.quiet, self.journal.work / "colmap"
        if len(self.videos) == 1:
            found = recover_cameras(self._folder, names[0], work, settings, quiet)
            require_frames(len(found.names), len(self.videos[0].names))  # ``names`` may already be a part of them
            return [found]
        several = recover_several(self._folder, [*map(_shots, self.videos, names)], work, settings, quiet)
        for k, video in enumerate(self.videos):
            if video.is_still:  # all frames have the pose of its background
                poses = np.repeat(several[k].poses, len(names[k]), axis=0)
                several[k] = replace(several[k], names=names[k], poses=poses)
        require_cameras(
            [*map(len, names_of(several))], [*map(len, self.names)], [video.source for video in self.videos]
        )
        return several

    @property
    def _folder(self) -> Path:
        return self.videos[0].folder

    def _require_space(self, bytes_per_pixel: int) -> None:
        self.journal.require_space(sum(video.megabytes(bytes_per_pixel) for video in self.videos))


def _shots(video: Frames, names: list[str]) -> Shots:
    """The images of a video that tell its cameras: all frames, or the background if it stands still."""
    if video.is_still:
        return Shots(video.source, [video.background], [video.taken[0].time])
    times = {frame.name: frame.time for frame in video.taken}
    return Shots(video.source, names, [times[name] for name in names])


def _compared(folder: Path, camera: Cameras) -> PosedFrames:
    """The frames of a camera whose optical flow is compared with it, of panoramas the view ahead."""
    if camera.lens.is_panorama:
        return next(views_of(folder, camera, WORKING_SIDE // 2))
    return load_posed_frames(folder, camera, WORKING_SIDE)


def _save(cameras: Sequence[Cameras], path: Path, names: Names) -> str:
    save_all(cameras, path)
    points = [camera.points for camera in cameras]
    count = len(points[0]) if len(points) == 1 else len(np.unique(np.concatenate(points), axis=0))
    return (
        f"{sum(map(len, names_of(cameras)))} of {sum(map(len, names))} frames, {count} points, "
        f"reprojection error {cameras[0].error:.2f} px, triangulation angle {cameras[0].angle:.0f}°"
    )
