"""Whole preparations, from frames to a capture, and the errors that stop them."""

import dataclasses
import errno
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from tests.campaign.damage import replace_by_fifo
from tests.prepare import boards
from warpgs.captures.check import check_capture
from warpgs.captures.opening import load_capture
from warpgs.data.lens import Lens
from warpgs.data.results.masks import read_object_mask
from warpgs.prepare import pipeline
from warpgs.prepare.cameras.recovered import Cameras, NoCamerasError
from warpgs.prepare.cameras.sphere import points_around
from warpgs.prepare.journal import Journal
from warpgs.prepare.options import Options, Selection


def prepare(source, root, force=False, **options):
    return pipeline.prepare(source, root, Options(**options), force=force)


def interrupted(*arguments: object, **options: object) -> None:
    raise KeyboardInterrupt


def interrupt_before_the_capture_is_written(shots, root, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("warpgs.prepare.steps.write_capture", interrupted)
        with pytest.raises(KeyboardInterrupt):
            prepare(shots, root, masks="none", depth="none")


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    return boards.write_folder(tmp_path_factory.mktemp("prepare") / "shots", boards.record(24)[0])


@pytest.fixture(scope="module")
def few_shots(tmp_path_factory):
    return boards.write_folder(tmp_path_factory.mktemp("few") / "shots", boards.record(12)[0])


@pytest.fixture(scope="module")
def made(shots):
    root = shots.parent / "made"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "warpgs.prepare.masks.masker.WORKING_SIDE", boards.SIZE[0]
        )  # enlarged, it takes four times as long
        prepare(shots, root, holdout=8)
    return root


def distances(capture, count=24) -> np.ndarray:
    """Distances of the camera centres from the true ones after alignment, over the length of the path."""
    names = sorted(capture.cameras)
    poses = boards.poses(count)[[int(name[6:]) for name in names]]
    truth = -np.einsum("fji,fj->fi", poses[:, :, :3], poses[:, :, 3])
    found = np.array([capture.cameras[n].position.numpy() for n in names], np.float64)
    return boards.distances(found, truth) / np.ptp(truth, axis=0).max()


def test_every_frame_gets_its_true_camera(made):
    capture = load_capture(made)
    assert (len(capture.train), len(capture.val)) == (21, 3)
    assert np.median(distances(capture)) < 0.01
    assert distances(capture).max() < 0.03


def mean_overlap(capture, truth) -> float:
    """Mean intersection over union of the dynamic regions of the frames and the true ones."""
    frames = map(capture.frame, capture.cameras)
    return float(np.mean([boards.overlap(~f.static_mask.numpy(), truth[int(f.name[6:])]) for f in frames]))


def test_the_moving_board_is_masked(made):
    capture = load_capture(made)
    assert mean_overlap(capture, boards.record(24)[1]) > 0.7
    assert capture.estimated_masks


