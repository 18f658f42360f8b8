"""DyNeRF: a video or folder of frames per camera, and one pose for each."""

import shutil

import cv2
import numpy as np
import pytest

from tests.data import layouts
from tests.data.captures import write_array, write_png
from tests.prepare.boards import write_video
from warpgs.captures.import_capture import import_capture
from warpgs.captures.opening import load_capture
from warpgs.data.loaders import dynerf, recognize

NUMBERS, NUM = (0, 2, 5), 4
"""Numbers of the cameras, and the number of frames of each."""

SIZE = (64, 48)


def image(number: int, k: int) -> np.ndarray:
    """Bright from left to right by the camera, all over by the time."""
    row = np.linspace(0, 20 * (number + 1), SIZE[0])
    return np.broadcast_to(row[None, :, None] + 20 * k, (*SIZE[::-1], 3)).astype(np.uint8)


def write_poses(root, count=3):
    rows = []
    for k in range(count):
        center, right, up, forward = layouts.camera(k)
        size = np.array([2.0 * SIZE[1], 2.0 * SIZE[0], 2.0 * layouts.FOCAL])
        rows.append([*np.stack([-up, right, -forward, center, size], 1).ravel(), 2.0, 6.0])
    write_array(root / "poses_bounds.npy", np.array(rows))


@pytest.fixture
def videos(tmp_path):
    root = tmp_path / "videos"
    write_poses(root)
    for number in NUMBERS:
        write_video(root / f"cam{number:02d}.mp4", [image(number, k) for k in range(NUM)])
    return root


@pytest.fixture(params=["cam{:02d}/images", "cam{:02d}"])
def folders(tmp_path, request):
    root = tmp_path / "folders"
    write_poses(root)
    for number in NUMBERS:
        for k in range(NUM):
            write_png(root / request.param.format(number) / f"{k:04d}.png", image(number, k))
    return root


def test_videos_are_read_with_their_cameras_times_and_poses(videos):
    assert recognize(videos) == "dynerf"
    capture = load_capture(videos)
    assert capture.by_camera(capture.cameras) == {i: [f"cam{i:02d}_{k:05d}" for k in range(NUM)] for i in NUMBERS}
    assert [capture.cameras[f"cam05_{k:05d}"].time for k in range(NUM)] == pytest.approx([0, 1 / 3, 2 / 3, 1])
    frame = capture.frame("cam05_00003")
    assert np.abs(frame.image.numpy().astype(int) - image(5, 3)).mean() < 4.0
    centers = [layouts.camera(k)[0] for k in range(3)]
    positions = [capture.cameras[f"cam{i:02d}_00001"].position.numpy() for i in NUMBERS]
    ratio = np.linalg.norm(positions[2] - positions[0]) / np.linalg.norm(positions[1] - positions[0])
    expected = np.linalg.norm(centers[2] - centers[0]) / np.linalg.norm(centers[1] - centers[0])
    assert ratio == pytest.approx(expected, rel=1e-4)
    assert frame.camera.K[0, 0].item() == pytest.approx(layouts.FOCAL)


def test_the_first_camera_is_held_out(videos):
    capture = load_capture(videos)
    assert capture.val == tuple(f"cam00_{k:05d}" for k in range(NUM))
    assert len(capture.train) == 2 * NUM


def test_folders_of_frames_are_the_same_capture(videos, folders):
    assert recognize(folders) == "dynerf"
    filmed, capture = load_capture(videos), load_capture(folders)
    assert (capture.train, capture.val) == (filmed.train, filmed.val)
    assert np.array_equal(capture.frame("cam02_00001").image.numpy(), image(2, 1))


def test_a_factor_reduces_frames_and_focal_length(videos):
    capture = load_capture(videos, factor=2)
    frame, whole = capture.frame("cam02_00002"), load_capture(videos).frame("cam02_00002")
    half = cv2.resize(whole.image.numpy(), (SIZE[0] // 2, SIZE[1] // 2), interpolation=cv2.INTER_AREA)
    assert np.array_equal(frame.image.numpy(), half)
    assert frame.camera.K[0, 0].item() == pytest.approx(layouts.FOCAL / 2)


def test_an_imported_copy_has_the_same_cameras_and_decodes_each_video_once(videos, tmp_path, monkeypatch):
    passes, decoded = [], dynerf.VideoFrames._decoded
    dynerf._open.cache_clear()
    monkeypatch.setattr(dynerf.VideoFrames, "_decoded", lambda self: passes.append(self.path) or decoded(self))
    capture = load_capture(videos)
    passes.clear()
    import_capture(videos, tmp_path / "copy")
    assert len(passes) <= 2 * len(NUMBERS)  # for its size, and for its frames
    copy = load_capture(tmp_path / "copy")
    for name, camera in capture.cameras.items():
        assert (copy.cameras[name].id, copy.cameras[name].time) == (camera.id, pytest.approx(camera.time))


def test_cameras_of_different_lengths_are_noted(videos):
    write_video(videos / "cam02.mp4", [image(2, k) for k in range(NUM - 1)])
    notes = load_capture(videos).notes
    assert "cam02.mp4 has 3 frames and cam00.mp4 4: they are taken to begin at one time" in notes


def test_another_number_of_poses_is_refused(videos):
    write_poses(videos, 4)
    with pytest.raises(ValueError, match=r"poses_bounds\.npy has 4 cameras, but .* has 3 videos or folders"):
        load_capture(videos)


def test_two_videos_of_one_camera_are_refused(videos):
    shutil.copy(videos / "cam02.mp4", videos / "cam2.mp4")
    with pytest.raises(ValueError, match=r"cam02\.mp4 and .*cam2\.mp4 are both of camera 2"):
        load_capture(videos)


def test_a_camera_without_images_is_refused(folders):
    for path in [*folders.glob("cam02/**/*.png")]:
        path.unlink()
    with pytest.raises(ValueError, match=r"cam02.* has no images"):
        load_capture(folders)


def test_images_of_another_shape_than_their_pose_are_refused(folders):
    first = min(folders.glob("cam02/**/*.png"))
    write_png(first, np.zeros((9, 9, 3), np.uint8))
    with pytest.raises(ValueError, match="is 9×9, but its pose is of 128×96 images"):
        load_capture(folders)
