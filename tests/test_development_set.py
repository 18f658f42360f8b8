"""The example that makes captures of clips of DAVIS, with a stand-in for ``warpgs prepare``."""

import runpy
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from warpgs.data import writer
from warpgs.data.images import read_mask
from warpgs.data.lens import Lens
from warpgs.data.units import SceneUnits
from warpgs.files import read_json, write_json

SCRIPT = Path(__file__).parent.parent / "examples" / "development_set.py"
WIDTH, HEIGHT, NUM_FRAMES = 120, 80, 13
LENS = Lens(WIDTH, HEIGHT, (100.0, 100.0), (60.0, 40.0), (0.15,))


def annotation(step: int) -> np.ndarray:
    """The annotated object of a frame of twice the size: a rectangle that moves to the right."""
    inside = np.zeros((2 * HEIGHT, 2 * WIDTH), np.uint8)
    inside[20:140, 10 + 10 * step : 70 + 10 * step] = 255
    return inside


def covered(step: int) -> np.ndarray:
    """True where the object is in the image of the capture."""
    return annotation(step)[::2, ::2] > 0


@pytest.fixture
def davis(tmp_path):
    """A folder with frames and annotations of one clip."""
    texture = cv2.resize(np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8), (2 * WIDTH, 2 * HEIGHT))
    for part in ("JPEGImages", "Annotations"):
        (tmp_path / part / "480p/walk").mkdir(parents=True)
    for step in range(NUM_FRAMES):
        image = np.roll(texture, 3 * step, axis=1)
        cv2.imwrite(str(tmp_path / f"JPEGImages/480p/walk/{step:05d}.jpg"), image)
        cv2.imwrite(str(tmp_path / f"Annotations/480p/walk/{step:05d}.png"), annotation(step))
    return tmp_path


def prepared(frames: list[Path], root: Path, holdout: int) -> None:
    """A capture of frames through ``LENS``; its masks have the upper half of the object."""
    for k, path in enumerate(frames):
        name, image = f"frame_{k:06d}", cv2.imread(str(path))[..., ::-1]
        image = cv2.resize(image, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
        dynamic = covered(int(path.stem))
        dynamic[HEIGHT // 2 :] = False
        writer.write_image(root, name, image, (1, 2))
        writer.write_mask(root, name, ~dynamic, (1, 2))
        writer.write_camera(root, name, LENS, np.eye(3), np.array([0.1 * k, 0.0, 0.0]))
    names = [f"frame_{k:06d}" for k in range(len(frames))]
    points = np.random.default_rng(1).uniform([-2, -1, 4], [2, 1, 6], (60, 3))
    writer.write_scene(root, SceneUnits(np.zeros(3), 0.2), points, 0.1, 2.0)
    val = writer.held_out(names, holdout)
    writer.write_index(root, {name: k for k, name in enumerate(names)}, val, estimated_masks=True)
    write_json(root / "prepare.json", {"sources": [path.name for path in frames]})


@pytest.fixture
def make(davis, monkeypatch, capsys):
    """Runs the example on the clip with options; returns the capture and what was printed."""

    def prepare(command, check):
        assert command[1:4] == ["-m", "warpgs", "prepare"]
        assert check
        folder, root, *options = command[4:]
        prepared(sorted(Path(folder).iterdir()), Path(root), int(options[options.index("--holdout") + 1]))

    def make(*options: str) -> tuple[Path, str]:
        arguments = [davis, "--out", davis / "out", "--clips", "walk", *options]
        monkeypatch.setattr(sys, "argv", ["development_set.py", *map(str, arguments)])
        runpy.run_path(str(SCRIPT), run_name="__main__")
        return davis / "out/walk", capsys.readouterr().out

    monkeypatch.setattr(subprocess, "run", prepare)
    return make


def sources(root: Path, split: str) -> list[int]:
    """Indices in the clip of the frames of a split."""
    taken = read_json(root / "prepare.json")["sources"]
    return [int(Path(taken[int(name[6:])]).stem) for name in read_json(root / "dataset.json")[split]]


def mask(root: Path, name: str, factor: int = 1) -> np.ndarray:
    """True where a mask of the capture is dynamic."""
    return ~read_mask(root / f"resized_mask/{factor}x/{name}.png.png", (WIDTH // factor, HEIGHT // factor))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / (a | b).sum())


def test_masks_of_evaluation_frames_become_the_annotations(make):
    root, _ = make()
    val = read_json(root / "dataset.json")["val_ids"]
    assert val == ["frame_000004", "frame_000012"]
    for name in val:
        expected = covered(int(name[6:]))
        assert overlap(mask(root, name), expected) > 0.99
        coarse = expected.reshape(HEIGHT // 2, 2, WIDTH // 2, 2).any((1, 3))
        assert overlap(mask(root, name, factor=2), coarse) > 0.98


def test_training_frames_keep_their_masks_and_get_annotations_next_to_them(make):
    root, _ = make()
    for name in read_json(root / "dataset.json")["train_ids"]:
        annotated = ~read_mask(root / f"annotation/1x/{name}.png", (WIDTH, HEIGHT))
        assert overlap(annotated, covered(int(name[6:]))) > 0.99
        assert not mask(root, name)[HEIGHT // 2 :].any()


def test_masks_of_training_frames_are_scored(make):
    root, printed = make()
    truths = [covered(step) for step in sources(root, "train_ids")]
    expected = np.mean([truth[: HEIGHT // 2].sum() / truth.sum() for truth in truths])
    frames, recall, iou, bad = printed.splitlines()[1].split()[1:]
    assert (int(frames), bad) == (len(truths), f"{np.mean([t[:40].sum() / t.sum() < 0.5 for t in truths]):.0%}")
    assert float(recall) == pytest.approx(expected, abs=0.01)
    assert float(iou) == pytest.approx(expected, abs=0.01)


def test_a_sparse_capture_has_evenly_spaced_training_frames_and_held_out_ones_halfway(make):
    root, _ = make("--count", "4")
    assert sources(root, "train_ids") == [0, 4, 8, 12]
    assert sources(root, "val_ids") == [2, 6, 10]
    assert overlap(mask(root, "frame_000003"), covered(6)) > 0.99


def test_a_clip_that_was_prepared_is_not_prepared_again(make, monkeypatch):
    root, first = make()
    masks = {path: path.read_bytes() for path in root.glob("resized_mask/*/*")}
    monkeypatch.delattr(subprocess, "run")
    assert make() == (root, first)
    assert {path: path.read_bytes() for path in root.glob("resized_mask/*/*")} == masks


def test_a_capture_of_other_frames_is_refused(make, davis, capsys):
    make()
    frames = sorted((davis / "JPEGImages/480p/walk").iterdir())
    frames[0].rename(davis / f"JPEGImages/480p/walk/{NUM_FRAMES:05d}.jpg")
    with pytest.raises(SystemExit) as ended:
        make()
    assert ended.value.code == 1
    assert "was not made from" in capsys.readouterr().out


def test_a_capture_of_more_frames_is_refused(make, capsys):
    make()
    with pytest.raises(SystemExit) as ended:
        make("--count", "4")
    assert ended.value.code == 1
    assert "was made from more than 7 frames" in capsys.readouterr().out


def test_a_folder_that_is_not_davis_is_refused_once(make, davis, capsys):
    (davis / "JPEGImages").rename(davis / "images")
    with pytest.raises(SystemExit) as ended:
        make("--clips", "walk", "run")
    assert ended.value.code == 2
    assert capsys.readouterr().err.count("has no folder JPEGImages/480p") == 1
