"""``warpgs prepare CAPTURE --add``: what a capture lacks is made with its own cameras."""

import json
import shutil
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.data import captures, layouts
from tests.data.captures import edit_json
from tests.prepare import boards
from warpgs.captures.opening import load_capture
from warpgs.cli import main
from warpgs.data import images
from warpgs.data.images import decode, read_depth
from warpgs.data.loaders import recognize
from warpgs.data.writer import STATE, WORK
from warpgs.prepare import add
from warpgs.prepare.add import AddOptions, add_parts
from warpgs.prepare.frames.flow import Flows
from warpgs.prepare.masks import methods
from warpgs.prepare.masks.masker import Masker

COUNT = 12
NAMES = [f"shot{k:03d}" for k in range(COUNT)]


def is_red(image):
    """The moving board is the only red thing."""
    red, green, blue = image.astype(int).transpose(2, 0, 1)
    return (red > 1.6 * green) & (red > 1.6 * blue)


def red_part(root, name):
    return is_red(cv2.cvtColor(decode(root / f"rgb/1x/{name}.png"), cv2.COLOR_BGR2RGB))


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    root = boards.write_capture(tmp_path_factory.mktemp("add") / "capture", COUNT, holdout=6)
    shutil.rmtree(root / "frames")
    shutil.rmtree(root / "resized_mask")
    return root


@pytest.fixture
def root(original, tmp_path):
    return shutil.copytree(original, tmp_path / "capture")


@pytest.fixture(autouse=True)
def _red(monkeypatch):
    """A masker that finds what is red."""
    monkeypatch.setitem(
        methods.MASKERS, "red", Masker(lambda frames, weights, quiet: [is_red(i) for i in frames.images])
    )


STATIC = np.full((192, 256), 255, np.uint8)


def write_mask(root, name, mask=STATIC):
    captures.write_png(root / f"resized_mask/1x/{name}.png.png", mask)


def written_mask(root, name, size="1x"):
    return decode(root / f"resized_mask/{size}/{name}.png.png") == 0


def test_masks_fit_the_files_of_frames_with_lenses_of_their_own(root, capsys):
    for k, name in enumerate(NAMES):
        lens = {"focal_length": boards.FOCAL + 3.0 * k, "radial_distortion": [0.02 * k, 0.0, 0.0]}
        edit_json(root / f"camera/{name}.json", **lens)
    assert main(["prepare", str(root), "--add", "masks", "--masks", "red"]) == 0
    assert "masks: 12 frames" in capsys.readouterr().out
    for name in NAMES:
        assert boards.overlap(written_mask(root, name), red_part(root, name)) > 0.9, name
        assert written_mask(root, name, "2x").shape == (96, 128)
    capture = load_capture(root)
    assert all(capture.frame(name).static_mask is not None for name in NAMES)
    assert capture.estimated_masks
    assert (root / "masks.png").is_file()


def test_masks_that_are_there_stay(root):
    for name in NAMES:
        write_mask(root, name)
    lines = []
    add_parts(root, AddOptions(["masks"], masks="red"), lines.append)
    assert lines == ["masks: 12 frames had them in some sizes only", "masks: all frames have them"]
    assert not load_capture(root).estimated_masks
    assert not written_mask(root, "shot003").any()


def test_masks_that_only_some_training_frames_lack_are_made(root):
    """Three of twelve frames have masks, in one of two sizes."""
    drawn = STATIC.copy()
    drawn[40:80, 60:100] = 0
    for name in NAMES[2:5]:
        write_mask(root, name, drawn)
    with pytest.raises(ValueError, match=r"needs its mask; warpgs prepare .*capture --add masks makes those"):
        load_capture(root)
    lines = []
    add_parts(root, AddOptions(["masks"], masks="red"), lines.append)
    assert lines[0] == "masks: 3 frames had them in some sizes only"
    assert lines[1].startswith("masks: 9 frames")
    for name in NAMES:
        expected = drawn == 0 if name in NAMES[2:5] else red_part(root, name)
        assert boards.overlap(written_mask(root, name), expected) > 0.9, name
        halved = cv2.resize(expected.astype(np.uint8), (128, 96)) > 0
        assert boards.overlap(written_mask(root, name, "2x"), halved) > 0.8
    assert (written_mask(root, NAMES[3]) == (drawn == 0)).all()
    assert load_capture(root, factor=2).frame(NAMES[3]).static_mask is not None