def test_masks_of_a_camera_on_a_tripod_need_no_cameras(tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", 192)
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", lambda *rest: pytest.fail("COLMAP was asked"))
    images, truth = boards.record(12, path=boards.still_pose)
    report = prepare(boards.write_folder(tmp_path / "shots", images), tmp_path / "made", camera="still")
    assert report["notes"][0].startswith("the focal length is assumed, 256 px")
    assert "the camera stays at one place" in report["notes"][1]
    assert report["steps"]["depth"] == "none"
    capture = load_capture(tmp_path / "made")
    assert mean_overlap(capture, truth) > 0.85
    positions = np.array([camera.position.numpy() for camera in capture.cameras.values()])
    assert np.ptp(positions, axis=0).max() == 0.0
    distances = np.linalg.norm(capture.points.numpy() - positions[0], axis=1)
    assert np.allclose(distances, distances[0], rtol=1e-5)


def test_a_video_in_which_nothing_seems_to_move_is_noted(tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", 192)
    shots = boards.write_folder(tmp_path / "shots", boards.record(12, moves=False, path=boards.still_pose)[0])
    notes = prepare(shots, tmp_path / "found", camera="still")["notes"]
    assert [note for note in notes if note.startswith("nothing seems to move: ")]
    (tmp_path / "masks").mkdir()
    for shot in shots.iterdir():
        cv2.imwrite(str(tmp_path / "masks" / shot.name), np.full(boards.SIZE[::-1], 255, np.uint8))
    notes = prepare(shots, tmp_path / "given", camera="still", masks=str(tmp_path / "masks"))["notes"]
    assert not [note for note in notes if note.startswith("nothing seems to move: ")]


def turned_cameras(folder, names, work, settings, quiet) -> Cameras:
    assert settings.turns
    poses = np.array([boards.turning_pose(k / (len(names) - 1)) for k in range(len(names))])
    return Cameras(names, boards.lens(), poses, np.zeros((0, 3)), 0.1, 0.0)


def test_what_moves_before_a_camera_that_turns_is_masked_and_depth_places_the_points(tmp_path, monkeypatch):
    def predict(images, weights, quiet):
        return [np.full(image.shape[:2], 3.0) + (np.arange(image.shape[1]) < 100) for image in images]

    monkeypatch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", 192)
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", turned_cameras)
    for module in ("checks", "depth.estimate"):
        monkeypatch.setattr(f"warpgs.prepare.{module}.find_weights", lambda *rest: tmp_path)
    monkeypatch.setattr("warpgs.prepare.depth.anything.predict", predict)
    images, truth = boards.record(14, path=boards.turning_pose)
    shots = boards.write_folder(tmp_path / "shots", images)
    prepare(shots, tmp_path / "made", camera="turning", depth="anything")
    capture = load_capture(tmp_path / "made")
    assert mean_overlap(capture, truth) > 0.75
    camera = capture.cameras["frame_000000"]
    depths = camera.project(capture.points)[2][:200]  # points of the first frame come first
    assert set(np.round((depths / depths.max()).numpy(), 2).tolist()) == {0.75, 1.0}
    assert capture.frame("frame_000000").inverse_depth is not None
    assert check_capture(tmp_path / "made").is_fit


def test_depth_that_says_nothing_places_no_points():
    cameras = Cameras(["a", "b", "c"], boards.lens(), np.tile(np.eye(4)[:3], (3, 1, 1)), np.zeros((0, 3)), 0.0, 0.0)
    masks = [np.zeros(boards.SIZE[::-1], bool)] * 3
    planes = [np.full((6, 8), np.nan), np.zeros((6, 8)), np.full((6, 8), 2.0)]
    count = len(points_around(cameras, masks))
    assert len(points_around(cameras, masks, planes)) == count // 3
    assert len(points_around(cameras, masks, planes[:2] * 2)) == 0
    assert len(points_around(cameras, [~mask for mask in masks])) == 0


@pytest.mark.parametrize(
    ("camera", "path", "message"),
    [
        ("moving", boards.pose, r"in static regions: 0 features .* check the masks, in which 0 must mean dynamic"),
        ("still", boards.still_pose, r"only 0 static points are left: nearly everything moves"),
    ],
)
def test_masks_of_everything_are_refused_with_advice(tmp_path, camera, path, message):
    shots = boards.write_folder(tmp_path / "shots", boards.record(12, path=path)[0])
    (tmp_path / "masks").mkdir()
    for path in shots.iterdir():
        cv2.imwrite(str(tmp_path / "masks" / path.name), np.zeros(boards.SIZE[::-1], np.uint8))
    with pytest.raises(ValueError, match=message):
        prepare(shots, tmp_path / "made", masks=str(tmp_path / "masks"), camera=camera)


def test_a_camera_that_does_not_stand_still_is_refused(shots, tmp_path):
    with pytest.raises(ValueError, match=r"only \d% of the corners stay where they are: the camera is not still"):
        prepare(shots, tmp_path / "made", camera="still")


def test_a_camera_that_does_not_turn_on_the_spot_is_refused(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", turned_cameras)
    monkeypatch.setattr(
        "warpgs.prepare.masks.methods.find_dynamic", lambda f, *rest: [i[..., 0] < 256 for i in f.images]
    )
    message = "100% of the pixels seem to move: the camera is not turning; try another --camera"
    with pytest.raises(ValueError, match=message):
        prepare(shots, tmp_path / "made", camera="turning")


def test_cameras_misled_by_dynamic_objects_are_recovered_without_them(tmp_path, monkeypatch):
    """With twelve frames the first pass finds a focal length of 181 px, not 230."""
    monkeypatch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", boards.SIZE[0])
    prepare(boards.write_folder(tmp_path / "shots", boards.record(12)[0]), tmp_path / "made", depth="none")
    capture = load_capture(tmp_path / "made")
    assert len(capture.train) == 12
    assert np.median(distances(capture, 12)) < 0.02
    assert mean_overlap(capture, boards.record(12)[1]) > 0.7


def test_a_prepared_capture_is_fit_to_train_on(made):
    report = check_capture(made)
    assert report.is_fit
    assert "24 of 24 frames have masks, 24 have depth" in str(report)


def test_a_contact_sheet_and_a_report_are_written_and_of_the_work_folder_only_the_state_remains(made):
    assert cv2.imread(str(made / "masks.png")).shape[1] == 6 * 256
    report = json.loads((made / "prepare.json").read_text())
    assert report["notes"] == []
    assert "24 of 24" in report["steps"]["cameras"]
    assert [path.name for path in (made / ".prepare").iterdir()] == ["state.json"]


def test_a_finished_capture_is_not_changed(made, shots):
    before = (made / "dataset.json").stat().st_mtime_ns
    prepare(shots, made, holdout=8)
    assert (made / "dataset.json").stat().st_mtime_ns == before


@pytest.mark.parametrize("option", ["camera", "holdout_camera"])
def test_a_capture_finished_before_there_was_an_option_stays_finished(made, shots, option):
    path = made / ".prepare" / "state.json"
    copy = path.read_text()
    state = json.loads(copy)
    del state["options"][option]
    path.write_text(json.dumps(state))
    prepare(shots, made, holdout=8)
    path.write_text(copy)


def test_other_options_require_force(made, shots):
    with pytest.raises(ValueError, match=r"other options \(holdout 8, now 4\).*--force"):
        prepare(shots, made, holdout=4)
    with pytest.raises(ValueError, match=r"other options \(count None, now 5\).*--force"):
        prepare(shots, made, holdout=8, selection=Selection(count=5))


def test_an_interrupted_preparation_continues_after_the_last_finished_step(
    few_shots, tmp_path, monkeypatch, no_comparison
):
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", boards.true_cameras)
    interrupt_before_the_capture_is_written(few_shots, tmp_path / "made", monkeypatch)
    for finished in ("take_frames", "recover_cameras"):
        monkeypatch.setattr(f"warpgs.prepare.steps.{finished}", lambda *arguments: pytest.fail("finished before"))
    prepare(few_shots, tmp_path / "made", masks="none", depth="none")
    capture = load_capture(tmp_path / "made")
    assert bool(capture.frame(capture.train[0]).static_mask.all())


def spoil_poses(path):
    cameras = Cameras.load(path.with_suffix(""))
    cameras.poses[0, 0, 0] = np.nan
    cameras.save(path.with_suffix(""))


DAMAGES = [
    ("frames/index_frame.json", lambda path: path.write_text("{}"), "frames"),
    (
        "frames/index_frame.json",
        lambda path: path.write_text('{"width": 3, "height": 3, "frames": [1]}'),
        "TypeError|not",
    ),
    ("frames/index_frame.json", replace_by_fifo, "is not a file"),
    ("first-cameras.npz", lambda path: path.write_bytes(path.read_bytes()[:-200]), "zip"),
    ("first-cameras.npz", spoil_poses, "a finite pose of every frame"),
    ("first-cameras.npz", replace_by_fifo, "is not a file"),
]


@pytest.mark.parametrize(("name", "damage", "reason"), DAMAGES, ids=[str(k) for k in range(len(DAMAGES))])
def test_a_damaged_result_of_an_earlier_call_is_refused_by_name(few_shots, tmp_path, monkeypatch, name, damage, reason):
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", boards.true_cameras)
    interrupt_before_the_capture_is_written(few_shots, tmp_path / "made", monkeypatch)
    (path,) = (tmp_path / "made/.prepare").glob(name.replace("first-cameras", "*cameras*"))
    damage(path)
    with pytest.raises(ValueError, match=rf"of an earlier call, is damaged \(.*{reason}.*\): use --force"):
        prepare(few_shots, tmp_path / "made", masks="none", depth="none")


def test_a_damaged_journal_is_refused(made, shots, tmp_path):
    root = shutil.copytree(made, tmp_path / "made")
    state = json.loads((root / ".prepare/state.json").read_text())
    for done in ([1], {"frames": 3}, {"frames": {"result": "x"}}, {"frames": {"result": "x", "seconds": "y"}}):
        (root / ".prepare/state.json").write_text(json.dumps({**state, "done": done}))
        with pytest.raises(ValueError, match="exists and was not made by prepare"):
            prepare(shots, root)


def test_a_frame_without_a_camera_is_noted_and_omitted(tmp_path):
    images = boards.record(10, moves=False)[0]
    stray = cv2.resize(boards.texture(5, boards.COLORS[1], 256, (20, 60)), boards.SIZE)
    shots = boards.write_folder(tmp_path / "shots", [*images[:6], stray, *images[6:]])
    report = prepare(shots, tmp_path / "made", masks="none", depth="none")
    assert report["notes"] == ["omitted, because no camera was found for them: frame_000006 (shot006.png)"]
    capture = load_capture(tmp_path / "made")
    assert len(capture.train) == 10
    assert "frame_000006" not in capture.cameras


def test_known_intrinsics_are_those_of_the_capture(few_shots, tmp_path, monkeypatch, no_comparison):
    """The file has the intrinsics of frames twice as large."""

    def recover(folder, names, work, settings, quiet):
        assert settings.known == Lens(*boards.SIZE, (230.0, 230.0), (130.0, 96.0))
        return dataclasses.replace(boards.true_cameras(folder, names), lens=settings.known)

    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", recover)
    (tmp_path / "cameras.txt").write_text("1 PINHOLE 512 384 460 460 260 192\n")
    prepare(few_shots, tmp_path / "made", masks="none", depth="none", intrinsics=tmp_path / "cameras.txt")
    K = load_capture(tmp_path / "made").cameras["frame_000000"].K
    assert K[:2].tolist() == [[230.0, 0.0, 130.0], [0.0, 230.0, 96.0]]


def test_given_masks_are_used_unchanged(few_shots, tmp_path, no_comparison):
    truth = boards.record(12)[1]
    (tmp_path / "masks").mkdir()
    for k, mask in enumerate(truth):
        cv2.imwrite(str(tmp_path / f"masks/shot{k:03d}.png"), np.where(mask, 0, 255).astype(np.uint8))
    prepare(few_shots, tmp_path / "made", masks=str(tmp_path / "masks"), depth="none", lens="SIMPLE_PINHOLE")
    capture = load_capture(tmp_path / "made")
    assert np.array_equal(capture.frame("frame_000010").static_mask.numpy(), ~truth[10])
    assert not capture.estimated_masks
    assert np.median(distances(capture, 12)) < 0.01


@pytest.mark.parametrize(("pattern", "ending"), [("shot{:03d}", ".png"), ("frame_{:06d}", ".png.png")])
def test_given_masks_and_frames_stay_as_they_are_with_the_lens_that_was_found(
    pattern, ending, tmp_path, monkeypatch, no_comparison
):
    distorted = dataclasses.replace(boards.lens(), coefficients=(-0.2,))

    def recover(folder, names, *rest):
        return dataclasses.replace(boards.true_cameras(folder, names), lens=distorted)

    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", recover)
    shots, mask = boards.write_folder(tmp_path / "shots", boards.record(24)[0][:8]), boards.record(24)[1][6]
    (tmp_path / "masks").mkdir()
    for k in range(8):
        cv2.imwrite(str(tmp_path / "masks" / (pattern.format(k) + ending)), np.where(mask, 0, 255).astype(np.uint8))
    prepare(shots, tmp_path / "made", masks=str(tmp_path / "masks"), depth="none")
    frame = load_capture(tmp_path / "made").frame("frame_000006")
    assert np.array_equal(~frame.static_mask.numpy(), mask)
    assert np.array_equal(frame.image.numpy(), cv2.imread(str(sorted(shots.iterdir())[6]))[..., ::-1])
    assert Lens.of(frame.camera).coefficients == pytest.approx((-0.2,))


def test_masks_of_another_aspect_ratio_are_refused_and_smaller_ones_enlarged(tmp_path):
    mask = np.where(boards.record(2)[1][0], 0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "half.png"), mask[::2, ::2])
    cv2.imwrite(str(tmp_path / "upright.png"), np.rot90(mask))
    assert (read_object_mask(tmp_path / "half.png", boards.SIZE) == (mask == 0)).mean() > 0.99
    double = np.full((2 * mask.shape[0], 2 * mask.shape[1]), 255, np.uint8)
    double[41, 60] = 0
    cv2.imwrite(str(tmp_path / "double.png"), double)
    assert np.argwhere(read_object_mask(tmp_path / "double.png", boards.SIZE)).tolist() == [[20, 30]]
    with pytest.raises(
        ValueError, match=r"upright\.png: the mask is 192×256, but the images of its camera are 256×192"
    ):
        read_object_mask(tmp_path / "upright.png", boards.SIZE)


def test_a_missing_mask_is_named(shots, tmp_path):
    (tmp_path / "masks").mkdir()
    with pytest.raises(ValueError, match=r"no mask for frame_000000 \(shot000.png\)"):
        prepare(shots, tmp_path / "made", masks=str(tmp_path / "masks"))


def test_a_folder_with_other_files_is_not_changed(shots, tmp_path):
    (tmp_path / "letter.txt").write_text("dear")
    with pytest.raises(ValueError, match="was not made by prepare"):
        prepare(shots, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["letter.txt"]


def test_force_removes_only_the_files_of_prepare(shots, tmp_path, monkeypatch):
    (tmp_path / "letter.txt").write_text("dear")
    (tmp_path / "rgb").mkdir()
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", interrupted)
    with pytest.raises(KeyboardInterrupt):
        prepare(shots, tmp_path, force=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".prepare", "letter.txt"]
    assert sorted(path.name for path in (tmp_path / ".prepare").iterdir()) == ["background", "frames", "state.json"]


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("name", ["dataset.json", "rgb/own.png", "rgb/1x/frame_000000.png"])
def test_a_capture_that_prepare_did_not_make_is_never_replaced(name, force, shots, tmp_path):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match=f"which would replace its {name.split('/')[0]}: choose another folder$"):
        prepare(shots, tmp_path, force=force)
    assert sorted(tmp_path.rglob("*")) == before
    assert path.read_text() == "mine"


def test_other_files_in_the_folders_of_a_replaced_capture_are_kept(made, shots, tmp_path, monkeypatch):
    root = shutil.copytree(made, tmp_path / "made")
    names = ("rgb/notes.txt", "depth/lidar/frame.npy", "resized_mask/1x/drawing.png", "rgb/1x/frame_000000.png.bak")
    kept = [root / name for name in names]
    elsewhere = tmp_path / "elsewhere"
    (root / "depth/1x").rename(elsewhere)
    (root / "depth/1x").symlink_to(elsewhere)
    for path in kept:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", interrupted)
    with pytest.raises(KeyboardInterrupt):
        prepare(shots, root, force=True, holdout=8)
    left = {path for path in root.rglob("*") if path.is_file() and ".prepare" not in path.parts}
    assert left == set(kept)
    assert not (root / "depth/1x").is_symlink()
    assert elsewhere.is_dir()
    assert all(path.read_text() == "mine" for path in kept)


@pytest.mark.parametrize("options", [{"selection": Selection(fps=2.0)}, {"source": Path("no/such.mp4")}])
def test_a_capture_is_kept_if_its_replacement_cannot_start(options, made, shots, tmp_path):
    root = shutil.copytree(made, tmp_path / "made")
    before = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    with pytest.raises(ValueError, match=r"is missing|--fps is for videos"):
        prepare(**{"source": shots, **options}, root=root, force=True)
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == before


def test_a_replacement_interrupted_while_files_are_removed_is_not_finished(made, shots, tmp_path, monkeypatch):
    root = shutil.copytree(made, tmp_path / "made")
    options = json.loads((root / ".prepare/state.json").read_text())["options"]
    assert Journal(root, options, force=False, log=None).is_finished
    monkeypatch.setattr("warpgs.prepare.journal._remove_frames", interrupted)
    with pytest.raises(KeyboardInterrupt):
        prepare(shots, root, force=True, holdout=8)
    monkeypatch.undo()
    assert not Journal(root, options, force=False, log=None).is_finished


def test_an_unfinished_capture_may_be_continued_with_other_options(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", interrupted)
    for count in (8, 6):
        with pytest.raises(KeyboardInterrupt):
            prepare(shots, tmp_path / "made", selection=Selection(count=count), masks="none")
        assert len(list((tmp_path / "made/.prepare/frames").glob("*.png"))) == count


def test_a_capture_is_not_a_folder_of_images(tmp_path):
    (tmp_path / "made").mkdir()
    (tmp_path / "made/dataset.json").write_text("{}")
    with pytest.raises(ValueError, match=r"made is a capture: warpgs train --data .*made trains on it"):
        prepare(tmp_path / "made", tmp_path / "again")


def test_inputs_are_never_replaced(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.checks.find_weights", lambda *arguments: None)
    (inside := tmp_path / "resized_mask/1x").mkdir(parents=True)
    for name, source, options in (
        ("source", inside, {}),
        ("masks", shots, {"masks": str(inside)}),
        ("weights", shots, {"masks": "sam2", "weights": inside}),
    ):
        for root in (inside, tmp_path):
            with pytest.raises(ValueError, match=f"contains the {name}"):
                prepare(source, root, force=True, **options)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"holdout": 1}, "--holdout"),
        ({"holdout": -2}, "--holdout"),
        ({"focal": -1.0}, "--focal must be positive"),
        ({"masks": "nowhere"}, "--masks must be motion, sam2, none or a folder of masks; nowhere is not a folder"),
        ({"depth": "lidar"}, "--depth must be one of flow, anything, none, got 'lidar'"),
        ({"selection": Selection(count=1)}, "--count"),
        ({"camera": "turning", "depth": "flow"}, "--depth flow needs a camera that moves, with --camera turning there"),
        ({"camera": "turning", "lens": "OPENCV_FISHEYE"}, "--lens OPENCV_FISHEYE needs a camera that moves"),
        ({"intrinsics": Path("no.json")}, r"no\.json is missing"),
        ({"intrinsics": Path("no.json"), "focal": 5.0}, "says all about the lens: omit --focal and --lens"),
        ({"intrinsics": Path("no.json"), "lens": "OPENCV"}, "omit --focal and --lens"),
    ],
)
def test_invalid_options_are_refused(options, word, shots, tmp_path):
    with pytest.raises(ValueError, match=word):
        prepare(shots, tmp_path / "made", **options)


