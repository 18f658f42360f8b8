"""Makes captures of clips of DAVIS 2016, whose annotations say exactly which pixels move in held-out frames.

python examples/development_set.py DAVIS --out captures --jobs 2    # every 8th frame is held out
python examples/development_set.py DAVIS --out few --count 14       # 14 training frames per clip, held-out ones between

DAVIS has JPEGImages/480p/CLIP and Annotations/480p/CLIP. ``warpgs prepare`` makes each capture; then the annotations
replace the masks of its evaluation frames, so that regions are the same for every method and every version of the
masks. Training keeps the masks that prepare found. Their recall and intersection over union with the annotations, which
are also written to annotation/1x of each capture (0 = dynamic), are printed. A clip that was prepared before gets only
its annotations.
"""

import argparse
import json
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from warpgs.data import writer
from warpgs.data.images import decode, read_mask
from warpgs.files import write_png
from warpgs.prepare.frames.images import resize_to_side
from warpgs.prepare.scene import FACTORS

CLIPS = (
    "lucia", "stroller", "motorbike", "parkour", "scooter-gray", "hike", "drift-turn", "kite-walk", "camel", "bus",
    "horsejump-high", "dance-twirl", "soapbox", "motocross-jump", "rollerblade", "bmx-trees", "goat", "elephant",
    "cows", "mallard-fly",
)  # fmt: skip
"""The development set: clips whose cameras move."""

HOLDOUT, LONGEST_SIDE = 8, 480
"""Options of ``warpgs prepare``."""

MIN_TRAIN = 3
"""Minimum of ``--count``: prepare needs five frames."""

MAX_DIFFERENCE = 0.5
"""Mean difference above which a frame is not the one that an image of the capture was made from [grey levels]."""


def evenly(count: int, num_train: int | None) -> list[int]:
    """Indices of the frames to take: all, or ``num_train`` evenly spaced ones and those halfway between them."""
    num_taken = count if num_train is None else min(count, 2 * num_train - 1)
    return np.linspace(0, count - 1, num_taken).round().astype(int).tolist()


def prepare(folder: Path, frames: list[Path], root: Path, num_train: int | None) -> None:
    """Makes a capture, or finishes it, of all frames of a folder or of those of them to take.

    Raises:
        CalledProcessError: If ``warpgs prepare`` fails, which says why.
    """
    if num_train is not None:  # prepare --count would take the sharpest frames, not evenly spaced ones
        folder = root.parent / "frames" / root.name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for path in frames:
            (folder / path.name).symlink_to(path.resolve())
    options = ["--holdout", str(HOLDOUT if num_train is None else 2), "--longest-side", str(LONGEST_SIDE), "--quiet"]
    subprocess.run([sys.executable, "-m", "warpgs", "prepare", str(folder), str(root), *options], check=True)


def require_made_from(root: Path, pairs: dict[str, Path]) -> tuple[int, int]:
    """Raises ValueError unless images of a capture, by their ids, are these frames; returns their (width, height)."""
    for name, path in pairs.items():
        image = cv2.imread(str(root / f"rgb/1x/{name}.png"))
        height, width = image.shape[:2]
        frame = resize_to_side(cv2.imread(str(path)), max(width, height), 1.0)
        if frame.shape != image.shape or cv2.absdiff(frame, image).mean() > MAX_DIFFERENCE:
            raise ValueError(f"{root} was not made from {', '.join(map(str, pairs.values()))}")
    return width, height


