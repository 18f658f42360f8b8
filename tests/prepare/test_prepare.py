"""From pictures to a capture, whole, and what stops it."""

import dataclasses
import errno
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.prepare import filmed
from warpgs.data.check import check_capture
from warpgs.data.lens import undistort
from warpgs.data.loaders import load_capture
from warpgs.prepare.frames import Selection
from warpgs.prepare.given_masks import read_moving
from warpgs.prepare.options import Options
from warpgs.prepare.pipeline import Preparation
from warpgs.prepare.sfm import Cameras, NoCamerasError


def prepare(source, root, force=False, **options):
    return Preparation(root, Options(source, **options), force, quiet=True).run()


def interrupted(*arguments: object) -> None:
    raise KeyboardInterrupt


def true_cameras(folder, names, *rest) -> Cameras:
    return Cameras(names, filmed.lens(), filmed.poses(len(names)), filmed.points(), 0.1, 10.0)


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    return filmed.write_folder(tmp_path_factory.mktemp("prepare") / "shots", filmed.film(24)[0])


@pytest.fixture(scope="module")
def made(shots):
    root = shots.parent / "made"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("warpgs.prepare.pipeline.WORKING_SIDE", filmed.SIZE[0])  # enlarged, it takes four times as long
        prepare(shots, root, holdout=8)
    return root


def distances(capture, count=24) -> np.ndarray:
    """Of the cameras' centres from the true ones after the best similarity, over the length of the path."""
    names = sorted(capture.cameras)
    poses = filmed.poses(count)[[int(name[6:]) for name in names]]
    truth = -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])
    found = np.array([capture.cameras[n].position.numpy() for n in names], np.float64)
    a, b = found - found.mean(0), truth - truth.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = (s * np.diag(turn)).sum() / (a**2).sum()
    return np.linalg.norm(scale * a @ (u @ turn @ vt).T - b, axis=1) / np.ptp(truth, axis=0).max()


def test_every_frame_gets_its_true_camera(made):
    capture = load_capture(made)
    assert (len(capture.train), len(capture.val)) == (21, 3)
    assert np.median(distances(capture)) < 0.01
    assert distances(capture).max() < 0.03


def overlap(capture, count=24) -> float:
    """Mean intersection over union of what the masks call moving and of what moves."""
    truth, shares = filmed.film(count)[1], []
    for name in capture.cameras:
        moving, true = ~capture.frame(name).static_mask.numpy(), truth[int(name[6:])]
        shares.append((moving & true).sum() / (moving | true).sum())
    return float(np.mean(shares))


def test_the_board_that_moves_is_masked(made):
    assert overlap(load_capture(made)) > 0.7


def test_cameras_misled_by_what_moves_are_found_again_without_it(tmp_path):
    """Of twelve frames the first pass has a focal length of 160 px instead of 230: 90 % of the pixels seem to move."""
    prepare(filmed.write_folder(tmp_path / "shots", filmed.film(12)[0]), tmp_path / "made", depth="none")
    capture = load_capture(tmp_path / "made")
    assert len(capture.train) == 12
    assert np.median(distances(capture, 12)) < 0.02
    assert overlap(capture, 12) > 0.7


def test_what_is_made_is_fit_to_train_on(made):
    report = check_capture(made)
    assert report.is_fit
    assert "24 of 24 frames have masks, 24 have depth" in str(report)


def test_a_contact_sheet_and_a_report_are_written(made):
    assert cv2.imread(str(made / "masks.png")).shape[1] == 6 * 256
    report = json.loads((made / "prepare.json").read_text())
    assert report["notes"] == []
    assert "24 of 24" in report["steps"]["cameras"]


def test_only_a_small_state_is_left_of_the_work(made):
    assert [path.name for path in (made / ".prepare").iterdir()] == ["state.json"]


def test_a_finished_capture_is_not_made_again(made, shots):
    before = (made / "dataset.json").stat().st_mtime_ns
    prepare(shots, made, holdout=8)
    assert (made / "dataset.json").stat().st_mtime_ns == before