def test_masks_are_known_as_estimates_if_the_next_part_fails(root, monkeypatch):
    def fail(*arguments):
        raise ValueError("no depth here")

    monkeypatch.setattr(add._Job, "add_depth", fail)
    with pytest.raises(ValueError, match="no depth here"):
        add_parts(root, AddOptions(["masks", "depth"], masks="red"))
    assert load_capture(root).estimated_masks


def test_masks_of_one_size_in_a_folder_that_gets_no_new_ones_are_refused(root):
    for name in NAMES:
        captures.write_png(root / f"mask/2x/{name}.png.png", STATIC[::2, ::2])
    with pytest.raises(ValueError, match=r"has masks in mask/, but new ones go to resized_mask/: rename"):
        add_parts(root, AddOptions(["masks"], masks="red"))


def test_depth_is_not_added_beside_incomplete_masks(root):
    """What moves in the other frames would count as static."""
    write_mask(root, NAMES[2])
    with pytest.raises(ValueError, match="every training frame needs its mask"):
        add_parts(root, AddOptions(["depth"]))


def test_nothing_is_added_to_a_capture_that_is_not_finished(root):
    (root / WORK).mkdir()
    (root / WORK / STATE).write_text('{"done": {}}')
    with pytest.raises(ValueError, match="is not finished: warpgs prepare was interrupted"):
        add_parts(root, AddOptions(["masks"], masks="red"))
    assert not (root / "resized_mask").exists()


def test_masks_are_not_split_over_two_folders(root):
    """Masks of the training frames in mask/, none of the evaluation frames."""
    train = load_capture(root).train
    for name in train:
        write_mask(root, name)
    (root / "resized_mask").rename(root / "mask")
    with pytest.raises(ValueError, match=r"has masks in mask/, but new ones go to resized_mask/: rename"):
        add_parts(root, AddOptions(["masks"], masks="red"))
    assert not (root / "resized_mask").exists()
    (root / "mask").rename(root / "resized_mask")
    add_parts(root, AddOptions(["masks"], masks="red"))
    assert [written_mask(root, name).any() for name in NAMES] == [name not in train for name in NAMES]
    assert not load_capture(root).estimated_masks  # those of the training frames are given


def test_depth_and_points_are_those_of_the_scene(root):
    points = np.load(root / "points.npy")
    (root / "points.npy").unlink()
    add_parts(root, AddOptions(["depth", "points"]))
    found = np.load(root / "points.npy")
    colors = np.load(root / "point_colors.npy")
    assert len(found) > 1000
    assert colors.shape == found.shape
    planes = np.array([center[2] for center, _ in boards.PLANES])
    distance = np.abs(found[:, 2:] - planes).min(1)
    assert np.median(distance) < 0.1
    assert points[:, 2].min() - 0.5 < np.median(found[:, 2]) < points[:, 2].max() + 0.5
    for k in (0, 5, 11):
        depth = read_depth(root / f"depth/1x/{NAMES[k]}.npy", boards.SIZE)
        truth = 1.0 / boards.depth(boards.poses(COUNT)[k])
        known = np.isfinite(depth)
        assert known.mean() > 0.3
        ratio = depth[known] / truth[known]
        assert np.median(np.abs(ratio / np.median(ratio) - 1.0)) < 0.03


def enlarge(root):
    """Makes the capture's images 512 px wide, the size at which masks and depth are estimated."""
    shutil.rmtree(root / "rgb/2x")
    for path in (root / "rgb/1x").iterdir():
        captures.write_png(path, cv2.resize(cv2.cvtColor(decode(path), cv2.COLOR_BGR2RGB), None, fx=2, fy=2))
    for path in (root / "camera").iterdir():
        fields = {"focal_length": 2 * boards.FOCAL, "principal_point": [256.0, 192.0], "image_size": [512, 384]}
        edit_json(path, **fields)