@pytest.mark.parametrize(
    ("options", "word"),
    [({}, "9 frames are too few to find what moves, at least 10"), ({"masks": "none", "holdout": 18}, "--holdout 18")],
)
def test_too_few_frames_for_the_options_are_refused(options, word, tmp_path):
    shots = boards.write_folder(tmp_path / "shots", [np.zeros((64, 64, 3), np.uint8)] * 9)
    with pytest.raises(ValueError, match=word):
        prepare(shots, tmp_path / "made", **options)


UNUSABLE = {
    "at rest": (lambda: boards.record(10, travel=0.0, moves=False)[0], "move the camera sideways|walk around"),
    "no texture": (lambda: [np.full((96, 128, 3), 128, np.uint8)] * 10, "any texture: 0 features .* in more light$"),
    "unrelated": (
        lambda: [boards.texture(k, boards.COLORS[0], 256, (20, 60)) for k in range(10)],
        "no two frames show enough of the same static surfaces",
    ),
}


@pytest.mark.parametrize(("images", "message"), UNUSABLE.values(), ids=UNUSABLE)
def test_images_without_parallax_or_texture_or_that_are_unrelated_are_refused_with_advice(images, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        prepare(boards.write_folder(tmp_path / "shots", images()), tmp_path / "made")


def test_a_full_disk_is_reported_before_work_starts(shots, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=5_000_000))
    with pytest.raises(OSError, match="of disk are needed, 5 MB are free"):
        prepare(shots, tmp_path / "made")


