"""Which frames are taken, and which sources are refused."""

import os
import struct
import zipfile

import cv2
import numpy as np
import pytest

from tests.prepare.boards import record, write_folder, write_video
from warpgs.data.images import decode
from warpgs.data.lens import Lens
from warpgs.prepare.cameras.recovered import Cameras
from warpgs.prepare.frames.images import sharpness
from warpgs.prepare.frames.take import Frames, check_selection, take_frames
from warpgs.prepare.options import Selection


@pytest.fixture(scope="module")
def images():
    return record(20)[0]


def test_a_blurred_image_is_less_sharp(images):
    assert sharpness(cv2.GaussianBlur(images[0], (0, 0), 2.0)) < 0.5 * sharpness(images[0])


def test_the_sharpest_frame_of_each_interval_is_taken(tmp_path, images):
    blurred = [image if k % 4 == 2 else cv2.GaussianBlur(image, (0, 0), 2.5) for k, image in enumerate(images)]
    video = write_video(tmp_path / "video.mp4", blurred)
    frames = take_frames(video, tmp_path / "frames", Selection(count=5))
    assert [frame.step for frame in frames.taken] == [2, 6, 10, 14, 18]


def test_the_sharpest_images_of_a_folder_are_taken(tmp_path, images):
    blurred = [image if k % 4 == 1 else cv2.GaussianBlur(image, (0, 0), 2.5) for k, image in enumerate(images)]
    frames = take_frames(write_folder(tmp_path / "shots", blurred), tmp_path / "frames", Selection(count=5))
    assert [frame.source for frame in frames.taken] == [f"shot{k:03d}.png" for k in (1, 5, 9, 13, 17)]


def named_folder(root, images, names):
    root.mkdir()
    for image, name in zip(images, names, strict=False):
        cv2.imwrite(str(root / name), image)
    return root


@pytest.mark.parametrize(
    ("names", "times"),
    [
        ([f"{k}.png" for k in (3, 4, 5, 7, 8)], [0, 1, 2, 4, 5]),
        ([f"1305031102.{k}.png" for k in ("4", "45", "5", "55", "6")], [0, 50, 100, 150, 200]),
        (
            [f"130503110{k}.png" for k in ("2_980000000", "3_13000000", "3_46000000", "3_79000000", "3_112000000")],
            [0, 33, 66, 99, 132],
        ),
    ],
)
def test_frames_of_a_folder_have_the_order_and_times_that_their_names_tell(tmp_path, images, names, times):
    folder, notes = named_folder(tmp_path / "shots", images, names), []
    frames = take_frames(folder, tmp_path / "frames", Selection(), notes=notes)
    assert [frame.source for frame in frames.taken] == names
    assert [frame.time for frame in frames.taken] == times
    assert [note.split(" in the names, ")[0] for note in notes] in (
        ["times from the numbers"],
        ["times from the time stamps"],
    )


def test_the_sorted_order_of_a_folder_whose_names_tell_no_times_is_noted(tmp_path, images):
    folder, notes = named_folder(tmp_path / "shots", images, [f"{letter}.png" for letter in "abcde"]), []
    frames = take_frames(folder, tmp_path / "frames", Selection(), notes=notes)
    assert [(frame.source, frame.time) for frame in frames.taken] == [(f"{c}.png", k) for k, c in enumerate("abcde")]
    assert "times from the sorted order of the names, because a.png has no number" in notes[0]
    take_frames(write_folder(tmp_path / "numbered", images[:5]), tmp_path / "other", Selection(), notes=notes)
    assert len(notes) == 1


@pytest.mark.parametrize(("fps", "count"), [(5.0, 10), (1000.0, 20)])
def test_fps_does_not_exceed_the_frame_rate_of_the_video(tmp_path, images, fps, count):
    video = write_video(tmp_path / "video.mp4", images, rate=10.0)
    assert len(take_frames(video, tmp_path / "frames", Selection(fps=fps)).taken) == count


def test_large_images_are_scaled_down_and_small_ones_kept_as_the_list_of_frames_says(tmp_path, images):
    shots = write_folder(tmp_path / "shots", images[:5])
    assert take_frames(shots, tmp_path / "small", Selection(longest_side=128)) == Frames.load(tmp_path / "small")
    take_frames(shots, tmp_path / "large", Selection(longest_side=5000))
    assert decode(tmp_path / "small/frame_000000.png").shape == (96, 128, 3)
    assert (Frames.load(tmp_path / "small").factor, Frames.load(tmp_path / "large").factor) == (0.5, 1.0)
    assert np.array_equal(decode(tmp_path / "large/frame_000000.png")[..., ::-1], images[0])