def test_masks_depth_and_points_share_decoded_images_and_optical_flow(root, monkeypatch):
    enlarge(root)
    (root / "points.npy").unlink()
    compute, decoded, pairs, read = Flows.compute, images._decode, [], Counter()

    def counted_flow(self, a, b, *start, **options):
        indices = [next((k for k, plane in enumerate(self.planes) if plane is image), None) for image in (a, b)]
        if None not in indices:  # not warped, see ``Revisits``
            pairs.append(tuple(indices))
        return compute(self, a, b, *start, **options)

    def counted_file(path, *arguments):
        read[Path(path).relative_to(root).parts[0]] += 1
        return decoded(path, *arguments)

    monkeypatch.setattr(Flows, "compute", counted_flow)
    monkeypatch.setattr(images, "_decode", counted_file)
    add_parts(root, AddOptions(["masks", "depth", "points"]))
    assert len(pairs) == len(set(pairs)) > 50
    assert read == {"rgb": COUNT, "resized_mask": COUNT}
    assert len(list((root / "depth/1x").iterdir())) == COUNT


@pytest.mark.parametrize("part", ["depth", "points"])
def test_a_camera_that_stays_at_one_place_gives_no_depth_by_optical_flow(root, part):
    (root / "points.npy").unlink()
    for path in (root / "camera").iterdir():
        edit_json(path, position=[0.1, 0.2, 0.3])
    with pytest.raises(ValueError, match="each camera stays at one place"):
        add_parts(root, AddOptions([part]))


def add_still_camera(root):
    """Adds a second camera that stands still, with smaller images between the times of the first."""
    index, metadata = (json.loads((root / f"{name}.json").read_text()) for name in ("dataset", "metadata"))
    shots = boards.record(COUNT, path=boards.still_pose)[0]
    for k, shot in enumerate(shots):
        name = f"other{k:03d}"
        for factor in (1, 2):
            small = cv2.resize(shot, (128 // factor, 96 // factor), interpolation=cv2.INTER_AREA)
            captures.write_png(root / f"rgb/{factor}x/{name}.png", small)
        fields = {"orientation": np.eye(3).tolist(), "position": [0.0, 0.0, 0.0], "focal_length": boards.FOCAL / 2}
        shutil.copy(root / f"camera/{NAMES[k]}.json", root / f"camera/{name}.json")
        edit_json(root / f"camera/{name}.json", **fields, principal_point=[64.0, 48.0], image_size=[128, 96])
        metadata[name] = {"time_id": k + 0.4, "camera_id": 1}
        index["train_ids"].append(name)
    captures.write_json(root / "dataset.json", index)
    captures.write_json(root / "metadata.json", metadata)


def test_masks_of_several_cameras_are_found_in_each_by_itself(root, monkeypatch):
    add_still_camera(root)
    seen = []

    def find(frames, weights, quiet):
        seen.append((len(frames.images), frames.stand_still))
        return [is_red(image) for image in frames.images]

    monkeypatch.setitem(methods.MASKERS, "red", Masker(find))
    add_parts(root, AddOptions(["masks"], masks="red"))
    assert seen == [(COUNT, False), (COUNT, True)]
    for name in (NAMES[4], "other004"):
        assert boards.overlap(written_mask(root, name), red_part(root, name)) > 0.85
    assert cv2.imread(str(root / "masks.png")).shape[:2] == (4 * 192, 6 * 256)


def test_depth_by_flow_is_added_to_the_cameras_that_move(root):
    add_still_camera(root)
    lines = []
    add_parts(root, AddOptions(["depth"]), lines.append)
    assert lines[0].startswith(f"depth: {COUNT} frames, known on ")
    assert {path.stem for path in (root / "depth/1x").iterdir()} == {*NAMES}
    add_parts(root, AddOptions(["depth"]), lines.append)
    assert lines[1] == "depth: all frames of cameras that move have it"


def test_too_few_frames_of_one_of_several_cameras_are_refused(root):
    add_still_camera(root)
    index = json.loads((root / "dataset.json").read_text())
    edit_json(
        root / "dataset.json",
        train_ids=[n for n in index["train_ids"] if n not in ("other003", "other004", "other005")],
    )
    with pytest.raises(ValueError, match="9 frames of the camera of other000 are too few to find what moves"):
        add_parts(root, AddOptions(["masks"], masks="red"))


def test_a_hypernerf_capture_stays_one(tmp_path):
    root = captures.write_capture(tmp_path / "toy", "hypernerf")
    for path in (root / "rgb/2x").iterdir():
        captures.write_png(root / "rgb/1x" / path.name, np.zeros((24, 40, 3), np.uint8))
    more = {f"left_{k:06d}": k for k in range(4, 12)}
    metadata = json.loads((root / "metadata.json").read_text())
    for name, k in more.items():
        metadata[name] = {"time_id": k, "camera_id": 0}
        captures.write_json(root / f"camera/{name}.json", captures.camera_fields(k))
        for size in ("1x", "2x"):
            shutil.copy(root / f"rgb/{size}/left_000000.png", root / f"rgb/{size}/{name}.png")
    captures.write_json(root / "metadata.json", metadata)
    edit_json(root / "dataset.json", train_ids=sorted([*captures.ids_of("hypernerf")[0], *more]))
    add_parts(root, AddOptions(["masks"], masks="red"))
    assert recognize(root) == "hypernerf"
    assert load_capture(root).frame("left_000011").static_mask.shape == (12, 20)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--add", "masks,colours"], "--add must be one or more of masks, depth, points, tracks, got masks,colours"),
        (["--add", ""], "--add must be one or more"),
        (["--add", "masks", "--masks", "none"], "--masks must be one of motion, sam2"),
        (["--add", "depth", "--depth", "none"], "--depth must be one of flow, anything"),
        (["elsewhere", "--add", "depth"], "with --add, give the capture only"),
        (["--add", "depth", "--force"], "--force cannot be used with --add, which keeps the frames and cameras"),
        (["--add", "depth", "--holdout", "8"], "--holdout cannot be used with --add"),
        (["--add", "depth", "--focal", "500"], "--focal cannot be used with --add"),
        (["--add", "depth", "--longest-side", "480"], "--longest-side cannot be used with --add"),
        ([], "prepare needs a source and a folder for the capture"),
    ],
)
def test_wrong_options_are_refused(root, arguments, message, capsys):
    assert main(["prepare", str(root), *arguments]) == 2
    assert message in capsys.readouterr().err