def test_other_options_need_force(made, shots):
    with pytest.raises(ValueError, match=r"other options \(holdout\).*--force"):
        prepare(shots, made, holdout=4)


def test_a_stopped_attempt_goes_on_where_it_stopped(shots, tmp_path, monkeypatch):
    stopped = Preparation(tmp_path / "made", Options(shots, masks="none", depth="none"), quiet=True)
    monkeypatch.setattr(stopped, "_capture", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        stopped.run()
    again = Preparation(tmp_path / "made", Options(shots, masks="none", depth="none"), quiet=True)
    for finished in ("_frames", "_cameras"):
        monkeypatch.setattr(again, finished, lambda: pytest.fail("was done before"))
    again.run()
    capture = load_capture(tmp_path / "made")
    assert bool(capture.frame(capture.train[0]).static_mask.all())


def test_a_frame_that_can_not_be_placed_is_named_and_left_out(tmp_path):
    images = filmed.film(10)[0]
    stray = cv2.resize(filmed.texture(5, filmed.COLORS[1], 256, (20, 60)), filmed.SIZE)
    shots = filmed.write_folder(tmp_path / "shots", [*images[:6], stray, *images[6:]])
    report = prepare(shots, tmp_path / "made", masks="none", depth="none")
    assert report["notes"] == ["left out, because no camera was found for them: frame_000006 (shot006.png)"]
    capture = load_capture(tmp_path / "made")
    assert len(capture.train) == 10
    assert "frame_000006" not in capture.cameras


def test_given_masks_are_taken_as_they_are(shots, tmp_path):
    (tmp_path / "masks").mkdir()
    for k, mask in enumerate(filmed.film(24)[1]):
        cv2.imwrite(str(tmp_path / f"masks/shot{k:03d}.png"), np.where(mask, 0, 255).astype(np.uint8))
    prepare(shots, tmp_path / "made", masks=str(tmp_path / "masks"), depth="none", lens="SIMPLE_PINHOLE")
    capture = load_capture(tmp_path / "made")
    assert np.array_equal(capture.frame("frame_000010").static_mask.numpy(), ~filmed.film(24)[1][10])
    assert np.median(distances(capture)) < 0.01


@pytest.mark.parametrize("ending", [".png", ".png.png"])
def test_masks_drawn_over_straight_pictures_are_not_straightened_again(ending, shots, tmp_path, monkeypatch):
    bent = dataclasses.replace(filmed.lens(), radial=(-0.2, 0.0, 0.0))

    def recover(folder, names, *rest):
        return dataclasses.replace(true_cameras(folder, names), lens=bent)

    monkeypatch.setattr("warpgs.prepare.pipeline.recover_cameras", recover)
    mask = filmed.film(24)[1][10]
    for kind, expected in (("shot{:03d}", undistort(mask, bent)), ("frame_{:06d}", mask)):
        folder = tmp_path / kind[:4]
        folder.mkdir()
        for k in range(24):
            cv2.imwrite(str(folder / (kind.format(k) + ending)), np.where(mask, 0, 255).astype(np.uint8))
        prepare(shots, tmp_path / kind[:3], masks=str(folder), depth="none")
        capture = load_capture(tmp_path / kind[:3])
        assert np.array_equal(~capture.frame("frame_000010").static_mask.numpy(), expected)
    assert (mask != undistort(mask, bent)).sum() > 100


def test_masks_of_another_shape_are_refused_by_name_and_smaller_ones_are_enlarged(tmp_path):
    mask = np.where(filmed.film(2)[1][0], 0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "half.png"), mask[::2, ::2])
    cv2.imwrite(str(tmp_path / "upright.png"), np.rot90(mask))
    assert (read_moving(tmp_path / "half.png", filmed.SIZE) == (mask == 0)).mean() > 0.99
    with pytest.raises(ValueError, match=r"upright\.png: the mask is 192×256, .* the 256×192 frame"):
        read_moving(tmp_path / "upright.png", filmed.SIZE)