def write_tagged(path, image, orientation):
    """A JPEG file with an EXIF orientation."""
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, orientation, 0)
    exif = b"Exif\0\0" + b"MM\0*" + struct.pack(">IH", 8, 1) + entry + struct.pack(">I", 0)
    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
    path.write_bytes(jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:])


def brightest_side(path):
    image = decode(path).astype(float)
    edges = {"top": image[:8], "bottom": image[-8:], "left": image[:, :8], "right": image[:, -8:]}
    return max(edges, key=lambda edge: edges[edge].mean())


def with_bright_top(images):
    bright = [image.copy() for image in images]
    for image in bright:
        image[: image.shape[0] // 4] = 255
    return bright


@pytest.mark.parametrize("orientation", range(1, 9))
def test_an_image_is_rotated_by_its_orientation_tag(tmp_path, images, orientation):
    for k, image in enumerate(with_bright_top(images[:5])):
        write_tagged(tmp_path / f"{k}.jpg", image, orientation)
    notes = []
    frames = take_frames(tmp_path, tmp_path / "frames", Selection(), notes=notes)
    turn = -1 if orientation >= 5 else 1
    assert decode(tmp_path / "frames/frame_000000.png").shape[:2] == images[0].shape[:2][::turn]
    assert Frames.load(tmp_path / "frames").readout_from == frames.readout_from
    assert brightest_side(tmp_path / "frames/frame_000000.png") == frames.readout_from
    assert notes == []


def test_frames_that_were_held_differently_are_noted(tmp_path, images):
    for k in range(5):
        write_tagged(tmp_path / f"{k}.jpg", images[k], 8 if k in (1, 4) else 6)
    notes = []
    assert take_frames(tmp_path, tmp_path / "frames", Selection(), notes=notes).readout_from == "right"
    assert "2 frames of 5 were filmed with the camera held differently" in notes[0]


@pytest.mark.parametrize(
    ("turn", "side"), [((0, 1, -1, 0), "right"), ((-1, 0, 0, -1), "bottom"), ((0, -1, 1, 0), "left"), (None, "top")]
)
def test_a_rotation_tag_says_where_the_first_row_of_the_sensor_is(turn, side, tmp_path, images):
    data = write_video(tmp_path / "video.mp4", with_bright_top(images[:8])).read_bytes()
    if turn is not None:
        a, b, c, d = (entry * (1 << 16) for entry in turn)
        track = data.index(b"tkhd")
        lying = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
        data = data[:track] + data[track:].replace(lying, struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30), 1)
    (tmp_path / "tagged.mp4").write_bytes(data)
    frames = take_frames(tmp_path / "tagged.mp4", tmp_path / "frames", Selection())
    assert Frames.load(tmp_path / "frames").readout_from == frames.readout_from == side
    assert brightest_side(tmp_path / "frames/frame_000000.png") == side


def test_a_video_is_rotated_by_its_rotation_tag(tmp_path, images):
    data = write_video(tmp_path / "video.mp4", images[:8]).read_bytes()
    track = data.index(b"tkhd")
    lying = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    upright = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, images[0].shape[0] << 16, 0, 1 << 30)
    assert lying in data[track:]
    (tmp_path / "tagged.mp4").write_bytes(data[:track] + data[track:].replace(lying, upright, 1))
    take_frames(tmp_path / "tagged.mp4", tmp_path / "frames", Selection())
    rotated = decode(tmp_path / "frames/frame_000000.png")[..., ::-1]
    assert rotated.shape[:2] == images[0].shape[1::-1]
    assert np.abs(np.rot90(images[0], -1).astype(int) - rotated).mean() < 12


@pytest.mark.parametrize(
    ("selection", "word"),
    [
        (Selection(fps=2.0, count=10), "exclude"),
        (Selection(fps=0.0), "--fps"),
        (Selection(fps=float("nan")), "--fps"),
        (Selection(count=2), "--count"),
        (Selection(count=10**6), "--count"),
        (Selection(longest_side=3), "--longest-side"),
    ],
)
def test_invalid_selections_are_refused(selection, word):
    with pytest.raises(ValueError, match=word):
        check_selection(selection)


def write_heic(folder):
    folder.mkdir()
    (folder / "IMG_0001.HEIC").touch()