def test_other_layouts_are_to_be_imported_first(tmp_path):
    root = layouts.write_colmap(tmp_path / "colmap")
    with pytest.raises(ValueError, match="has the layout colmap: first copy it with warpgs import"):
        add_parts(root, AddOptions(["depth"]))


def test_the_depth_of_iphone_captures_is_that_of_the_sensor(tmp_path):
    root = captures.write_capture(tmp_path / "toy", "iphone")
    next((root / "depth").glob("*/*.npy")).unlink()
    before = sorted(root.rglob("*"))
    lines = []
    add_parts(root, AddOptions(["depth", "points"]), lines.append)
    assert lines == ["depth: that of the sensor stays", "points: 10 are there"]
    assert sorted(root.rglob("*")) == before


def test_too_few_frames_for_masks_are_refused(tmp_path):
    root = captures.write_capture(tmp_path / "toy", "hypernerf")
    with pytest.raises(ValueError, match="4 frames are too few to find what moves"):
        add_parts(root, AddOptions(["masks"]))


def test_masks_of_a_network_are_copied_and_count_as_estimates(root, tmp_path):
    masks = np.array([red_part(root, name) for name in NAMES])
    np.savez(tmp_path / "masks.npz", masks=masks)
    lines = []
    add_parts(root, AddOptions(["masks"], masks=str(tmp_path / "masks.npz")), lines.append)
    assert lines[0].startswith("masks: 12 frames")
    for name, mask in zip(NAMES, masks, strict=True):
        np.testing.assert_array_equal(written_mask(root, name), mask)
        assert written_mask(root, name, "2x").shape == (96, 128)
    assert load_capture(root).estimated_masks
    assert (root / "masks.png").is_file()


