"""From a video or a folder of pictures to a capture, step by step; a step that is done is not done again."""

import dataclasses
import errno
import json
import math
import shutil
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from warpgs.data.images import decode, read_mask
from warpgs.data.lens import undistort
from warpgs.files import write_png

from . import contact_sheet, depth_anything, sam2
from .contact_sheet import sheet, spread
from .dense import PosedFrames
from .depth import static_depth, write_depth
from .frames import SourceFrame, list_frames, take_frames
from .given_masks import find_masks, read_moving
from .journal import REPORT, Journal
from .motion_masks import find_moving, lift
from .networks import DEPTH_ANYTHING, SAM2, find_weights
from .options import Options
from .scene import pinhole_lens, resized_lens, static_points, write_facts, write_frames
from .sfm import Cameras, NoCamerasError, recover_cameras

WORKING_SIDE = 512
"""Longest side of the pictures that motion and depth are found on [px]. For motion smaller ones are enlarged to it: its
superpixels and outlines count in pixels (256×192 of the hand: intersection over union 0.33, enlarged 0.79)."""

MISLED = 0.7
"""Reprojection error of the second pass over that of the first, under which the masks are made again."""

DOUBTFUL_MOVING, MAX_MOVING = 0.4, 0.6
"""Shares of the pixels with more of which the cameras are tried again, and taken for wrong."""

MIN_FOR_MOTION = 10
"""Frames under which some lack three others far enough off in time to compare with (``revisits``)."""

WEAK = "weak-features"
"""File that says that features of low contrast are needed."""

STRAIGHT = "straight-masks"
"""File that says that the masks lie over straightened frames; COLMAP takes them for its frames': some pixels off do."""

BYTES_A_PIXEL = 16
"""Disk that a pixel of a frame takes while the capture is made: twice the picture, its mask, depth and features."""

FEATURE_BYTES, MASK_BYTES, PICTURE_BYTES, DEPTH_BYTES = 5, 1, 5, 2
"""The same of one step, at most."""

GO_ON = "make room and run the same command again"