def test_a_missing_mask_is_named(shots, tmp_path):
    (tmp_path / "masks").mkdir()
    with pytest.raises(ValueError, match=r"no mask for frame_000000 \(shot000.png\)"):
        prepare(shots, tmp_path / "made", masks=str(tmp_path / "masks"))


def test_a_folder_with_something_else_is_not_touched(shots, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(ValueError, match="was not begun by prepare"):
        prepare(shots, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_force_removes_only_what_prepare_makes(shots, tmp_path, monkeypatch):
    (tmp_path / "letter.txt").write_text("dear")
    (tmp_path / "rgb").mkdir()
    monkeypatch.setattr("warpgs.prepare.pipeline.recover_cameras", interrupted)
    with pytest.raises(KeyboardInterrupt):
        prepare(shots, tmp_path, force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".prepare", "letter.txt"]
    assert sorted(path.name for path in (tmp_path / ".prepare").iterdir()) == ["frames", "state.json"]


@pytest.mark.parametrize("options", [{"selection": Selection(fps=2.0)}, {"source": Path("no/such.mp4")}])
def test_a_capture_is_kept_where_its_replacement_can_not_begin(options, made, shots, tmp_path):
    root = shutil.copytree(made, tmp_path / "made")
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=r"is missing|--fps is for videos"):
        prepare(**{"source": shots, **options}, root=root, force=True)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before


def test_a_replacement_stopped_while_it_removes_is_not_taken_for_finished(made, shots, tmp_path, monkeypatch):
    root = shutil.copytree(made, tmp_path / "made")
    monkeypatch.setattr("warpgs.prepare.journal.shutil", SimpleNamespace(rmtree=interrupted))
    with pytest.raises(KeyboardInterrupt):
        prepare(shots, root, force=True, holdout=8)
    monkeypatch.undo()
    assert not Preparation(root, Options(shots, holdout=8), quiet=True).attempt.is_finished


def test_what_failed_may_be_tried_with_other_options(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.pipeline.recover_cameras", interrupted)
    for count in (8, 6):
        with pytest.raises(KeyboardInterrupt):
            prepare(shots, tmp_path / "made", selection=Selection(count=count), masks="none")
        assert len(list((tmp_path / "made/.prepare/frames").glob("*.png"))) == count


def test_what_is_read_is_never_replaced(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.options.find_weights", lambda *arguments: None)
    (tmp_path / "resized_mask/1x").mkdir(parents=True)
    inside = tmp_path / "resized_mask/1x"
    for what, options in {
        "source": Options(inside),
        "masks": Options(shots, masks=str(inside)),
        "weights": Options(shots, masks="sam2", weights=inside),
    }.items():
        for root in (inside, tmp_path):
            with pytest.raises(ValueError, match=f"holds the {what}"):
                Preparation(root, options, force=True)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"holdout": 1}, "--holdout"),
        ({"holdout": -2}, "--holdout"),
        ({"masks": "nowhere"}, "--masks"),
        ({"selection": Selection(count=1)}, "--count"),
    ],
)
def test_impossible_options_are_refused(options, word, shots, tmp_path):
    with pytest.raises(ValueError, match=word):
        prepare(shots, tmp_path / "made", **options)


@pytest.mark.parametrize(
    ("options", "word"),
    [({}, "9 frames are too few to find what moves, at least 10"), ({"masks": "none", "holdout": 18}, "--holdout 18")],
)
def test_too_few_frames_for_what_is_asked_are_refused(options, word, tmp_path):
    shots = filmed.write_folder(tmp_path / "shots", [np.zeros((64, 64, 3), np.uint8)] * 9)
    with pytest.raises(ValueError, match=word):
        prepare(shots, tmp_path / "made", **options)


def test_a_camera_that_stands_still_is_refused_with_advice(tmp_path):
    still = filmed.write_folder(tmp_path / "still", filmed.film(10, travel=0.0, moves=False)[0])
    with pytest.raises(ValueError, match=r"move the camera sideways|walk around"):
        prepare(still, tmp_path / "made")


def test_pictures_without_texture_are_refused_with_advice(tmp_path):
    grey = filmed.write_folder(tmp_path / "grey", [np.full((96, 128, 3), 128, np.uint8)] * 10)
    with pytest.raises(ValueError, match="hardly any texture"):
        prepare(grey, tmp_path / "made")