@pytest.mark.parametrize(("part", "plural"), [("mask", "masks"), ("depth", "depths")])
def test_results_in_full_size_are_written_one_by_one_after_all_were_checked(root, tmp_path, monkeypatch, part, plural):
    """So that those of a long video need no memory, and a damaged one leaves no capture with some."""
    events, read, write = [], getattr(add, f"read_{plural}"), getattr(add.writer, f"write_{part}")
    array = option = "masks" if part == "mask" else "depth"

    class Reading:
        def __init__(self, path, names, sizes):
            self.names, self.results = names, read(path, names, sizes)

        def __iter__(self):
            for name, result in zip(self.names, self.results, strict=True):
                events.append(name)
                yield result

    def writing(root, name, *arguments):
        events.append(f"write {name}")
        write(root, name, *arguments)

    monkeypatch.setattr(add, f"read_{plural}", Reading)
    monkeypatch.setattr(add.writer, f"write_{part}", writing)
    np.savez(tmp_path / "results.npz", **{array: np.ones((COUNT, 96, 128), np.float32)})
    add_parts(root, AddOptions([option], **{option: str(tmp_path / "results.npz")}))
    assert events == [*NAMES, *(event for name in NAMES for event in (name, f"write {name}"))]


def test_depth_of_a_network_is_copied_as_inverse_depth(root, tmp_path):
    depth = np.random.default_rng(0).uniform(1.0, 4.0, (COUNT, 96, 128))
    np.savez(tmp_path / "results.npz", depth=depth)
    lines = []
    add_parts(root, AddOptions(["depth"], depth=str(tmp_path / "results.npz")), lines.append)
    assert lines[0].startswith("depth: 12 frames, known on 100%")
    for name, plane in zip(NAMES, depth, strict=True):
        found = np.load(root / f"depth/1x/{name}.npy").astype(float)
        np.testing.assert_allclose(found * plane, np.full_like(plane, np.median(found * plane)), rtol=2e-3)


@pytest.mark.parametrize(("part", "files"), [("masks", "their files"), ("depth", "its files")])
def test_results_that_are_not_read_are_named(root, part, files, tmp_path, capsys):
    quickly = ["--masks", "red"] if part == "masks" else []
    assert main(["prepare", str(root), "--add", part, *quickly]) == 0
    capsys.readouterr()
    assert main(["prepare", str(root), "--add", part, f"--{part}", str(tmp_path)]) == 0
    assert f"{tmp_path} was not read: delete {files} first" in capsys.readouterr().out


def test_tracks_of_a_network_are_copied(root, tmp_path, capsys):
    positions = np.random.default_rng(0).uniform(10.0, 180.0, (COUNT, 20, 2))
    np.savez(tmp_path / "result.npz", pred_tracks=positions, pred_visibility=np.ones((COUNT, 20), bool))
    command = ["prepare", str(root), "--add", "tracks", "--tracks", str(tmp_path / "result.npz")]
    assert main(command) == 0
    assert "tracks: 20 points, seen in 100% of 12 frames" in capsys.readouterr().out
    tracks = load_capture(root).tracks
    assert tracks.frames == tuple(NAMES)
    expected = (positions.transpose(1, 0, 2) + 0.5) / (256, 192)
    np.testing.assert_allclose(tracks.positions, expected, atol=1e-6)
    assert main(command) == 0
    assert "result.npz was not read: delete tracks.npz first to replace what is there" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--add", "tracks"], "--add tracks and --tracks FILE belong together"),
        (["--add", "masks", "--tracks", "a.npz"], "--add tracks and --tracks FILE belong together"),
        (["--add", "masks", "--masks", "no/such/masks"], "if not from an existing file or folder"),
    ],
)
def test_results_that_are_not_given_are_refused(root, options, message, capsys):
    assert main(["prepare", str(root), *options]) == 2
    assert message in capsys.readouterr().err


def test_tracks_need_a_capture(tmp_path, capsys):
    assert main(["prepare", "video.mp4", str(tmp_path / "capture"), "--tracks", "a.npz"]) == 2
    assert "--tracks is for a capture that is there" in capsys.readouterr().err