class Preparation:
    """A capture in the making.

    Attributes:
        root: The capture's folder.
        attempt: What of it is done.
    """

    def __init__(self, root: Path, options: Options, force: bool = False, quiet: bool = False) -> None:
        """Starts, or goes on where an earlier attempt with the same options stopped.

        Raises:
            ValueError: If the folder holds something else or what is to be read, or was made with other options, and
                ``force`` is not given.
        """
        options.check()
        for what, path in options.inputs.items():
            if root.resolve() in (path.resolve(), *path.resolve().parents):
                raise ValueError(f"{root} holds the {what} {path}: choose a folder of its own for the capture")
        self.root, self.options, self.quiet = root, options, quiet
        plain = json.loads(json.dumps(asdict(options), default=lambda path: str(Path(path).resolve())))
        self.attempt = Journal(root, plain, force, quiet)
        self.work = self.attempt.work

    def run(self) -> dict[str, Any]:
        """Makes the capture; returns what prepare.json says.

        Raises:
            ValueError: If the source is not fit; says why and what to try.
            OSError: If something can't be written, or the disk is too full.
        """
        try:
            if not self.attempt.is_finished:
                self.attempt.step("frames", self._frames)
                self.attempt.step("cameras, first pass", self._first_cameras)
                self.attempt.step("masks", self._masks)
                self.attempt.step("cameras", self._cameras)
                self.attempt.step("masks, second pass", self._masks_again)
                self.attempt.step("capture", self._capture)
                self.attempt.step("depth", self._depth)
                self.attempt.finish()
        except OSError as error:
            if error.errno == errno.ENOSPC or "No space left" in str(error):
                raise OSError(f"{self.root}: the disk is full; {GO_ON}") from error
            raise
        return json.loads((self.root / REPORT).read_text())

    # Steps, each from the files of those before to files of its own.

    def _frames(self) -> str:
        """A capture that is to be replaced stays whole until the frames of the new one are there."""
        new = self.work / "new"
        shutil.rmtree(new, ignore_errors=True)
        try:
            self._check_room(100)
            frames = take_frames(self.options.source, new, self.options.selection, self.quiet, self.attempt.notes)
            self._check_motion(len(frames))
            self._check_holdout(len(frames))
            height, width = decode(new / f"{frames[0].name}.png").shape[:2]
            self._check_room(len(frames) * width * height * BYTES_A_PIXEL // 1_000_000)
            self.attempt.clear(keep=new)
            new.rename(self.work / "frames")
        finally:
            shutil.rmtree(new, ignore_errors=True)
        return f"{len(frames)} of {width}×{height}"

    def _check_motion(self, count: int) -> None:
        if self.options.finds_motion and count < MIN_FOR_MOTION:
            raise ValueError(
                f"{count} frames are too few to find what moves, at least {MIN_FOR_MOTION} are needed: take more "
                "(--fps, --count), or give masks of what moves (--masks FOLDER, --masks none if nothing does)"
            )

    def _check_holdout(self, count: int) -> None:
        if self.options.holdout // 2 >= count:
            raise ValueError(f"--holdout {self.options.holdout} keeps none of {count} frames for evaluation")

    def _check_room(self, megabytes: int) -> None:
        """Before anything large is written: COLMAP ends the whole program where the disk fills up."""
        self.work.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self.work).free // 1_000_000
        if free < megabytes:
            raise OSError(f"{self.root}: {megabytes} MB of disk are needed, {free} MB are free; {GO_ON}")

    def _check_room_for(self, bytes_a_pixel: int) -> None:
        width, height = self._size()
        self._check_room(len(self._listed()) * width * height * bytes_a_pixel // 1_000_000 + 1)

    def _first_cameras(self) -> str:
        if not self.options.finds_motion:
            return ""
        return self._recover("first", [f.name for f in self._listed()], None, thorough=False)

    def _masks(self) -> str:
        if self.options.masks == "none":
            return ""
        if self.options.finds_motion:
            return self._first_masks()
        return self._given_masks()

    def _first_masks(self) -> str:
        """Where nearly everything seems to move, features sat on what moves: again without it, then with weak ones."""
        text = self._find_masks(self._load("first"))
        for first_again in (self._first_without_worst, self._first_with_weak):
            if self._moving_share() > DOUBTFUL_MOVING:
                first_again()
                text = self._find_masks(self._load("first"))
        if (share := self._moving_share()) > MAX_MOVING:
            raise ValueError(
                f"{share:.0%} of the pixels seem to move: the cameras that were found fit little of the pictures; take "
                "more frames (--fps, --count), film more of what stands still and has texture, or give masks of what "
                "moves (--masks FOLDER)"
            )
        return text

    def _first_without_worst(self) -> None:
        """In half the size misled cameras are half as many pixels off: only what is worst seems to move."""
        first = self._load("first")
        self._find_masks(first, WORKING_SIDE // 2)
        with suppress(NoCamerasError):  # the masks leave too little
            self._recover("first", first.names, self.work / "masks", thorough=False)

    def _first_with_weak(self) -> None:
        (self.work / WEAK).touch()
        self._recover("first", [f.name for f in self._listed()], None, thorough=False)

    def _moving_share(self) -> float:
        names = self._load("first").names
        return float(np.mean([(decode(self.work / f"masks/{name}.png.png") == 0).mean() for name in names]))

    def _masks_again(self) -> str:
        """What moves misled the first pass where the second fits much better: its masks are wrong as well."""
        if not self.options.finds_motion:
            return ""
        first, final = self._load("first"), self._load("final")
        misled = final.error < MISLED * first.error or self._moving_share() > DOUBTFUL_MOVING
        return self._find_masks(final) if misled else ""

    def _find_masks(self, cameras: Cameras, side: int | None = None) -> str:
        size = cameras.lens.width, cameras.lens.height
        images = [_scaled(image, side or WORKING_SIDE) for image in _pictures(self.work / "frames", cameras.names)]
        lifted, (height, width) = lift(images), images[0].shape[:2]
        footage = PosedFrames(lifted, resized_lens(cameras.lens, width, height), cameras.poses, cameras.points)
        moving = find_moving(lifted, footage, self.quiet)
        if self.options.masks == "sam2":
            moving = sam2.follow(images, moving, find_weights(SAM2, self.options.weights), self.quiet)
        resized = [cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_CUBIC) > 0.5 for m in moving]
        return self._keep_masks(cameras.names, resized)

    def _keep_masks(self, names: list[str], moving: list[np.ndarray]) -> str:
        self._check_room_for(MASK_BYTES)
        for name, mask in zip(names, moving, strict=True):
            write_png(self.work / f"masks/{name}.png.png", (~mask).astype(np.uint8) * 255)
        return f"{np.mean([mask.mean() for mask in moving]):.1%} of the pixels move"

    def _given_masks(self) -> str:
        frames = self._listed()
        paths, are_straight = find_masks(Path(self.options.masks), frames)
        size = self._size()
        text = self._keep_masks([f.name for f in frames], [read_moving(path, size) for path in paths])
        flag = self.work / STRAIGHT
        flag.touch() if are_straight else flag.unlink(missing_ok=True)
        return text

    def _cameras(self) -> str:
        if self.options.masks == "none":
            return self._recover("final", [f.name for f in self._listed()], None)
        masks = self.work / "masks"
        if not self.options.finds_motion:
            return self._recover("final", [f.name for f in self._listed()], masks)
        first = self._load("first")
        try:
            text = self._recover("final", first.names, masks)
            if len(self._load("final").names) == len(first.names):
                return text
            reason = "fewer frames could be placed"
        except NoCamerasError as error:
            reason = str(error)
        # What is static must have been enough for the first pass; its cameras are as good as without masks.
        first.save(self.work / "final.npz")
        self.attempt.notes.append(f"the cameras are those of the first pass, without masks: with masks, {reason}")
        return f"{len(first.names)} frames, those of the first pass"

    def _recover(self, which: str, names: list[str], masks: Path | None, thorough: bool = True) -> str:
        self._check_room_for(FEATURE_BYTES)
        lens, work = self.options.lens, self.work
        weak = (work / WEAK).exists()
        found = recover_cameras(work / "frames", names, work / "colmap", lens, masks, thorough, weak)
        found.save(self.work / f"{which}.npz")
        return (
            f"{len(found.names)} of {len(names)} frames, {len(found.points)} points, "
            f"reprojection {found.error:.2f} px, seen under {found.angle:.0f}°"
        )

    def _capture(self) -> str:
        self._check_room_for(PICTURE_BYTES)
        cameras, frames = self._load("final"), self._listed()
        moving = list(self._straight_masks(cameras))
        cameras = self._without_moving_points(cameras, moving)
        placed = set(cameras.names)
        self._check_holdout(len(placed))
        left_out = [f"{f.name} ({f.source})" for f in frames if f.name not in placed]
        if left_out:
            self.attempt.notes.append(f"left out, because no camera was found for them: {', '.join(left_out)}")
        write_frames(self.root, self.work / "frames", cameras, moving)
        write_facts(self.root, cameras, [f for f in frames if f.name in placed], self.options.holdout)
        share = float(np.mean([mask.mean() for mask in moving]))
        if share > DOUBTFUL_MOVING:
            self.attempt.notes.append(f"the masks say that {share:.0%} of the pixels move: look at masks.png")
        chosen = spread(len(moving))
        names = [cameras.names[k] for k in chosen]
        shown = lift(list(_pictures(self.root / "rgb/1x", names)))
        painted = [contact_sheet.with_mask(shown[i], moving[k]) for i, k in enumerate(chosen)]
        write_png(self.root / "masks.png", sheet(painted, names))
        return f"{len(placed)} frames, {len(left_out)} left out, {len(cameras.points)} static points"

    def _without_moving_points(self, cameras: Cameras, moving: list[np.ndarray]) -> Cameras:
        keep = static_points(dataclasses.replace(cameras, lens=pinhole_lens(cameras.lens)), moving)
        if keep.sum() < 50:
            raise ValueError(
                f"only {int(keep.sum())} static points are left: nearly everything moves, or the masks are turned "
                "around (0 = moving)"
            )
        return dataclasses.replace(cameras, points=cameras.points[keep])

    def _depth(self) -> str:
        if self.options.depth == "none":
            return "none"
        cameras = self._load("final")
        pictures = _pictures(self.root / "rgb/1x", cameras.names)
        images = [_scaled(picture, WORKING_SIDE, most=1.0) for picture in pictures]
        self._check_room_for(DEPTH_BYTES)
        by_network = self.options.depth == "anything"
        planes = self._network_depth(images) if by_network else self._flow_depth(cameras, images)
        for name, plane in zip(cameras.names, planes, strict=True):
            write_depth(self.root / f"depth/1x/{name}.npy", plane)
        chosen = spread(len(planes))
        shown = [contact_sheet.of_depth(planes[k]) for k in chosen]
        write_png(self.root / "depth.png", sheet(shown, [cameras.names[k] for k in chosen]))
        return f"known on {np.mean([np.isfinite(plane).mean() for plane in planes]):.0%} of the pixels"

    def _network_depth(self, images: list[np.ndarray]) -> list[np.ndarray]:
        return depth_anything.predict(images, find_weights(DEPTH_ANYTHING, self.options.weights), self.quiet)

    def _flow_depth(self, cameras: Cameras, images: list[np.ndarray]) -> list[np.ndarray]:
        size = images[0].shape[1::-1]
        masks = self._straight_masks(cameras)
        moving = [cv2.resize(m.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0 for m in masks]
        lens = resized_lens(pinhole_lens(cameras.lens), *size)
        return static_depth(PosedFrames(lift(images), lens, cameras.poses, cameras.points), moving, self.quiet)

    def _listed(self) -> list[SourceFrame]:
        return list_frames(self.work / "frames")

    def _size(self) -> tuple[int, int]:
        """Width and height of the frames [px]."""
        height, width = decode(self.work / f"frames/{self._listed()[0].name}.png").shape[:2]
        return width, height

    def _load(self, which: str) -> Cameras:
        return Cameras.load(self.work / f"{which}.npz")

    def _straight_masks(self, cameras: Cameras) -> Iterator[np.ndarray]:
        """[H, W] true where each straightened frame moves, in the size of the lens."""
        lens, are_straight = cameras.lens, (self.work / STRAIGHT).exists()
        for name in cameras.names:
            if self.options.masks == "none":
                yield np.zeros((lens.height, lens.width), bool)
            else:
                moving = ~read_mask(self.work / f"masks/{name}.png.png", (lens.width, lens.height))
                yield moving if are_straight else undistort(moving, lens)


def _pictures(folder: Path, names: Iterable[str]) -> Iterator[np.ndarray]:
    """[H, W, 3] RGB pictures, one at a time: all of them in full size may not fit into memory."""
    for name in names:
        yield cv2.cvtColor(decode(folder / f"{name}.png"), cv2.COLOR_BGR2RGB)


def _scaled(image: np.ndarray, side: int, most: float = math.inf) -> np.ndarray:
    """A picture of this longest side [px], enlarged at most so many times."""
    height, width = image.shape[:2]
    factor = min(most, side / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC)