def place_annotations(root: Path, frames: list[Path], folder: Path) -> None:
    """Writes the annotations of a capture's frames to annotation/1x, and as the masks of the evaluation frames.

    Args:
        root: The capture.
        frames: The frames that it was made from, in order.
        folder: Their annotations: PNG files, bright where an object is.

    Raises:
        ValueError: If the capture was made from other frames, or an annotation is missing or damaged.
    """
    index = json.loads((root / "dataset.json").read_text())
    ids, steps = index["ids"], [int(name.removeprefix("frame_")) for name in index["ids"]]
    if steps[-1] >= len(frames):
        raise ValueError(f"{root} was made from more than {len(frames)} frames")
    source = {name: frames[step] for name, step in zip(ids, steps, strict=True)}
    size = require_made_from(root, {name: source[name] for name in (ids[0], ids[len(ids) // 2], ids[-1])})
    for name in ids:
        annotated = decode(folder / f"{source[name].stem}.png", cv2.IMREAD_GRAYSCALE)
        covered = np.where(annotated > 0, 255, 0).astype(np.uint8)
        static = cv2.resize(covered, size, interpolation=cv2.INTER_AREA) < 128
        write_png(root / f"annotation/1x/{name}.png", static.astype(np.uint8) * 255)
        if name in index["val_ids"]:
            writer.write_mask(root, name, static, FACTORS)


def score(root: Path) -> list[tuple[float, float]]:
    """Recall, and intersection over union, of the mask of every training frame against its annotation."""
    scores = []
    for name in json.loads((root / "dataset.json").read_text())["train_ids"]:
        annotation = cv2.imread(str(root / f"annotation/1x/{name}.png"), cv2.IMREAD_GRAYSCALE)
        truth = annotation == 0
        mask = ~read_mask(root / f"resized_mask/1x/{name}.png.png", (truth.shape[1], truth.shape[0]))
        both, either, annotated = (truth & mask).sum(), (truth | mask).sum(), truth.sum()
        scores.append((both / annotated if annotated else 1.0, both / either if either else 1.0))
    return scores


def make(davis: Path, root: Path, num_train: int | None) -> list[tuple[float, float]]:
    """Makes the capture of a clip unless it was prepared before, places its annotations, and returns ``score``."""
    folder = davis / "JPEGImages/480p" / root.name
    images = sorted(folder.glob("*.jpg"))
    if not images:
        raise ValueError(f"{folder} has no .jpg frames")
    frames = [images[k] for k in evenly(len(images), num_train)]
    if not (root / "prepare.json").is_file():
        prepare(folder, frames, root, num_train)
    place_annotations(root, frames, davis / "Annotations/480p" / root.name)
    return score(root)


def main() -> None:
    """Reads the options, makes the captures and prints the scores of their masks."""
    parser = argparse.ArgumentParser(description="Make captures of clips of DAVIS 2016, evaluated by its annotations.")
    parser.add_argument("davis", type=Path, help="folder with JPEGImages/480p and Annotations/480p")
    parser.add_argument("--out", type=Path, required=True, help="folder of the captures")
    parser.add_argument("--clips", nargs="+", default=CLIPS, metavar="CLIP", help="default: the development set")
    parser.add_argument("--count", type=int, help="training frames per clip, the frames halfway between them held out")
    parser.add_argument("--jobs", type=int, default=1, help="captures made at a time (default: 1)")
    options = parser.parse_args()
    if options.count is not None and options.count < MIN_TRAIN:
        parser.error(f"--count must be at least {MIN_TRAIN}, got {options.count}")
    if not (options.davis / "JPEGImages/480p").is_dir():
        parser.error(f"{options.davis} has no folder JPEGImages/480p")
    failed = False
    print(f"{'clip':16} frames  recall  IoU    IoU below 0.5")
    with ThreadPoolExecutor(options.jobs) as pool:
        jobs = {clip: pool.submit(make, options.davis, options.out / clip, options.count) for clip in options.clips}
        for clip, job in jobs.items():
            try:
                recall, iou = np.array(job.result()).T
            except (subprocess.CalledProcessError, ValueError, OSError) as error:
                print(f"{clip:16} {error}", flush=True)
                failed = True
                continue
            cells = f"{len(iou):6}  {recall.mean():.3f}   {iou.mean():.3f}  {(iou < 0.5).mean():.0%}"
            print(f"{clip:16} {cells}", flush=True)
    if failed:
        sys.exit(1)


if __name__ == "__main__":
    main()