def write_album(folder, images):
    write_heic(folder)
    (folder / "b.dng").touch()
    write_folder(folder / "shots", images)


UNSUITABLE = {
    "text": (lambda path, images: path.write_text("hello" * 100), r"source\.mp4 is not a video"),
    "missing": (lambda path, images: None, r"source\.mp4 is missing"),
    "fifo": (lambda path, images: os.mkfifo(path), r"source\.mp4 is not a file"),
    "device": (lambda path, images: path.symlink_to("/dev/zero"), r"source\.mp4 is not a file"),
    "one frame": (lambda path, images: write_video(path, images[:1]), "gives 1 frame, at least"),
    "empty folder": (lambda path, images: path.mkdir(), r"holds no \.png, .* images$"),
    "images of a phone": (lambda path, images: write_heic(path), r"images: convert its \.HEIC files to PNG or JPEG$"),
    "two suffixes": (
        lambda path, images: write_album(path, []),
        r"images: convert its \.HEIC, \.dng files to PNG or JPEG$",
    ),
    "images of a phone and a folder": (write_album, r"images, but .*source\.mp4.shots does$"),
    "hidden images": (lambda path, images: write_folder(path / ".thumbs", images), r"holds no \.png, .* images$"),
    "folder of a folder": (lambda path, images: write_folder(path / "shots", images), r"but .*source\.mp4.shots does$"),
}


@pytest.mark.parametrize(("write", "message"), UNSUITABLE.values(), ids=UNSUITABLE)
def test_unsuitable_sources_are_refused(tmp_path, images, write, message):
    write(tmp_path / "source.mp4", images)
    with pytest.raises(ValueError, match=message):
        take_frames(tmp_path / "source.mp4", tmp_path / "frames", Selection())


def test_images_of_different_sizes_are_refused_by_name(tmp_path, images):
    write_folder(tmp_path / "shots", [*images[:5], cv2.resize(images[5], (64, 48))])
    with pytest.raises(ValueError, match=r"shot005\.png is 64×48, others are 256×192"):
        take_frames(tmp_path / "shots", tmp_path / "frames", Selection())


def test_a_rate_is_refused_for_a_folder(tmp_path, images):
    with pytest.raises(ValueError, match="--fps is for videos"):
        take_frames(write_folder(tmp_path / "shots", images[:5]), tmp_path / "frames", Selection(fps=3.0))


def test_numbers_in_names_are_sorted_as_numbers(tmp_path, images):
    for k in (1, 2, 10, 9, 11):
        cv2.imwrite(str(tmp_path / f"shot{k}.png"), images[k])
    frames = take_frames(tmp_path, tmp_path / "frames", Selection())
    assert [frame.source for frame in frames.taken] == [f"shot{k}.png" for k in (1, 2, 9, 10, 11)]


@pytest.mark.parametrize("size", [(256, 15), (900, 40)])
def test_images_too_flat_for_optical_flow_are_refused(size, tmp_path, images):
    shots = write_folder(tmp_path / "shots", [cv2.resize(image, size) for image in images[:5]])
    with pytest.raises(ValueError, match=rf"shot000\.png of {size[0]}×{size[1]} pixels is too flat"):
        take_frames(shots, tmp_path / "frames", Selection())


def test_a_truncated_video_is_noted(tmp_path, images):
    video, notes = write_video(tmp_path / "video.avi", images), []
    take_frames(video, tmp_path / "whole", Selection(), notes=notes)
    assert notes == []
    data = video.read_bytes()
    video.write_bytes(data[: len(data) // 2])
    taken = take_frames(video, tmp_path / "part", Selection(), notes=notes).taken
    assert notes == [f"{video} should have 20 frames, only {len(taken)} could be decoded: is it truncated?"]


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED])
def test_damaged_cameras_are_refused_by_name(tmp_path, method):
    lens = Lens(40, 24, (50.0, 50.0), (20.0, 12.0))
    saved = Cameras(["a"], lens, np.eye(4)[None, :3], np.zeros((0, 3)), 0.5, 3.0)
    saved.save(tmp_path / "cameras")
    assert Cameras.load(tmp_path / "cameras").lens == lens
    with zipfile.ZipFile(tmp_path / "cameras.npz") as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "cameras.npz", "w", method) as archive:
        for name, data in members.items():
            archive.writestr(name, data[:-8] + struct.pack("<d", np.inf) if name == "quality.npy" else data[:90])
    with pytest.raises(ValueError, match=r"cameras\.npz"):
        Cameras.load(tmp_path / "cameras")
