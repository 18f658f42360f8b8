"""From a video or a folder of pictures to a capture, step by step; a step that is done is not done again."""

import dataclasses
import errno
import json
import math
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from warpgs.data.images import decode, read_mask
from warpgs.data.lens import straighten
from warpgs.data.writing import write_png

from . import contact_sheet, depth_anything, sam2
from .attempt import REPORT, Attempt
from .contact_sheet import sheet, spread
from .dense import Footage
from .depth import static_depth, write_depth
from .frames import SourceFrame, list_frames, take_frames
from .motion_masks import find_moving, lift
from .networks import DEPTH_ANYTHING, SAM2, find_weights
from .options import Options
from .scene import resized_lens, static_points, straight_lens, write_facts, write_frames
from .sfm import Cameras, recover_cameras

WORKING_SIDE = 512
"""Longest side of the pictures that motion and depth are found on [px]. For motion smaller ones are enlarged to it: its
superpixels and outlines count in pixels (256×192 of the hand: intersection over union 0.33, enlarged 0.79)."""

MISLED = 0.7
"""Reprojection error of the second pass over that of the first, under which the masks are made again."""

DOUBTFUL_MOVING, MOST_MOVING = 0.4, 0.6
"""Shares of the pixels with more of which the cameras are tried again, and taken for wrong."""

WEAK = "weak-features"
"""File that says that features of low contrast are needed."""

BYTES_A_PIXEL = 16
"""Disk that a pixel of a frame takes while the capture is made: twice the picture, its mask, depth and features."""


