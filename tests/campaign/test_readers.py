"""Damaged files are read or refused in one line that names them, in bounded time and memory."""

import random
import shutil
import zipfile
from functools import partial

import cv2
import numpy as np
import pycolmap
import pytest

from tests import plain
from tests.campaign.damage import Hang, damage, refusal
from tests.data import layouts
from tests.data.captures import read_all, write_array, write_capture, write_json, write_png
from warpgs.captures.opening import load_capture
from warpgs.config import TrainConfig
from warpgs.data.archive import Archive
from warpgs.data.colmap_files import read_model
from warpgs.data.exr import read_exr_channel
from warpgs.data.images import decode
from warpgs.data.npz import read_npz
from warpgs.data.ply import read_ply_points
from warpgs.data.results.depth import read_depths
from warpgs.data.results.masks import read_masks
from warpgs.data.results.tracks import read_tracked_points
from warpgs.data.tracks import make_tracks, read_tracks, write_tracks
from warpgs.files import read_array
from warpgs.prepare.cameras.intrinsics import read_intrinsics
from warpgs.report.evaluated_run import read_runs
from warpgs.runs import checkpoint
from warpgs.runs.config_file import read_config, write_config
from warpgs.sweep.peers import read_peers
from warpgs.sweep.spec import read_spec
from warpgs.video.keyframes import read_path

MAX_MESSAGE = 2000


def campaign(original, work, read, count):
    """Damages one file of a copy of a folder ``count`` times and reads it, by its path; returns how many were refused.

    A failure names the seed and the file.
    """
    names = sorted(path.relative_to(original) for path in original.rglob("*") if path.is_file())
    refused = 0
    for seed in range(count):
        r = random.Random(seed)
        name = r.choice(names)
        shutil.copytree(original, work)
        damage(work / name, r)
        try:
            message = refusal(partial(read, work / name))
        except (Exception, Hang) as error:
            raise AssertionError(f"input {seed}: {name}") from error
        if message is not None:
            assert str(work) in message, (seed, name, message)
            assert len(message) < MAX_MESSAGE, (seed, name, message)
            refused += 1
        shutil.rmtree(work)
    return refused


def test_damaged_captures(tmp_path, count):
    original = write_capture(tmp_path / "original")
    assert campaign(original, tmp_path / "damaged", lambda _: read_all(tmp_path / "damaged"), count) > 0.5 * count


OTHERS = {**layouts.ALL, "hypernerf": None, "iphone": None}


