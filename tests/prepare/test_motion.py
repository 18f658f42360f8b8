"""Dense geometry, masks and depth on a film whose cameras are known."""

import numpy as np
import pytest

from tests.prepare import filmed
from warpgs.prepare.dense import Flows, Observation, PosedFrames, filled, triangulate
from warpgs.prepare.depth import static_depth, write_depth
from warpgs.prepare.motion_masks import find_moving, lift, outline, tidy, vote


@pytest.fixture(scope="module")
def film():
    return filmed.film(24)


@pytest.fixture(scope="module")
def footage(film):
    return PosedFrames(lift(film[0]), filmed.lens(), filmed.poses(24), filmed.points())


def wall_depth(frame: int, row: int, column: int) -> float:
    """Depth of the wall behind a pixel."""
    view = filmed.pose(frame / 23)
    ray = np.array([(column + 0.5 - 128) / filmed.FOCAL, (row + 0.5 - 96) / filmed.FOCAL, 1.0])
    center, direction = -view[:, :3].T @ view[:, 3], view[:, :3].T @ ray
    return float((6.0 - center[2]) / direction[2])


def observation(rho: float, rotation: np.ndarray, shift: np.ndarray) -> Observation:
    ray = np.array([0.1, -0.2, 1.0], np.float32)
    turned = (rotation @ ray).astype(np.float32)
    seen = turned + rho * shift
    place = np.broadcast_to((seen[:2] / seen[2])[:, None, None], (2, 1, 1)).astype(np.float32)
    return Observation(place, turned[:, None, None], shift.astype(np.float32), np.ones((1, 1), bool))


def test_depth_is_solved_exactly_from_exact_places():
    shifts = [np.array([0.3, 0.0, 0.1]), np.array([-0.2, 0.1, 0.0])]
    found = triangulate([observation(0.4, np.eye(3), shift) for shift in shifts], 200.0)
    assert found.inverse_depth.item() == pytest.approx(0.4, rel=1e-3)
    assert found.residual.item() < 1e-2


def test_one_wrong_place_among_many_is_outvoted():
    shifts = [np.array([0.3, 0.0, 0.0]), np.array([-0.3, 0.0, 0.0]), np.array([0.0, 0.3, 0.0]), np.array([0.2, 0.2, 0])]
    wrong = observation(3.0, np.eye(3), np.array([0.25, 0.0, 0.0]))
    found = triangulate([*(observation(0.4, np.eye(3), shift) for shift in shifts), wrong], 200.0)
    assert found.inverse_depth.item() == pytest.approx(0.4, rel=0.05)


def test_a_pixel_that_one_frame_sees_has_no_depth():
    found = triangulate([observation(0.4, np.eye(3), np.array([0.3, 0.0, 0.0]))], 200.0)
    assert np.isnan(found.inverse_depth).all()


def test_unknown_pixels_are_filled_from_the_nearest():
    plane = np.full((3, 5), np.nan, np.float32)
    assert not filled(plane).any()
    plane[1, 0], plane[1, 4] = 2.0, 7.0
    assert filled(plane)[1].tolist()[:2] == [2.0, 2.0]
    assert filled(plane)[1].tolist()[3:] == [7.0, 7.0]


def test_neighbours_lie_on_both_sides_and_are_near(footage):
    assert {k < 12 for k in footage.neighbours(12)} == {True, False}
    assert max(abs(k - 12) for k in footage.neighbours(12)) <= 4
    assert min(footage.neighbours(0)) > 0


def test_the_flows_asked_for_last_are_kept(film, monkeypatch):
    monkeypatch.setattr("warpgs.prepare.dense.CACHED_FLOWS", 2)
    flows, made = Flows(film[0][:3]), []
    monkeypatch.setattr(flows, "between", lambda a, b: made.append(1) or np.zeros((*a.shape, 2), np.float32))
    for pair in ((0, 1), (1, 2), (0, 1), (2, 0), (0, 1)):
        flows.flow(*pair)
    assert len(made) == 3


def test_the_board_that_moves_is_masked(film, footage):
    images, truth = film
    found = find_moving(lift(images), footage)
    shares = [(a & b).sum() / (a | b).sum() for a, b in zip(found, truth, strict=True)]
    assert np.mean(shares) > 0.7
    assert np.mean([(found[k] & ~truth[k]).mean() for k in range(24)]) < 0.03


def test_nothing_is_masked_where_nothing_moves():
    images, _ = filmed.film(16, moves=False)
    found = find_moving(lift(images), PosedFrames(lift(images), filmed.lens(), filmed.poses(16), filmed.points()))
    assert np.mean(found) < 0.02


def test_depth_of_the_wall_is_right_to_two_percent(film, footage):
    planes = static_depth(footage, film[1])
    errors = []
    for frame in range(4, 20):
        places = [(row, column) for row in (150, 170, 180) for column in (110, 120, 130)]
        values = [(planes[frame][place], wall_depth(frame, *place)) for place in places]
        errors += [abs(rho * depth - 1.0) for rho, depth in values if np.isfinite(rho)]
    assert len(errors) > 50
    assert np.median(errors) < 0.02


def test_depth_is_unknown_where_it_moves(film, footage):
    planes = static_depth(footage, film[1])
    assert all(np.isnan(plane[mask]).all() for plane, mask in zip(planes, film[1], strict=True))
    assert np.mean([np.isfinite(plane).mean() for plane in planes]) > 0.5


def test_depth_without_a_known_pixel_is_written_all_the_same(tmp_path):
    write_depth(tmp_path / "depth/1x/a.npy", np.full((4, 5), np.nan, np.float32))
    assert np.isnan(np.load(tmp_path / "depth/1x/a.npy")).all()


def test_dark_pictures_are_lifted_to_middle_grey_and_black_ones_stay(film):
    dark = [image // 6 for image in film[0][:2]]
    assert np.median(lift(dark)[0]) > 3 * np.median(dark[0])
    assert not lift([np.zeros((8, 8, 3), np.uint8)])[0].any()


def test_specks_and_pinholes_are_tidied_away():
    moving = np.zeros((100, 200), bool)
    moving[20:60, 50:120] = True
    moving[40, 80] = False
    moving[90, 190] = True
    tidied = tidy(moving)
    assert tidied[20:60, 50:120].all()
    assert not tidied[85:, 180:].any()


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_masks_of_nothing_and_of_everything_keep_their_meaning(share, film):
    assert (outline(film[0][0], np.full((192, 256), share)) == bool(share)).all()


def test_a_flicker_in_one_frame_is_outvoted_and_a_gap_is_filled():
    shape = (4, 6)
    everywhere = np.arange(24)
    moving = np.zeros((5, *shape), bool)
    moving[:, :, :2] = True
    moving[2, :, :2] = False
    moving[2, :, 4] = True
    voted = vote(list(moving), [(everywhere, everywhere)] * 4)
    assert voted[2][:, :2].all()
    assert not voted[2][:, 4].any()


def test_votes_follow_the_motion():
    moving = np.zeros((3, 1, 6), bool)
    for k in range(3):
        moving[k, 0, k + 1] = True
    step = (np.arange(5), np.arange(1, 6))
    assert np.array_equal(vote(list(moving), [step, step]), moving)
