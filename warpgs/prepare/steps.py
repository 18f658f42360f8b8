"""The steps of a preparation: each checks the disk space, calls the function that does the work, and is journaled."""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from warpgs.data.lens import Lens

from .cameras.intrinsics import read_intrinsics
from .cameras.posed_frames import load_posed_frames
from .cameras.recovered import Cameras, NoCamerasError, require_frames
from .cameras.sfm import Settings, recover_cameras
from .checks import check_count
from .depth.estimate import add_depth, depth_files
from .depth.methods import DEPTHS
from .doubts import doubts_of_lens, doubts_of_masks, doubts_of_motion
from .frames.images import read_images, resize_to_side
from .frames.stillness import require_still
from .frames.take import Frames, take_frames
from .journal import Journal
from .masks.background import SIDE, off_background
from .masks.files import Masks, mask_files, write_masks
from .masks.given import find_given_masks, read_dynamic
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


def take(source: Path, options: Options, journal: Journal) -> Frames:
    """The selected frames of the source; a capture that is being replaced stays complete until they are all taken."""

    def make(path: Path) -> str:
        new = journal.work / "new"
        shutil.rmtree(new, ignore_errors=True)
        try:
            journal.require_space(MIN_SPACE)
            frames = take_frames(source, new, options.selection, journal.quiet, journal.notes)
            check_count(len(frames.taken), options)
            if options.camera == "still":
                require_still(new, frames.names)
            journal.require_space(frames.megabytes(CAPTURE_BYTES))
            journal.clear(keep=new)
            new.rename(path)
        finally:
            shutil.rmtree(new, ignore_errors=True)
        return f"{len(frames.taken)} of {frames.width}×{frames.height}"

    return journal.result("frames", Frames.load, make, Frames.files)


