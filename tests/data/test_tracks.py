"""Tracks of networks: files of their layouts, and tracks.npz of a capture."""

import numpy as np
import pytest

from tests import tiny
from tests.data import captures
from warpgs.captures.import_capture import import_capture
from warpgs.captures.opening import load_capture
from warpgs.data.results.tracks import read_tracked_points
from warpgs.data.tracks import read_tracks, write_tracks
from warpgs.initialization.prepare_start import prepare_start

SIZE = (40, 24)
COUNT, FRAMES = 7, 5


@pytest.fixture
def seen():
    """Positions [N, F, 2] inside of the frames, and where they are visible."""
    random = np.random.default_rng(0)
    positions = random.uniform(1.0, 23.0, (COUNT, FRAMES, 2)).astype(np.float32)
    visible = random.random((COUNT, FRAMES)) < 0.7
    visible[0, 0] = True
    return positions, visible


def refused(path, match):
    with pytest.raises(ValueError, match=match) as caught:
        read_tracked_points(path, SIZE)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("as_number", [False, True], ids=["bool", "probability"])
@pytest.mark.parametrize("batch", [False, True], ids=["plain", "batch"])
def test_cotracker_counts_pixels_from_the_centre_of_the_first(tmp_path, seen, batch, as_number):
    positions, visible = seen
    tracks, shown = positions.transpose(1, 0, 2) - 0.5, visible.T
    shown = 0.1 + 0.8 * shown if as_number else shown
    arrays = {"pred_tracks": tracks, "pred_visibility": shown}
    if batch:
        arrays = {"pred_tracks": tracks[None], "pred_visibility": shown[None, ..., None]}
    np.savez(tmp_path / "tracks.npz", **arrays)
    found = read_tracked_points(tmp_path / "tracks.npz", SIZE)
    np.testing.assert_allclose(found.positions, positions, atol=1e-5)
    np.testing.assert_array_equal(found.visible, visible)


@pytest.mark.parametrize("name", ["visibles", "visible", "occluded"])
def test_tapir_names_what_is_visible_or_what_is_occluded(tmp_path, seen, name):
    positions, visible = seen
    np.savez(tmp_path / "tracks.npz", tracks=positions, **{name: ~visible if name == "occluded" else visible})
    found = read_tracked_points(tmp_path / "tracks.npz", SIZE)
    np.testing.assert_array_equal(found.positions, positions)
    np.testing.assert_array_equal(found.visible, visible)


@pytest.mark.parametrize("rows", [3, 4])
def test_spatial_tracker_is_projected_by_its_own_cameras_into_the_size_of_the_frames(tmp_path, rows):
    """Cameras of 20×12 pixels that move to the right; the frames are twice as large."""
    extrinsics = np.tile(np.eye(4), (FRAMES, 1, 1))
    extrinsics[:, 0, 3] = -0.1 * np.arange(FRAMES)
    K = np.tile([[10.0, 0.0, 10.0], [0.0, 10.0, 6.0], [0.0, 0.0, 1.0]], (FRAMES, 1, 1))
    coords = np.tile([[0.2, 0.1, 2.0], [0.0, 0.0, -1.0]], (FRAMES, 1, 1))
    arrays = {"coords": coords, "visibs": np.ones((FRAMES, 2, 1)), "extrinsics": extrinsics[:, :rows]}
    np.savez(tmp_path / "result.npz", **arrays, intrinsics=K, depths=np.ones((FRAMES, 12, 20)))
    found = read_tracked_points(tmp_path / "result.npz", SIZE)
    expected = [[2.0 * (10.0 * (0.2 - 0.1 * k) / 2.0 + 10.0), 2.0 * (10.0 * 0.05 + 6.0)] for k in range(FRAMES)]
    np.testing.assert_allclose(found.positions[0], expected, rtol=1e-6)
    assert found.visible[0].all()
    assert not found.visible[1].any()  # behind the camera


@pytest.mark.parametrize(
    ("arrays", "match"),
    [
        ({"points": np.zeros((2, 3))}, "has no tracks: expected the arrays pred_tracks"),
        ({"pred_tracks": np.zeros((4, 3, 2)), "pred_visibility": np.zeros((4, 2))}, "do not fit each other"),
        ({"tracks": np.zeros((4, 3, 3)), "visibles": np.zeros((4, 3))}, "do not fit each other"),
        ({"tracks": np.array([{}]), "visibles": np.zeros((4, 3))}, "not an array of numbers"),
    ],
    ids=["other arrays", "other counts", "three coordinates", "pickle"],
)
def test_other_files_are_refused_in_one_sentence(tmp_path, arrays, match):
    np.savez(tmp_path / "tracks.npz", **arrays)
    refused(tmp_path / "tracks.npz", match)