@pytest.mark.parametrize("layout", OTHERS)
def test_damaged_captures_of_other_programs(tmp_path, count, layout):
    original, number = tmp_path / "original", -(-count // len(OTHERS))
    write = OTHERS[layout]
    write(original) if write else write_capture(original, layout)
    assert campaign(original, tmp_path / "damaged", lambda _: read_all(tmp_path / "damaged"), number) > 0.2 * number


MATRIX = np.array([[50.0, 0.0, 19.5], [0.0, 51.0, 11.5], [0.0, 0.0, 1.0]])
SWEEP = """title = "Rates"
preset = "quick"
seeds = 3
data = ["nerfds/as", "cup=other/cup"]

[options]
iterations = 5_000

[variants.slow]
label = "half the rate"
optim.networks = 4e-4
model = {width = 8, skip = 1}
"""
PEERS = {"D3DGS": {"x": {"psnr": [24.0, 0.5], "ssim": 0.9}, "y": {"psnr": 26}}, "Other": {"mean": {"lpips": 0.1}}}
KEYFRAMES = {
    "up": [0, -1, 0],
    "keyframes": [
        {"view": "left_000001", "time": 0.0, "at": 0},
        {"position": [0, 0, -2], "target": [0, 0, 0], "time": 0.5, "focal": 40, "at": 2.5},
        {"viewmat": np.eye(4).tolist(), "K": MATRIX.tolist(), "width": 40, "height": 24, "time": 1.0, "at": 4},
    ],
}
METRICS = {"psnr": 20.5, "lpips": None, "device": "A", "train_seconds": 12.5, "num_static": 3, "iterations": 32}
VIEWS = "name,time,psnr,ssim\nleft_000000,0,20.5,0.9\nleft_000001,0.5,inf,\n"


def write_small_files(root):
    """One file of each format that a user writes, or takes from another program."""
    for name in ("lens.xml", "lens.yaml", "lens.json"):
        storage = cv2.FileStorage(str(root / name), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", MATRIX)
        storage.write("distortion_coefficients", np.array([0.1, -0.02, 0.0, 0.0, 0.001]))
        storage.write("image_width", 40)
        storage.write("image_height", 24)
        storage.release()
    (root / "cameras.txt").write_text("# Camera list\n1 OPENCV 40 24 50 51 20 12 0.1 -0.02 0 0\n")
    (root / "sweep.toml").write_text(SWEEP)
    write_json(root / "peers.json", PEERS)
    write_json(root / "path.json", KEYFRAMES)
    layouts.write_ply(root / "points.ply")
    layouts.write_ply(root / "points_ascii.ply", "ascii")
    write_array(root / "array.npy", np.arange(60, dtype=np.float32).reshape(3, 20))
    np.savez_compressed(root / "arrays.npz", a=np.arange(60.0), b=np.eye(3, dtype=np.float16))
    write_results(root)
    with zipfile.ZipFile(root / "depth.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for compression in ("NO", "ZIPS", "ZIP", "PIZ"):
            archive.writestr(f"{compression}.exr", layouts.exr(np.ones((20, 37)), compression=compression))
    write_png(root / "image.png", layouts.image(0))
    cv2.imwrite(str(root / "image.jpg"), layouts.image(0))
    write_config(root, plain.plan(TrainConfig()))
    write_json(root / "metrics.json", METRICS)
    (root / "views.csv").write_text(VIEWS)


FRAMES, IMAGE = ["a", "b", "c"], (40, 24)


def write_results(root):
    """A file of each layout in which networks leave tracks, masks and depth of three frames."""
    positions, visible = np.random.default_rng(0).uniform(1.0, 20.0, (5, 3, 2)), np.ones((5, 3), bool)
    write_tracks(root, positions, visible, IMAGE)
    np.savez(root / "cotracker.npz", pred_tracks=positions.transpose(1, 0, 2)[None], pred_visibility=visible.T[None])
    np.savez(root / "tapir.npz", tracks=positions, occluded=~visible)
    cameras = {"extrinsics": np.tile(np.eye(4), (3, 1, 1)), "intrinsics": np.tile(MATRIX, (3, 1, 1))}
    depth = np.full((3, 24, 40), 2.0, np.float32)
    np.savez(
        root / "spatial.npz", coords=np.tile([0.5, 0.5, 5.0], (3, 5, 1)), visibs=visible.T, depths=depth, **cameras
    )
    np.savez(root / "depth.npz", depth=depth[..., None])
    np.savez(root / "masks.npz", masks=depth[:, None] > 1.0)


def read_result_of_tracks(path):
    make_tracks(path, FRAMES, *read_tracked_points(path, IMAGE), IMAGE)


def read_depth(path):
    archive = Archive(path)
    for name in archive.sizes:
        read_exr_channel(path, archive.read(name, 1 << 30), "Z")


@pytest.fixture
def small_readers(tmp_path):
    """Reader of each file of ``write_small_files``."""
    capture = load_capture(write_capture(tmp_path / "capture"))
    size = capture.cameras[capture.train[0]].size
    return {
        **dict.fromkeys(("lens.xml", "lens.yaml", "lens.json", "cameras.txt"), lambda p: read_intrinsics(p, size)),
        "sweep.toml": lambda p: read_spec(str(p)),
        "peers.json": read_peers,
        "path.json": lambda p: read_path(p, capture, 5),
        **dict.fromkeys(("points.ply", "points_ascii.ply"), read_ply_points),
        "array.npy": lambda p: read_array(p, 1 << 16),
        "arrays.npz": lambda p: read_npz(p, ("a", "b"), 1 << 20),
        "depth.zip": read_depth,
        "tracks.npz": lambda p: read_tracks(p.parent, FRAMES),
        **dict.fromkeys(("cotracker.npz", "tapir.npz", "spatial.npz"), read_result_of_tracks),
        "depth.npz": lambda p: [*read_depths(p, FRAMES, [IMAGE] * 3)],
        "masks.npz": lambda p: [*read_masks(p, FRAMES, [IMAGE] * 3)],
        **dict.fromkeys(("image.png", "image.jpg"), decode),
        **dict.fromkeys(("config.json", "metrics.json", "views.csv"), lambda p: read_runs([p.parent])),
    }


def test_damaged_small_files(tmp_path, count, small_readers):
    original = tmp_path / "original"
    original.mkdir()
    write_small_files(original)
    assert sorted(path.name for path in original.iterdir()) == sorted(small_readers)
    for name, read in small_readers.items():
        read(original / name)
    number = 3 * count
    refused = campaign(original, tmp_path / "damaged", lambda path: small_readers[path.name](path), number)
    assert refused > 0.4 * number


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_damaged_colmap_models(tmp_path, count, kind):
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig, options.num_points3D = 1, 2, 3, 20
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "original").mkdir()
    (model.write if kind == "binary" else model.write_text)(str(tmp_path / "original"))
    refused = campaign(tmp_path / "original", tmp_path / "damaged", lambda path: read_model(path.parent), count)
    assert refused > (0.5 if kind == "binary" else 0.4) * count  # a line that is there twice may do no harm


def test_damaged_checkpoints_and_configs(tmp_path, count, finished_run):
    original = tmp_path / "original"
    (original / checkpoint.FOLDER).mkdir(parents=True)
    newest = checkpoint.list_checkpoints(finished_run)[-1]
    shutil.copy(newest, original / checkpoint.FOLDER)
    shutil.copy(finished_run / "config.json", original)

    run = tmp_path / "damaged"

    def read(_):
        config = read_config(run)
        for path in (run / checkpoint.FOLDER).iterdir():
            checkpoint.load_scene(checkpoint.load(path), config.model)

    assert campaign(original, run, read, count) > 0.3 * count