def test_a_full_disk_is_told_before_work_starts(shots, tmp_path, monkeypatch):
    class Usage:
        free = 5_000_000

    monkeypatch.setattr("shutil.disk_usage", lambda path: Usage)
    with pytest.raises(OSError, match="of disk are needed, 5 MB are free"):
        prepare(shots, tmp_path / "made")


def test_colmap_does_not_start_on_a_full_disk(shots, tmp_path, monkeypatch):
    class Usage:
        free = 10**12

    monkeypatch.setattr("shutil.disk_usage", lambda path: Usage)
    monkeypatch.setattr("warpgs.prepare.pipeline.recover_cameras", lambda *arguments: pytest.fail("was started"))
    made = Preparation(tmp_path / "made", Options(shots), quiet=True)
    made.attempt.step("frames", made._frames)
    monkeypatch.setattr(Usage, "free", 3_000_000)  # filled by others
    with pytest.raises(OSError, match="6 MB of disk are needed, 3 MB are free; make room and run the same command"):
        prepare(shots, tmp_path / "made")


@pytest.mark.parametrize(
    ("error", "falls_back"), [(NoCamerasError("few features"), True), (ValueError("COLMAP failed"), False)]
)
def test_only_masks_that_leave_too_little_are_done_without(error, falls_back, shots, tmp_path, monkeypatch):
    def recover(folder, names, work, lens, masks, *rest):
        if masks is not None:
            raise error
        return true_cameras(folder, names)

    monkeypatch.setattr("warpgs.prepare.pipeline.recover_cameras", recover)
    monkeypatch.setattr("warpgs.prepare.pipeline.find_moving", lambda images, *rest: [i[..., 0] > 255 for i in images])
    if falls_back:
        notes = prepare(shots, tmp_path / "made", depth="none")["notes"]
        assert notes == ["the cameras are those of the first pass, without masks: with masks, few features"]
    else:
        with pytest.raises(ValueError, match="COLMAP failed"):
            prepare(shots, tmp_path / "made", depth="none")


def test_a_disk_that_fills_up_is_told_with_how_to_go_on(shots, tmp_path, monkeypatch):
    def fill_up(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("warpgs.prepare.pipeline.take_frames", fill_up)
    with pytest.raises(OSError, match=r"the disk is full; make room and run the same command again$"):
        prepare(shots, tmp_path / "made")


def test_pictures_that_share_nothing_are_refused_with_advice(tmp_path):
    unrelated = [filmed.texture(k, filmed.COLORS[0], 256, (20, 60)) for k in range(10)]
    with pytest.raises(ValueError, match="no two frames show enough of the same static things"):
        prepare(filmed.write_folder(tmp_path / "unrelated", unrelated), tmp_path / "made")


def test_masks_of_everything_are_refused_with_advice(shots, tmp_path):
    (tmp_path / "masks").mkdir()
    for path in shots.iterdir():
        cv2.imwrite(str(tmp_path / "masks" / path.name), np.zeros(filmed.SIZE[::-1], np.uint8))
    with pytest.raises(ValueError, match=r"hardly any texture where nothing moves: 0 features .* check the masks"):
        prepare(shots, tmp_path / "made", masks=str(tmp_path / "masks"))


def test_where_nearly_everything_seems_to_move_masks_are_asked_for(tmp_path, monkeypatch):
    shapes = set()

    def all_moves(images, *rest):
        shapes.update(image.shape for image in images)
        return [np.ones(image.shape[:2], bool) for image in images]

    shots = filmed.write_folder(tmp_path / "shots", filmed.film(10)[0])
    monkeypatch.setattr("warpgs.prepare.pipeline.find_moving", all_moves)
    with pytest.raises(ValueError, match=r"100% of the pixels seem to move.*--masks FOLDER"):
        prepare(shots, tmp_path / "made")
    assert shapes == {(384, 512, 3), (192, 256, 3)}  # small pictures are enlarged; again in half of that