def test_a_replacement_does_not_keep_the_colors_of_old_points(tmp_path):
    np.save(tmp_path / "point_colors.npy", np.zeros((2, 3), np.uint8))
    (tmp_path / "prepare.json").write_text("{}")
    journal = Journal(tmp_path, {}, force=True, log=None)
    journal.clear(journal.work / "frames")
    assert not (tmp_path / "point_colors.npy").exists()


def test_colmap_does_not_start_on_a_full_disk(shots, tmp_path, monkeypatch):
    disk = SimpleNamespace(free=10**12)
    monkeypatch.setattr("shutil.disk_usage", lambda path: disk)
    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", lambda *arguments: pytest.fail("was started"))
    clear = Journal.clear

    def clear_and_fill(self, keep):
        clear(self, keep)
        disk.free = 3_000_000  # other programs fill the disk

    monkeypatch.setattr(Journal, "clear", clear_and_fill)
    message = "6 MB of disk are needed, 3 MB are free; free some disk space and run the same command again"
    for _ in range(2):
        with pytest.raises(OSError, match=message):
            prepare(shots, tmp_path / "made")


@pytest.mark.parametrize("error", [NoCamerasError("few features"), ValueError("COLMAP failed")])
def test_cameras_of_the_first_pass_are_kept_if_masks_leave_too_little(
    error, few_shots, tmp_path, monkeypatch, no_comparison
):
    def recover(folder, names, work, settings, quiet):
        if settings.masks is not None:
            raise error
        return boards.true_cameras(folder, names)

    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", recover)
    monkeypatch.setattr("warpgs.prepare.masks.still.find_dynamic", lambda f, *rest: [i[..., 0] > 255 for i in f.images])
    monkeypatch.setattr("warpgs.prepare.masks.masker.WORKING_SIDE", boards.SIZE[0] // 2)
    if isinstance(error, NoCamerasError):
        notes = prepare(few_shots, tmp_path / "made", depth="none")["notes"]
        assert (
            notes[0]
            == "the cameras may be wrong: they are from before what moves was masked, because after that few features"
        )
    else:
        with pytest.raises(ValueError, match="COLMAP failed"):
            prepare(few_shots, tmp_path / "made", depth="none")


def test_the_error_of_a_disk_that_fills_up_says_how_to_continue(shots, tmp_path, monkeypatch):
    def fill_up(*arguments):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("warpgs.prepare.steps.take_frames", fill_up)
    with pytest.raises(OSError, match=r"the disk is full; free some disk space and run the same command again$"):
        prepare(shots, tmp_path / "made")


def test_if_nearly_everything_seems_to_move_the_error_suggests_masks(few_shots, tmp_path, monkeypatch):
    shapes = set()

    def all_dynamic(frames, *rest):
        shapes.update(image.shape for image in frames.images)
        return [np.ones(image.shape[:2], bool) for image in frames.images]

    monkeypatch.setattr("warpgs.prepare.steps.recover_cameras", boards.true_cameras)
    monkeypatch.setattr("warpgs.prepare.masks.methods.find_dynamic", all_dynamic)
    with pytest.raises(ValueError, match=r"100% of the pixels seem to move.*--masks FOLDER"):
        prepare(few_shots, tmp_path / "made")
    assert shapes == {(384, 512, 3), (192, 256, 3)}  # small images are enlarged; then half of that size