@dataclass(frozen=True)
class Steps:
    """The steps after the frames are taken."""

    frames: Frames
    options: Options
    journal: Journal

    def recover(
        self,
        name: str,
        names: list[str],
        masks: Masks | None = None,
        *,
        thorough: bool = True,
        weak_features: bool = False,
    ) -> Cameras:
        """The cameras of the named frames, from features outside of the masks."""
        folder = masks.folder if masks else None
        settings = replace(self._settings, masks=folder, thorough=thorough, weak_features=weak_features)

        def make(path: Path) -> str:
            if self.options.camera == "still":
                return _save(self._still(names), path, names)
            return _save(self._reconstruct(names, settings), path, names)

        return self.journal.result(name, Cameras.load, make, Cameras.files)

    def refine(self, name: str, first: Cameras, masks: Masks) -> Cameras:
        """The cameras of the first pass, refined with the matches outside of the masks."""
        settings = replace(self._settings, masks=masks.folder, weak_features=first.weak_features, refine=True)
        if first.has_held_focal:
            settings = replace(settings, focal=first.lens.focal[0])

        def make(path: Path) -> str:
            if self.options.camera == "still":
                return _save(first, path, first.names)
            try:
                found = self._reconstruct(first.names, settings)
                if len(found.names) >= MIN_KEPT * len(first.names):
                    return _save(replace(found, has_held_focal=first.has_held_focal), path, first.names)
                reason = f"only {len(found.names)} of {len(first.names)} frames have a camera"
            except NoCamerasError as error:
                reason = str(error)
            # The static regions were sufficient for the first pass; its cameras are as good as without masks.
            first.save(path)
            self.journal.notes.append(
                f"the cameras may be wrong: they are from before what moves was masked, because after that {reason}"
            )
            return f"{len(first.names)} frames, those of the first pass"

        return self.journal.result(name, Cameras.load, make, Cameras.files)

    def _still(self, names: list[str]) -> Cameras:
        """The cameras of a tripod: all the same."""
        width, height = self.frames.width, self.frames.height
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
        return None if self.options.focal is None else self.options.focal * self.frames.factor

    @property
    def _known_lens(self) -> Lens | None:
        """Known lens of the frames."""
        if self.options.intrinsics is None:
            return None
        width, height = self.frames.width, self.frames.height
        source = round(width / self.frames.factor), round(height / self.frames.factor)
        return read_intrinsics(self.options.intrinsics, source).resized(width, height)

    def recover_background(self, name: str) -> Cameras:
        """The cameras of all frames, without features that do not move with the background if that suffices."""
        names = self.frames.names
        if self.options.camera != "moving":
            return self.recover(name, names, thorough=False)
        background = self.find_background(BACKGROUND)
        try:
            return self.recover(name, names, background, thorough=False)
        except NoCamerasError:  # too few features, or all parallax is in the masked region
            return self.recover(name, names, thorough=False)

    def find_background(self, name: str) -> Masks:
        """Masks of what does not move with the background, found without cameras."""

        def make(path: Path) -> str:
            folder, names = self.frames.folder, self.frames.names
            images = [resize_to_side(image, SIDE) for image in read_images(folder, names)]
            size = self.frames.width, self.frames.height
            off = [
                cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
                for mask in off_background(images, self.journal.quiet)
            ]
            self._require_space(MASK_BYTES)
            write_masks(path, names, off)
            return f"{np.mean([mask.mean() for mask in off]):.1%} of the pixels do not move with it"

        return self.journal.result(name, Masks.load, make, self._mask_files(self.frames.names))

    def find_masks(self, name: str, cameras: Cameras, *, half_size: bool = False) -> Masks:
        """The masks of the cameras' frames."""
        masker = MASKERS[self.options.masks]
        assert masker is not None

        def make(path: Path) -> str:
            folder, weights, quiet = self.frames.folder, self.options.weights, self.journal.quiet
            dynamic = find_masks(folder, cameras, masker, weights, half_size=half_size, quiet=quiet)
            self._require_space(MASK_BYTES)
            return write_masks(path, cameras.names, dynamic)

        files = self._mask_files(cameras.names)
        return replace(self.journal.result(name, Masks.load, make, files), estimated=True)

    def copy_masks(self, name: str) -> Masks:
        """The masks given by the user, in the size of the frames."""

        def make(path: Path) -> str:
            files = find_given_masks(Path(self.options.masks), self.frames.taken)
            dynamic = [read_dynamic(file, (self.frames.width, self.frames.height)) for file in files]
            self._require_space(MASK_BYTES)
            return write_masks(path, self.frames.names, dynamic)

        return self.journal.result(name, Masks.load, make, self._mask_files(self.frames.names))

    def write_capture(self, name: str, cameras: Cameras, masks: Masks) -> None:
        """Writes the capture without depth."""

        def make() -> str:
            self._require_space(IMAGE_BYTES)
            root, holdout, quiet = self.journal.root, self.options.holdout, self.journal.quiet
            dynamic, estimated = masks.read_dynamic(cameras), masks.estimated
            summary, notes = write_capture(
                root, self.frames, cameras, dynamic, estimated=estimated, holdout=holdout, quiet=quiet
            )
            self.journal.notes += [*notes, *self._doubts(cameras, dynamic, estimated)]
            return summary

        self.journal.step(name, make, lambda: capture_files(self.journal.root, cameras.names))

    def _doubts(self, cameras: Cameras, dynamic: Sequence[np.ndarray], estimated: bool) -> list[str]:
        background = self.journal.work / BACKGROUND
        off = Masks.load(background).read_dynamic(cameras) if background.is_dir() else None
        found = doubts_of_masks(dynamic, estimated, off)
        frames = load_posed_frames(self.frames.folder, cameras, WORKING_SIDE).halved
        found += doubts_of_motion(frames, self.journal.quiet)
        is_known = self.options.camera == "still" or self.options.focal or self.options.intrinsics
        return found if is_known else [*found, *doubts_of_lens(cameras)]

    def add_depth(self, name: str, cameras: Cameras) -> None:
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
            return [] if method is None else depth_files(self.journal.root, cameras.names)

        self.journal.step(name, make, files)

    @staticmethod
    def _mask_files(names: Sequence[str]) -> Callable[[Path], list[Path]]:
        return partial(mask_files, names=names)

    def _reconstruct(self, names: list[str], settings: Settings) -> Cameras:
        self._require_space(FEATURE_BYTES)
        quiet = self.journal.quiet
        found = recover_cameras(self.frames.folder, names, self.journal.work / "colmap", settings, quiet)
        require_frames(len(found.names), len(self.frames.names))  # ``names`` may already be a part of them
        return found

    def _require_space(self, bytes_per_pixel: int) -> None:
        self.journal.require_space(self.frames.megabytes(bytes_per_pixel))


def _save(cameras: Cameras, path: Path, names: Sequence[str]) -> str:
    cameras.save(path)
    return (
        f"{len(cameras.names)} of {len(names)} frames, {len(cameras.points)} points, "
        f"reprojection error {cameras.error:.2f} px, triangulation angle {cameras.angle:.0f}°"
    )