def test_spatial_tracker_with_cameras_of_other_frames_is_refused(tmp_path):
    arrays = {"coords": np.zeros((5, 2, 3)), "visibs": np.zeros((5, 2)), "extrinsics": np.zeros((4, 4, 4))}
    np.savez(tmp_path / "result.npz", **arrays, intrinsics=np.zeros((5, 3, 3)), depths=np.zeros((5, 12, 20)))
    refused(tmp_path / "result.npz", "of 5 frames")


def test_a_pickle_is_refused(tmp_path):
    (tmp_path / "tracks.pkl").write_bytes(b"\x80\x04}\x94.")
    refused(tmp_path / "tracks.pkl", "not a .zip file")


NAMES = [f"frame{k}" for k in range(FRAMES)]


def test_a_capture_gives_positions_relative_to_the_image_and_nan_where_points_are_hidden(tmp_path, seen):
    positions, visible = seen
    write_tracks(tmp_path, positions, visible, SIZE)
    tracks = read_tracks(tmp_path, NAMES)
    assert tracks.frames == tuple(NAMES)
    np.testing.assert_array_equal(tracks.visible, visible)
    np.testing.assert_allclose(tracks.positions[visible], (positions / SIZE)[visible], rtol=1e-6)
    assert np.isnan(tracks.positions[~visible]).all()


def test_a_capture_without_the_file_has_no_tracks(tmp_path):
    assert read_tracks(tmp_path, NAMES) is None
    assert read_tracks(tmp_path, None) is None


def test_positions_outside_of_the_image_are_hidden(tmp_path, seen):
    positions, visible = seen
    visible[:] = True
    positions[2, 1], positions[3, 2] = (-0.1, 5.0), (5.0, 24.0)
    write_tracks(tmp_path, positions, visible, SIZE)
    hidden = np.argwhere(~read_tracks(tmp_path, NAMES).visible).tolist()
    assert hidden == [[2, 1], [3, 2]]


def test_tracks_of_another_number_of_frames_are_refused(tmp_path, seen):
    write_tracks(tmp_path, *seen, SIZE)
    with pytest.raises(ValueError, match="tracks are of 5 frames, but the camera has 4"):
        read_tracks(tmp_path, NAMES[:4])


def test_tracks_of_several_cameras_are_refused(tmp_path, seen):
    write_tracks(tmp_path, *seen, SIZE)
    with pytest.raises(ValueError, match="of this capture several train"):
        read_tracks(tmp_path, None)


def test_positions_of_visible_points_that_are_no_numbers_are_refused(tmp_path, seen):
    positions, visible = seen
    positions[0, 0] = np.nan
    write_tracks(tmp_path, positions, visible, SIZE)
    with pytest.raises(ValueError, match="must be finite numbers"):
        read_tracks(tmp_path, NAMES)


def test_positions_of_frames_of_another_size_are_refused(tmp_path, seen):
    positions, visible = seen
    write_tracks(tmp_path, 4.0 * positions, visible, SIZE)
    with pytest.raises(ValueError, match="outside of frames of 40×24 pixels: tracks must be of the capture's frames"):
        read_tracks(tmp_path, NAMES)


@pytest.mark.parametrize("size", [np.array([40]), np.array([40, 0]), np.array([40, np.inf])])
def test_a_size_that_is_none_is_refused(tmp_path, seen, size):
    positions, visible = seen
    np.savez(tmp_path / "tracks.npz", tracks=positions, visibles=visible, size=size)
    with pytest.raises(ValueError, match="size must be the width and height"):
        read_tracks(tmp_path, NAMES)


def test_tracks_are_read_once_and_only_if_they_are_needed(tmp_path, seen):
    root = captures.write_capture(tmp_path / "capture")
    film = load_capture(root).film
    positions, visible = (np.resize(values, (COUNT, len(film), *values.shape[2:])) for values in seen)
    write_tracks(root, positions, visible, captures.SIZE)
    capture = load_capture(root)
    assert capture.tracks is capture.tracks is capture.assuming("static").tracks
    (root / "tracks.npz").write_bytes(b"damaged")
    damaged = load_capture(root)
    advice = r"\. Delete tracks\.npz to train without tracks, or add others with warpgs prepare CAPTURE --add tracks"
    with pytest.raises(ValueError, match=rf"tracks\.npz .*{advice}"):
        _ = damaged.tracks
    with pytest.raises(ValueError, match=advice):  # before the first step
        prepare_start(tiny.CONFIG, damaged)


def test_an_import_keeps_tracks(tmp_path, seen):
    root = captures.write_capture(tmp_path / "capture")
    film = load_capture(root).film
    positions, visible = (np.resize(values, (COUNT, len(film), *values.shape[2:])) for values in seen)
    write_tracks(root, positions, visible, captures.SIZE)
    import_capture(root, tmp_path / "copy")
    copied, original = (load_capture(path).tracks for path in (tmp_path / "copy", root))
    assert copied.frames == original.frames
    np.testing.assert_allclose(copied.positions, original.positions, atol=1e-6)