class Preparation:
    """A capture in the making.

    Attributes:
        root: The capture's folder.
        attempt: What of it is done.
    """

    def __init__(self, root: Path, options: Options, force: bool = False, quiet: bool = False) -> None:
        """Starts, or goes on where an earlier attempt with the same options stopped.

        Raises:
            ValueError: If the folder holds something else, or was begun with other options, and ``force`` is not given.
        """
        options.check()
        if root.resolve() in (options.source.resolve(), *options.source.resolve().parents):
            raise ValueError(f"{root} holds the source {options.source}: choose a folder of its own")
        self.root, self.options, self.quiet = root, options, quiet
        plain = json.loads(json.dumps(asdict(options), default=lambda path: str(Path(path).resolve())))
        self.attempt = Attempt(root, plain, force, quiet)
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
                raise OSError(f"{self.root}: the disk is full; make room and run the same command again") from error
            raise
        return json.loads((self.root / REPORT).read_text())

    # Steps, each from the files of those before to files of its own.

    def _frames(self) -> str:
        shutil.rmtree(self.work, ignore_errors=True)
        self._check_room(100)
        frames = take_frames(self.options.source, self.work / "frames", self.options.selection, self.quiet)
        height, width = decode(self.work / f"frames/{frames[0].name}.png").shape[:2]
        self._check_room(len(frames) * width * height * BYTES_A_PIXEL // 1_000_000)
        return f"{len(frames)} of {width}×{height}"

    def _check_room(self, megabytes: int) -> None:
        self.work.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(self.work).free // 1_000_000
        if free < megabytes:
            raise OSError(f"{self.root}: {megabytes} MB of disk are needed, {free} MB are free")

    def _first_cameras(self) -> str:
        if not self.options.finds_motion:
            return ""
        return self._recover("first", [f.name for f in self._listed()], None, thorough=False)

    def _masks(self) -> str:
        if self.options.masks == "none":
            return ""
        if self.options.finds_motion:
            return self._first_masks()
        frames = self._listed()
        return self._keep_masks([f.name for f in frames], [self._given_mask(f) for f in frames])

    def _first_masks(self) -> str:
        """Where nearly everything seems to move, features sat on what moves: again with weak ones on what stands."""
        text = self._find_masks(self._load("first"))
        if self._moving_share() > DOUBTFUL_MOVING:
            (self.work / WEAK).touch()
            self._recover("first", [f.name for f in self._listed()], None, thorough=False)
            text = self._find_masks(self._load("first"))
        if (share := self._moving_share()) > MOST_MOVING:
            raise ValueError(
                f"{share:.0%} of the pixels seem to move: the cameras that were found fit little of the pictures; film "
                "more of what stands still and has texture, or give masks of what moves (--masks FOLDER)"
            )
        return text

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

    def _find_masks(self, cameras: Cameras) -> str:
        size = cameras.lens.width, cameras.lens.height
        images = self._working_images(cameras)
        lifted, (height, width) = lift(images), images[0].shape[:2]
        footage = Footage(lifted, resized_lens(cameras.lens, width, height), cameras.poses, cameras.points)
        moving = find_moving(lifted, footage, self.quiet)
        if self.options.masks == "sam2":
            moving = sam2.follow(images, moving, find_weights(SAM2, self.options.weights), self.quiet)
        resized = [cv2.resize(m.astype(np.float32), size, interpolation=cv2.INTER_CUBIC) > 0.5 for m in moving]
        return self._keep_masks(cameras.names, resized)

    def _keep_masks(self, names: list[str], moving: list[np.ndarray]) -> str:
        for name, mask in zip(names, moving, strict=True):
            write_png(self.work / f"masks/{name}.png.png", (~mask).astype(np.uint8) * 255)
        return f"{np.mean([mask.mean() for mask in moving]):.1%} of the pixels move"

    def _given_mask(self, frame: SourceFrame) -> np.ndarray:
        folder = Path(self.options.masks)
        stems = (frame.name, frame.source, Path(frame.source).stem)
        found = next((p for s in stems if (p := folder / f"{s}.png").is_file()), None)
        if found is None:
            raise ValueError(f"{folder} has no mask for {frame.name} ({frame.source}): expected {stems[-1]}.png")
        stored = decode(found)
        static = read_mask(found, stored.shape[1::-1]).astype(np.uint8)
        height, width = decode(self.work / f"frames/{frame.name}.png").shape[:2]
        return cv2.resize(static, (width, height), interpolation=cv2.INTER_NEAREST_EXACT) == 0

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
        except ValueError as error:
            reason = str(error)
        # What is static must have been enough for the first pass; its cameras are as good as without masks.
        first.save(self.work / "final.npz")
        self.attempt.notes.append(f"the cameras are those of the first pass, without masks: with masks, {reason}")
        return f"{len(first.names)} frames, those of the first pass"

    def _recover(self, which: str, names: list[str], masks: Path | None, thorough: bool = True) -> str:
        lens, work = self.options.lens, self.work
        weak = (work / WEAK).exists()
        found = recover_cameras(work / "frames", names, work / "colmap", lens, masks, thorough, weak)
        found.save(self.work / f"{which}.npz")
        return (
            f"{len(found.names)} of {len(names)} frames, {len(found.points)} points, "
            f"reprojection {found.error:.2f} px, seen under {found.angle:.0f}°"
        )

    def _capture(self) -> str:
        cameras, frames = self._load("final"), self._listed()
        moving = self._mask_of(cameras)
        cameras = self._without_moving_points(cameras, moving)
        placed = set(cameras.names)
        left_out = [f"{f.name} ({f.source})" for f in frames if f.name not in placed]
        if left_out:
            self.attempt.notes.append(f"left out, because no camera was found for them: {', '.join(left_out)}")
        write_frames(self.root, self.work / "frames", cameras, moving)
        write_facts(self.root, cameras, [f for f in frames if f.name in placed], self.options.holdout)
        share = float(np.mean([mask.mean() for mask in moving]))
        if share > DOUBTFUL_MOVING:
            self.attempt.notes.append(f"the masks say that {share:.0%} of the pixels move: look at masks.png")
        straight = [straighten(m, cameras.lens) for m in moving]
        chosen = spread(len(straight))
        shown = lift([self._picture(cameras.names[k]) for k in chosen])
        pictures = [contact_sheet.with_mask(shown[i], straight[k]) for i, k in enumerate(chosen)]
        write_png(self.root / "masks.png", sheet(pictures, [cameras.names[k] for k in chosen]))
        return f"{len(placed)} frames, {len(left_out)} left out, {len(cameras.points)} static points"

    def _without_moving_points(self, cameras: Cameras, moving: list[np.ndarray]) -> Cameras:
        keep = static_points(cameras, moving)
        if keep.sum() < 50:
            raise ValueError(
                f"only {int(keep.sum())} static points are left: nearly everything moves, or the masks are turned "
                "around (0 = moving)"
            )
        return dataclasses.replace(cameras, points=cameras.points[keep], colors=cameras.colors[keep])

    def _depth(self) -> str:
        if self.options.depth == "none":
            return "none"
        cameras = self._load("final")
        images = [_scaled(self._picture(name), 1.0) for name in cameras.names]
        by_network = self.options.depth == "anything"
        planes = self._network_depth(images) if by_network else self._flow_depth(cameras, images)
        for name, plane in zip(cameras.names, planes, strict=True):
            write_depth(self.root / f"depth/1x/{name}.npy", plane)
        chosen = spread(len(planes))
        pictures = [contact_sheet.of_depth(planes[k]) for k in chosen]
        write_png(self.root / "depth.png", sheet(pictures, [cameras.names[k] for k in chosen]))
        return f"known on {np.mean([np.isfinite(plane).mean() for plane in planes]):.0%} of the pixels"

    def _network_depth(self, images: list[np.ndarray]) -> list[np.ndarray]:
        return depth_anything.predict(images, find_weights(DEPTH_ANYTHING, self.options.weights), self.quiet)

    def _flow_depth(self, cameras: Cameras, images: list[np.ndarray]) -> list[np.ndarray]:
        size = images[0].shape[1::-1]
        moving = [straighten(m, cameras.lens) for m in self._mask_of(cameras)]
        moving = [cv2.resize(m.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0 for m in moving]
        lens = resized_lens(straight_lens(cameras.lens), *size)
        return static_depth(Footage(lift(images), lens, cameras.poses, cameras.points), moving, self.quiet)

    def _listed(self) -> list[SourceFrame]:
        return list_frames(self.work / "frames")

    def _load(self, which: str) -> Cameras:
        return Cameras.load(self.work / f"{which}.npz")

    def _mask_of(self, cameras: Cameras) -> list[np.ndarray]:
        """[H, W] true where each frame moves, in the size of the lens."""
        size = cameras.lens.width, cameras.lens.height
        if self.options.masks == "none":
            return [np.zeros(size[::-1], bool) for _ in cameras.names]
        return [~read_mask(self.work / f"masks/{name}.png.png", size) for name in cameras.names]

    def _picture(self, name: str) -> np.ndarray:
        return cv2.cvtColor(decode(self.root / f"rgb/1x/{name}.png"), cv2.COLOR_BGR2RGB)

    def _working_images(self, cameras: Cameras) -> list[np.ndarray]:
        frames = [decode(self.work / f"frames/{name}.png") for name in cameras.names]
        return [_scaled(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), math.inf) for frame in frames]


def _scaled(image: np.ndarray, most: float) -> np.ndarray:
    """A picture in the working size, enlarged at most so many times."""
    height, width = image.shape[:2]
    factor = min(most, WORKING_SIDE / max(width, height))
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if factor < 1.0 else cv2.INTER_CUBIC)
