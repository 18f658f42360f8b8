"""One preparation writes into a folder at a time, and one that goes on trusts only files that are there."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest

from tests.prepare import boards
from warpgs.captures.opening import load_capture
from warpgs.files import write_png
from warpgs.prepare import pipeline, steps
from warpgs.prepare.add import AddOptions, add_parts
from warpgs.prepare.cameras.matches import has_features, sequence_pairs
from warpgs.prepare.cameras.model import read_model
from warpgs.prepare.options import Options

COUNT = 10
OPTIONS = Options(masks="none", depth="none")


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    return boards.write_folder(tmp_path_factory.mktemp("journal") / "shots", boards.record(COUNT)[0])


@pytest.fixture(scope="module")
def masks(tmp_path_factory, shots):
    folder = tmp_path_factory.mktemp("masks")
    for file in shots.iterdir():
        write_png(folder / file.name, np.full(boards.SIZE[::-1], 255, np.uint8))  # all is static
    return folder


@pytest.fixture
def true_cameras(monkeypatch, no_comparison):
    monkeypatch.setattr(steps, "recover_cameras", boards.true_cameras)


def interrupted(*arguments: object, **options: object) -> None:
    raise KeyboardInterrupt


def begin(shots, root, monkeypatch, options=OPTIONS, before="write_capture"):
    """Prepares until a function is called."""
    with monkeypatch.context() as patch:
        patch.setattr(f"warpgs.prepare.steps.{before}", interrupted)
        with pytest.raises(KeyboardInterrupt):
            pipeline.prepare(shots, root, options)


@pytest.mark.parametrize("force", [False, True])
def test_a_second_preparation_of_a_folder_is_refused_and_changes_nothing(shots, tmp_path, monkeypatch, force):
    root, refusals = tmp_path / "made", []

    def refuse_another(*arguments):
        before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
        with pytest.raises(ValueError, match=f"^{root} is being prepared by another process: wait ") as raised:
            pipeline.prepare(shots, root, OPTIONS, force=force)
        refusals.append(raised)
        assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
        return boards.true_cameras(*arguments)

    monkeypatch.setattr(steps, "recover_cameras", refuse_another)
    pipeline.prepare(shots, root, OPTIONS)
    assert len(refusals) == 1
    assert len(load_capture(root).train) == COUNT
    assert not (root / ".lock").exists()


def test_parts_are_not_added_to_a_folder_that_is_being_added_to(shots, tmp_path, monkeypatch, true_cameras):
    root = tmp_path / "made"
    pipeline.prepare(shots, root, OPTIONS)
    (root / "points.npy").unlink()

    def refuse_another(job):
        with pytest.raises(ValueError, match=f"^{root} is being prepared by another process"):
            add_parts(root, AddOptions(["points"]))
        with pytest.raises(ValueError, match=f"^{root} is being prepared by another process"):
            pipeline.prepare(shots, root, OPTIONS, force=True)

    monkeypatch.setattr("warpgs.prepare.add._Job.add_points", refuse_another)
    add_parts(root, AddOptions(["points"]))


def test_what_a_killed_preparation_leaves_is_taken_over(shots, tmp_path, true_cameras):
    (tmp_path / "made/.prepare").mkdir(parents=True)
    (tmp_path / "made/.lock").touch()
    pipeline.prepare(shots, tmp_path / "made", OPTIONS)
    assert len(load_capture(tmp_path / "made").train) == COUNT


@pytest.fixture(scope="module")
def begun(shots, masks, tmp_path_factory):
    """Preparations with given masks that stopped before and after the capture was written."""
    folder = tmp_path_factory.mktemp("begun")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "recover_cameras", boards.true_cameras)
        patch.setattr(steps, "doubts_of_motion", lambda *_: [])
        for before in ("write_capture", "Steps.add_depth"):
            begin(shots, folder / before, patch, Options(masks=str(masks), depth="none"), before)
    return folder


LOST = {
    "a frame": (".prepare/frames/frame_000004.png", "frames"),
    "the index of the frames": (".prepare/frames/index_frame.json", "frames"),
    "a mask": (".prepare/masks/frame_000004.png.png", "masks"),
    "the cameras": (".prepare/cameras.npz", "cameras"),
    "an image": ("rgb/2x/frame_000004.png", "capture"),
    "the index": ("dataset.json", "capture"),
}


@pytest.mark.parametrize("is_emptied", [False, True])
@pytest.mark.parametrize("lost", LOST)
def test_a_step_whose_result_is_lost_is_done_again_with_all_that_follow(
    shots, masks, begun, tmp_path, true_cameras, lost, is_emptied
):
    (name, step), root, lines = LOST[lost], tmp_path / "made", []
    options = Options(masks=str(masks), depth="none")
    shutil.copytree(begun / ("Steps.add_depth" if step == "capture" else "write_capture"), root)
    path = root / name
    path.write_bytes(b"") if is_emptied else path.unlink()
    pipeline.prepare(shots, root, options, log=lines.append)
    assert f"note: {path}, which an earlier call wrote, is missing: {step} is done again" in lines
    order = ["frames", "masks", "cameras", "capture"]
    before = [line.split(":")[0] for line in lines if line.endswith("(finished before)")]
    assert before == order[: order.index(step)]
    capture = load_capture(root)
    assert [capture.frame(name).image.shape for name in capture.train] == [(192, 256, 3)] * COUNT


@pytest.mark.parametrize("before", ["find_masks", "write_capture", "Steps.add_depth"])
def test_with_the_same_cameras_a_preparation_that_is_continued_gives_the_same_bits(
    shots, tmp_path_factory, monkeypatch, true_cameras, before
):
    monkeypatch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", boards.SIZE[0] // 2)
    whole, folder = tmp_path_factory.getbasetemp() / "whole", tmp_path_factory.mktemp("continued")
    if not whole.exists():
        pipeline.prepare(shots, whole)
    begin(shots, folder, monkeypatch, Options(), before)
    pipeline.prepare(shots, folder)
    assert contents(folder) == contents(whole)


def contents(root):
    """Every file of a capture but the report, which has times."""
    paths = (path for path in root.rglob("*") if path.is_file() and path.name not in ("prepare.json", "state.json"))
    return {path.relative_to(root): path.read_bytes() for path in paths}


@pytest.fixture(scope="module")
def finished(shots, tmp_path_factory):
    root = tmp_path_factory.mktemp("finished") / "made"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(steps, "recover_cameras", boards.true_cameras)
        patch.setattr(steps, "doubts_of_motion", lambda *_: [])
        pipeline.prepare(shots, root, OPTIONS)
    return root


@pytest.mark.parametrize("name", ["rgb/1x/frame_000004.png", "camera/frame_000000.json", "points.npy", "dataset.json"])
def test_a_finished_capture_without_one_of_its_files_is_refused_by_name(shots, finished, tmp_path, true_cameras, name):
    root = shutil.copytree(finished, tmp_path / "made")
    (root / name).unlink()
    with pytest.raises(ValueError, match=f"^{root} was finished before, but {root / name} is missing: .* --force$"):
        pipeline.prepare(shots, root, OPTIONS)
    pipeline.prepare(shots, root, OPTIONS, force=True)
    assert len(load_capture(root).train) == COUNT


@pytest.fixture(scope="module")
def matched(shots, tmp_path_factory):
    """A preparation of which COLMAP has done its part."""
    root = tmp_path_factory.mktemp("matched") / "made"
    with pytest.MonkeyPatch.context() as patch:
        begin(shots, root, patch)
    return root


def delete_from(table):
    def spoil(path):
        with sqlite3.connect(path) as database:
            database.execute(f"delete from {table}")

    return spoil


SPOILT = {
    "empty": lambda path: path.write_bytes(b""),
    "missing": Path.unlink,
    "cut": lambda path: path.write_bytes(path.read_bytes()[:5000]),
    "without features": delete_from("descriptors"),
    "without matches": delete_from("matches"),
    "without images": delete_from("images"),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_features_count_as_found_only_if_the_database_has_them(matched, tmp_path, spoil):
    path = shutil.copy(matched / ".prepare/colmap/features.db", tmp_path)
    files = [f"frame_{k:06d}.png" for k in range(COUNT)]
    count = len(sequence_pairs(COUNT))
    assert has_features(Path(path), files, count)
    assert has_features(Path(path), files[2:5], count)
    assert not has_features(Path(path), [*files, "frame_000099.png"], count)
    spoil(Path(path))
    assert not has_features(Path(path), files, count)


def test_a_folder_whose_features_another_preparation_removed_recovers(matched, shots, tmp_path):
    """The mark that they are finished stayed; then the frames were said to have no texture."""
    root = shutil.copytree(matched, tmp_path / "made")
    SPOILT["without features"](root / ".prepare/colmap/features.db")
    (root / ".prepare/colmap/features.db-wal").write_bytes(bytes(5000))  # as a process that was killed leaves it
    (root / ".prepare/cameras.npz").unlink()
    assert (root / ".prepare/colmap/features.done").exists()
    pipeline.prepare(shots, root, OPTIONS)
    assert len(load_capture(root).train) == COUNT


def test_a_damaged_reconstruction_is_none(matched, tmp_path):
    folder = shutil.copytree(matched / ".prepare/colmap/model", tmp_path / "model")
    assert read_model(folder) is not None
    for path in folder.iterdir():
        path.write_bytes(path.read_bytes()[:20])
    assert read_model(folder) is None
    assert read_model(tmp_path / "missing") is None
