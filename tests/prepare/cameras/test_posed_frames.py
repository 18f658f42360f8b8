"""Neighbours of a frame, and the flow that cameras let expect."""

import numpy as np

from tests.prepare import boards
from warpgs.prepare.cameras.posed_frames import PosedFrames
from warpgs.prepare.frames.flow import Flows
from warpgs.prepare.frames.images import brighten


def test_neighbours_are_near_and_in_both_directions(frames):
    assert {k < 12 for k in frames.neighbours[12]} == {True, False}
    assert max(abs(k - 12) for k in frames.neighbours[12]) <= 4
    assert min(frames.neighbours[0]) > 0


def test_flow_that_starts_where_the_cameras_say_is_right_over_wide_steps(video, frames):
    """Eight frames apart, the wall moves by a fifth of the image."""
    truth = np.stack([boards.depth(boards.pose(k / 23)) for k in range(24)])
    agreeing = {}
    for expected in (None, frames.expected_flow):
        flows = Flows(brighten(frames.images), expected)
        fractions = []
        for a, b in ((2, 10), (8, 16), (14, 22)):
            rotation, translation = frames.relative(a, b)
            points = frames.rotated_rays(rotation) * truth[a] + translation[:, None, None]
            column, row = frames.lens.image(points[0] / points[2], points[1] / points[2])
            x, y, _ = flows.track(a, b)
            inside = (column > 0) & (column < 256) & (row > 0) & (row < 192) & ~video[1][a]
            fractions.append((np.hypot(x + 0.5 - column, y + 0.5 - row) < 1.0)[inside].mean())
        agreeing[expected is None] = np.mean(fractions)
    assert agreeing[False] > 0.6
    assert agreeing[False] > agreeing[True] + 0.1


def test_expected_flow_is_exact_on_a_plane_at_the_median_depth():
    poses = np.stack([np.eye(4)[:3], np.eye(4)[:3]])
    poses[1, 0, 3] = -0.5
    plane = PosedFrames([np.zeros((192, 256, 3), np.uint8)] * 2, boards.lens(), poses, np.array([[0.0, 0.0, 5.0]] * 5))
    assert np.allclose(plane.expected_flow(0, 1), [-0.5 * boards.FOCAL / 5.0, 0.0], atol=1e-3)


def test_errors_of_halved_frames_are_in_pixels_of_the_whole_ones(frames):
    small = frames.halved
    assert (small.lens.width, small.lens.height, small.focal) == (128, 96, frames.lens.focal[0])
    assert small.neighbours == frames.neighbours
    assert np.allclose(2.0 * small.expected_flow(2, 6), frames.expected_flow(2, 6)[::2, ::2], atol=0.5)
