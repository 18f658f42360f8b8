"""``warpgs check``: tracks against masks and cameras."""

import shutil

import numpy as np
import pytest

from warpgs.captures.check import check_capture
from warpgs.captures.opening import load_capture
from warpgs.data.tracks import write_tracks
from warpgs.synthetic.studio import StudioSize, studio_capture
from warpgs.synthetic.studio_tracks import broken_tracks, exact_tracks

pytestmark = pytest.mark.usefixtures("without_motion")

SIZE = StudioSize(width=96, height=54, num_frames=12, num_samples=1, num_points=500)


@pytest.fixture(scope="module")
def studio(tmp_path_factory):
    return studio_capture("exact", tmp_path_factory.mktemp("studio"), SIZE, quiet=True)


@pytest.fixture(scope="module")
def exact():
    return exact_tracks(SIZE)


def finding(studio, folder, tracks):
    """What the check says of tracks in a copy of the studio."""
    shutil.copytree(studio, folder)
    write_tracks(folder, *tracks, (SIZE.width, SIZE.height))
    (found,) = [finding for finding in check_capture(folder).findings if finding.topic == "tracks"]
    return found


def test_exact_tracks_fit_the_cameras(studio, exact, tmp_path):
    found = finding(studio, tmp_path / "copy", exact)
    assert found.level == "note"
    assert "100% of the static ones fit the cameras" in found.text


def test_tracks_of_other_frames_do_not_fit_the_cameras(studio, exact, tmp_path):
    positions, visible = exact
    found = finding(studio, tmp_path / "copy", (positions[:, ::-1], visible[:, ::-1]))
    assert found.level == "warning"
    assert "they may be of other frames" in found.text


def test_broken_tracks_fit_masks_less(studio, exact, tmp_path):
    texts = [
        finding(studio, tmp_path / f"copy{k}", tracks).text for k, tracks in enumerate((exact, broken_tracks(exact)))
    ]
    static, dynamic = zip(
        *([int(part.strip("%")) for part in text.split() if "%" in part][:2] for text in texts), strict=True
    )
    assert static[0] + dynamic[0] == 100
    assert static[1] + dynamic[1] < 80


def test_a_capture_without_tracks_says_nothing_of_them(studio):
    assert load_capture(studio).tracks is None
    assert not [finding for finding in check_capture(studio).findings if finding.topic == "tracks"]


def test_exact_tracks_stay_on_the_body_that_the_image_shows(studio, exact):
    """What moves is marked by exact masks: a point is dynamic in all frames that see it, or in none."""
    capture = load_capture(studio)
    positions, visible = exact
    dynamic = np.zeros_like(visible)
    for k, name in enumerate(capture.film):
        mask = capture.frame(name).static_mask.numpy()
        column, row = positions[visible[:, k], k].astype(int).T
        dynamic[visible[:, k], k] = ~mask[row, column]
    part = dynamic.sum(1) / visible.sum(1)
    assert ((part == 0) | (part == 1)).all()
    assert 0.3 < (part == 1).mean() < 0.9


def test_exact_tracks_keep_the_texture_of_the_bodies(studio, exact):
    """Colours of a point in two frames that are one apart differ less than those of two points."""
    capture = load_capture(studio)
    positions, visible = exact
    images = [capture.frame(name).image.numpy().astype(float) for name in capture.film]
    same, other = [], []
    for k in range(len(images) - 1):
        both = np.flatnonzero(visible[:, k] & visible[:, k + 1])
        colors = [images[j][tuple(positions[both, j].astype(int).T[::-1])] for j in (k, k + 1)]
        same.append(np.abs(colors[0] - colors[1]).mean(1))
        other.append(np.abs(colors[0] - np.roll(colors[1], 1, axis=0)).mean(1))
    assert np.median(np.concatenate(same)) < 0.4 * np.median(np.concatenate(other))
