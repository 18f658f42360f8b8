"""Optical flow of networks, as tracks."""

import numpy as np
import pytest

from warpgs.data.results import flow
from warpgs.data.results.tracks import read_tracked_points

FRAMES, WIDTH, HEIGHT = 12, 64, 48
TURN, SHIFT = 0.03, np.array([1.25, -0.5])
CENTER = np.array([30.0, 22.0])


def moved(points, frames):
    """Where a turn and a shift per frame lead points."""
    angle = TURN * frames
    c, s = np.cos(angle), np.sin(angle)
    return (points - CENTER) @ np.array([[c, s], [-s, c]]) + CENTER + frames * SHIFT


def flows():
    """Forward and backward flow, [48, 64, 2], between all frames; what turns about a point that moves along."""
    x = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1).astype(float)
    for k in range(FRAMES - 1):
        start = (x - CENTER - k * SHIFT) + CENTER
        forward = moved(start, 1) + k * SHIFT - x
        c, s = np.cos(TURN), np.sin(TURN)
        back = (x - CENTER - (k + 1) * SHIFT) @ np.array([[c, -s], [s, c]]) + CENTER + k * SHIFT - x
        yield forward.astype(np.float32), back.astype(np.float32)


def write(folder, suffix, masks=None, names=range(8, 8 + FRAMES)):
    folder.mkdir(exist_ok=True)
    for k, pair in enumerate(flows()):
        for values, stem in zip(pair, (f"{names[k]}_fwd", f"{names[k + 1]}_bwd"), strict=True):
            path = folder / f"{stem}{suffix}"
            if suffix == ".npz":
                np.savez(path, flow=values, **({} if masks is None else {"mask": masks}))
            elif suffix == ".npy":
                np.save(path, values)
            else:
                size = np.array([WIDTH, HEIGHT], "<i4").tobytes()
                path.write_bytes(b"PIEH" + size + values.astype("<f4").tobytes())
    return folder


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".flo"])
def test_points_are_followed_along_a_motion(tmp_path, suffix):
    positions, visible = read_tracked_points(write(tmp_path / "flow", suffix), (WIDTH, HEIGHT))
    assert positions.shape[1:] == (FRAMES, 2)
    assert len(positions) > 1000
    assert (visible.sum(1) >= 8).all()
    first = visible.argmax(1)
    start = positions[np.arange(len(positions)), first] - 0.5
    for k in range(FRAMES):
        seen = visible[:, k]
        expected = np.array(
            [moved(p - n * SHIFT, k - n) + n * SHIFT for p, n in zip(start[seen], first[seen], strict=True)]
        )
        np.testing.assert_allclose(positions[seen, k] - 0.5, expected, atol=0.02)
    later = first > 0
    assert 0 < later.sum() < len(first) / 2  # new points come in at the side


def test_positions_are_in_pixels_of_the_frames_if_flow_is_smaller(tmp_path):
    write(tmp_path / "flow", ".npy")
    small, large = (read_tracked_points(tmp_path / "flow", (k * WIDTH, k * HEIGHT)) for k in (1, 3))
    np.testing.assert_allclose(large.positions, 3.0 * small.positions, rtol=1e-6)


def test_points_are_lost_where_flow_back_leads_elsewhere_or_the_mask_says_so(tmp_path):
    mask = np.ones((HEIGHT, WIDTH))
    mask[:, 40:] = 0.0
    positions, visible = read_tracked_points(write(tmp_path / "flow", ".npz", mask), (WIDTH, HEIGHT))
    assert (positions[visible][:, 0] < 43.0).all()
    path = tmp_path / "flow" / "14_bwd.npz"
    back = np.load(path)["flow"].copy()
    back[:24] += 3.0
    np.savez(path, flow=back)
    positions, visible = read_tracked_points(tmp_path / "flow", (WIDTH, HEIGHT))
    through = visible[:, 5] & visible[:, 6]
    assert through.sum() > 100
    assert (positions[through, 6, 1] > 23.5).all()


def test_the_number_of_tracks_is_bounded_and_they_span_the_video(tmp_path, monkeypatch):
    write(tmp_path / "flow", ".npy")
    everything = read_tracked_points(tmp_path / "flow", (WIDTH, HEIGHT))
    monkeypatch.setattr(flow, "MAX_TRACKS", 100)
    positions, visible = read_tracked_points(tmp_path / "flow", (WIDTH, HEIGHT))
    assert len(positions) == 100
    assert visible[-1, 0] != visible[0, 0]
    assert np.isin(positions[visible][:, 0], everything.positions[everything.visible][:, 0]).all()


def remove(folder):
    (folder / "10_bwd.npy").unlink()


def other_size(folder):
    np.save(folder / "12_fwd.npy", np.zeros((HEIGHT, WIDTH + 1, 2)))


def no_flow(folder):
    np.save(folder / "12_fwd.npy", np.zeros((HEIGHT, WIDTH)))


def forward_only(folder):
    for path in folder.glob("*_bwd.npy"):
        path.unlink()


def wrong_way(folder):
    for path in folder.glob("*_bwd.npy"):
        np.save(path, 9.0 - np.load(path))


def damaged(folder):
    (folder / "8_fwd.npy").unlink()
    (folder / "8_fwd.flo").write_bytes(b"PIEH" + np.array([10_000, 10_000], "<i4").tobytes() + b"\0" * 80)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (remove, "flow has no file 10_bwd: expected <frame>_fwd and <frame>_bwd"),
        (forward_only, "flow has no file 9_bwd"),
        (other_size, r"12_fwd.npy: expected flow \[48, 64, 2\] as of the first frame, got \[48, 65, 2\]"),
        (no_flow, r"12_fwd.npy: expected flow \[H, W, 2\], got \[48, 64\]"),
        (wrong_way, "flow back confirms no point"),
        (damaged, "8_fwd.flo is damaged or not a .flo file"),
        (lambda folder: [path.unlink() for path in folder.iterdir()], "has no optical flow of two frames"),
    ],
)
def test_bad_flow_is_refused_in_one_line(tmp_path, change, message):
    folder = write(tmp_path / "flow", ".npy")
    change(folder)
    with pytest.raises(ValueError, match=message) as caught:
        read_tracked_points(folder, (WIDTH, HEIGHT))
    assert "\n" not in str(caught.value)
    assert str(folder) in str(caught.value)
