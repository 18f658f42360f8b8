"""Masks of a video with known cameras: evidence of motion, superpixels, far frames, outlines."""

import cv2
import numpy as np
import pytest

from tests.prepare import boards
from warpgs.prepare.depth.flow import static_depth
from warpgs.prepare.frames.flow import Flows
from warpgs.prepare.frames.images import brighten
from warpgs.prepare.masks import motion
from warpgs.prepare.masks.motion import clean, confirmed, find_dynamic, gather, outline, vote
from warpgs.prepare.masks.revisits import MIN_GAPS, Agreement, Evidence, Revisits
from warpgs.prepare.masks.segments import Graph, Segments, segment


@pytest.mark.parametrize("estimate", ["masks", "depth"])
def test_every_flow_is_computed_once_at_half_the_size(estimate, video, monkeypatch):
    compute, pairs, shapes = Flows.compute, [], set()

    def counted(self, a, b, *start, **options):
        shapes.add(a.shape)
        indices = [next((k for k, plane in enumerate(self.planes) if plane is image), None) for image in (a, b)]
        is_warped = None in indices  # see ``Revisits``; what remains is found at half the size
        assert options.get("coarse", False) == is_warped
        if not is_warped:
            pairs.append(tuple(indices))
        return compute(self, a, b, *start, **options)

    monkeypatch.setattr(Flows, "compute", counted)
    frames = boards.posed(video[0])
    find_dynamic(frames) if estimate == "masks" else static_depth(frames, video[1])
    assert len(pairs) == len(set(pairs)) > 100
    assert shapes == {(96, 128)}


def test_depth_of_frames_that_masks_were_found_on_is_the_same_without_flow_of_its_own(monkeypatch):
    images, dynamic = boards.record(10)
    fresh, used = boards.posed(images), boards.posed(images)
    expected = static_depth(fresh, dynamic)
    used.halved.triangulated = {}
    find_dynamic(used)
    assert fresh.halved.triangulated is None
    monkeypatch.delattr(Flows, "compute")
    assert np.array_equal(static_depth(used, dynamic), expected, equal_nan=True)


def test_the_moving_board_is_masked(video, frames):
    truth = video[1]
    found = find_dynamic(frames)
    assert np.mean([boards.overlap(a, b) for a, b in zip(found, truth, strict=True)]) > 0.7
    assert np.mean([(found[k] & ~truth[k]).mean() for k in range(24)]) < 0.03


def test_a_dynamic_colour_does_not_outvote_proof_that_a_surface_is_static():
    """Red moves; red that far frames confirm is static, as is grey; red of which nothing is known moves, too."""
    red, grey, size = [200.0, 200.0, 128.0], [100.0, 128.0, 128.0], np.full(63, 2000.0)
    segments = Segments(
        labels=np.arange(63)[None, :].repeat(4, 0),
        sizes=size,
        colors=np.array([*[red] * 6, red, grey, red] * 7),
        log_inverse_depth=np.arange(63.0),  # so no neighbour counts
        static=size * np.array([[*[0.0] * 6, 0.1, 0.5, 0.0] * 7, [1.0] * 63]),
        dynamic=size * np.array([[*[0.9] * 6, 0.0, 0.0, 0.0] * 7, [0.0] * 63]),
    )
    graph = Graph([segments], [])
    (probability,) = graph.dynamic_probabilities(0)
    *moving, confirmed, other, unknown = probability[0].reshape(7, 9).T
    assert np.min(moving) > 0.85
    assert confirmed.max() < 0.4
    assert other.max() < 0.1
    assert unknown.min() > 0.6
    assert graph.dynamic_probabilities(1)[0].max() < 0.1  # the other kind of evidence


def gathered(image: np.ndarray, residual: np.ndarray, witnesses: int = 0, followed: bool = True) -> Segments:
    """The evidence on an image, with a residual in pixels and nothing that agrees in the far frames."""
    nothing = np.zeros(residual.shape, np.float32)
    seen = np.full(residual.shape, witnesses, np.uint8)
    evidence = Evidence(residual, (Agreement(nothing, seen),) * 2, nothing + 1.0)
    lab = cv2.cvtColor(image, cv2.COLOR_RGB2LAB)
    return gather(lab, evidence, np.full(image.shape[:2], followed))


def test_evidence_at_half_the_size_counts_where_it_is():
    image = np.random.default_rng(0).integers(0, 256, (96, 128, 3), np.uint8)
    residual = np.zeros((48, 64), np.float32)
    residual[12:36, 32:] = 10.0
    moves = np.zeros(image.shape[:2], bool)
    moves[32:64, 72:] = True  # inner superpixels
    found = gathered(cv2.GaussianBlur(image, (0, 0), 1.5), residual)
    _, dynamic = evidence_on(moves, found)
    _, elsewhere = evidence_on((slice(None), slice(0, 40)), found)
    assert dynamic > 0.1
    assert elsewhere == 0.0


def evidence_on(region: tuple, found: Segments) -> tuple[float, float]:
    """Mean static and dynamic evidence per pixel of a region."""
    return tuple(float((kind[0] / found.sizes)[found.labels][region].mean()) for kind in (found.static, found.dynamic))


def test_where_no_far_frame_looks_the_neighbours_decide(video):
    """On the left they fit, in the middle they fit badly, on the right not at all."""
    residual = np.full(video[0][0].shape[:2], 0.1, np.float32)
    residual[:, 135:], residual[:, 200:] = 1.0, 3.0
    found = gathered(video[0][0], residual)
    static, dynamic = evidence_on(np.s_[:, :115], found)
    assert static > 0.2
    assert dynamic < 1e-4
    static, dynamic = evidence_on(np.s_[:, 155:180], found)
    assert static < 0.02
    assert dynamic < 1e-4
    static, dynamic = evidence_on(np.s_[:, 215:], found)
    assert static < 1e-4
    assert dynamic > 0.1


def test_residuals_count_relative_to_the_noise_of_the_frame(video):
    """Where cameras fit a frame badly everywhere, that is no motion."""
    residual = np.full(video[0][0].shape[:2], 3.0, np.float32)
    assert not gathered(video[0][0], residual).dynamic.any()
    assert not gathered(video[0][0], np.full_like(residual, np.nan)).dynamic.any()


@pytest.mark.parametrize("witnesses", [0, 6])
def test_stripes_are_no_evidence_of_motion(witnesses):
    """Flow along a stripe is a guess, so what contradicts the cameras there may be that guess."""
    row, column = np.mgrid[:144, :256]
    stripes = (128 + 60 * np.sin(row / 3.0)).astype(np.uint8)
    checks = (128 + 60 * np.sin(row / 3.0) * np.sin(column / 3.0)).astype(np.uint8)
    residual = np.full((144, 256), 0.1, np.float32)
    residual[40:100, 80:180] = 5.0
    inner = np.s_[55:85, 95:165]
    of_stripes, of_checks = (
        evidence_on(inner, gathered(np.repeat(image[..., None], 3, 2), residual, witnesses))[1]
        for image in (stripes, checks)
    )
    assert of_checks > 0.2
    assert of_stripes < 0.02 * of_checks


@pytest.mark.parametrize(("contrast", "least", "most"), [(6, 0.0, 0.25), (60, 0.9, 1.0)])
def test_weak_texture_that_no_frame_shows_again_is_little_evidence_of_motion(contrast, least, most):
    """Blurred asphalt is found nowhere; strong texture would have been found if it stood still."""
    row, column = np.mgrid[:144, :256]
    checks = (128 + contrast * np.sin(row / 3.0) * np.sin(column / 3.0)).astype(np.uint8)
    image, residual = np.repeat(checks[..., None], 3, 2), np.full((144, 256), np.nan, np.float32)
    inner = np.s_[40:100, 80:180]
    followed, lost = (evidence_on(inner, gathered(image, residual, 6, is_followed))[1] for is_followed in (True, False))
    assert followed > 0.05
    assert least * followed <= lost <= most * followed


def test_evidence_on_a_thin_superpixel_counts_for_all_of_it():
    image = np.full((96, 128, 3), 90, np.uint8)
    image[:, 62:66] = 250
    moves = np.full((1, 96, 128), 0.5, np.float32)
    found = segment(cv2.cvtColor(image, cv2.COLOR_RGB2LAB), moves[0], 0.0 * moves, moves)
    thin = np.unique(found.labels[:, 63:65])
    assert (found.sizes[thin] < 80).all()
    assert np.allclose(found.dynamic[0, thin] / found.sizes[thin], 0.35, atol=0.02)


def test_nothing_is_masked_where_nothing_moves():
    assert np.mean(find_dynamic(boards.posed(boards.record(16, moves=False)[0]))) < 0.02


@pytest.mark.parametrize("min_gap", MIN_GAPS)
@pytest.mark.parametrize("num_frames", [24, 48])
def test_far_frames_of_a_set_are_as_far_away_as_it_says(min_gap, num_frames):
    frames = boards.posed(boards.record(num_frames)[0])
    revisits = Revisits(frames, Flows(frames.images))
    gaps = [abs(k - num_frames // 2) for k in revisits.far_frames(num_frames // 2, 0.2, min_gap)]
    assert gaps
    assert min(gaps) == min(min_gap, num_frames // 5)  # of a short video at most a fifth


def test_evidence_is_found_beside_both_sets_of_far_frames():
    frames = boards.posed(boards.record(48)[0])
    flows = Flows(brighten(frames.images), frames.expected_flow)
    farther, nearer = Revisits(frames, flows).evidence(24).agreements
    assert farther.witnesses.max() > 2
    assert nearer.witnesses.max() > 2
    assert not np.array_equal(farther.agreement, nearer.agreement)


def test_small_regions_and_holes_are_removed():
    dynamic = np.zeros((100, 200), bool)
    dynamic[20:60, 50:120] = True
    dynamic[40, 80] = False
    dynamic[90, 190] = True
    cleaned = clean(dynamic)
    assert cleaned[20:60, 50:120].all()
    assert not cleaned[85:, 180:].any()


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_the_outline_of_nothing_is_empty_and_that_of_everything_full(probability, video):
    assert (outline(video[0][0], np.full((192, 256), probability)) == bool(probability)).all()


def test_a_flicker_in_one_frame_is_outvoted_and_a_gap_is_filled():
    shape = (4, 6)
    everywhere = np.arange(24)
    dynamic = np.zeros((5, *shape), bool)
    dynamic[:, :, :2] = True
    dynamic[2, :, :2] = False
    dynamic[2, :, 4] = True
    voted = vote(list(dynamic), [(everywhere, everywhere)] * 4)
    assert voted[2][:, :2].all()
    assert not voted[2][:, 4].any()


def blocks(*columns: int) -> np.ndarray:
    """[4, 12] regions that begin at these columns and are two columns wide."""
    mask = np.zeros((4, 12), bool)
    for column in columns:
        mask[:, column : column + 2] = True
    return mask


STILL, LOST = (np.arange(48), np.arange(48)), (np.zeros(0, np.int64), np.zeros(0, np.int64))
"""Flow between two frames in which nothing moves, and in which no pixel is seen again."""


def test_an_object_of_which_nothing_is_certain_is_dropped():
    kept = confirmed([blocks(1, 5)] * 3, [blocks(5)] * 3, [STILL] * 2)
    assert np.array_equal(kept, [blocks(5)] * 3)


def test_an_object_that_is_certain_in_other_frames_stays_in_all():
    """A hand that hesitates for some frames."""
    masks, certain = [blocks(1)] * 3, [blocks(1), blocks(), blocks(1)]
    assert np.array_equal(confirmed(masks, certain, [STILL] * 2), masks)
    assert not confirmed(masks, certain, [LOST] * 2)[1].any()


def test_a_large_object_is_not_confirmed_by_a_small_one_that_flow_carries_into_it():
    masks = [blocks(1, 3, 5, 7), blocks(3), blocks(1, 3, 5, 7)]
    kept = confirmed(masks, [blocks(), blocks(3), blocks()], [STILL] * 2)
    assert not kept[0].any()
    assert np.array_equal(kept[1], blocks(3))


@pytest.mark.parametrize(("width", "added"), [(2, False), (30, True)])
def test_what_only_the_nearer_far_frames_show_is_added_if_it_is_much(width, added, frames, monkeypatch):
    still = np.arange(192 * 256)
    slow, fast = (np.zeros((192, 256), np.float32) for _ in range(2))
    slow[50:150, 20:120] = fast[50:150, 20:120] = 1.0
    fast[50:150, 180 : 180 + width] = 1.0

    class Solved:
        def __init__(self, segments, carried):
            self.count = len(segments)

        def dynamic_probabilities(self, kind):
            return [(slow, fast)[kind]] * self.count

    monkeypatch.setattr(motion, "Graph", Solved)
    monkeypatch.setattr(motion._Finder, "find", lambda self, k: (None, (still, still) if k < 23 else None))
    monkeypatch.setattr(motion, "outline", lambda image, probability: probability > 0.5)
    for mask in find_dynamic(frames):
        assert mask[60:140, 30:110].all()
        assert mask[60:140, 182:208].any() == added


def test_votes_follow_the_motion():
    dynamic = np.zeros((3, 1, 6), bool)
    for k in range(3):
        dynamic[k, 0, k + 1] = True
    step = (np.arange(5), np.arange(1, 6))
    assert np.array_equal(vote(list(dynamic), [step, step]), dynamic)


def test_a_finger_of_the_colour_of_a_door_is_outlined_with_its_hand():
    """GrabCut alone takes it for background, which has that colour elsewhere."""
    image = np.full((192, 256, 3), 200.0)
    image[:, :80] = image[50:60, 180:230] = 190, 120, 90
    image[20:100, 100:180] = 40, 40, 60
    probability = np.full((192, 256), 0.05, np.float32)
    probability[20:100, 100:180], probability[50:60, 180:230] = 0.97, 0.8
    image += np.random.default_rng(0).normal(0.0, 4.0, image.shape)
    found = outline(image.clip(0, 255).astype(np.uint8), probability)
    assert found[50:60, 185:225].all()
    assert found[20:100, 100:180].all()
    assert found.sum() < 1.02 * (80 * 80 + 10 * 50)


def test_a_region_too_small_for_every_fourth_pixel_is_outlined():
    image = np.full((96, 128, 3), 90, np.uint8)
    image[40:43, 40:43] = 250
    probability = np.zeros((96, 128), np.float32)
    cv2.circle(probability, (41, 41), 4, 0.9, -1)  # blurred, above 0.5 in an odd row or column alone
    found = outline(image, probability)
    assert found[39:44, 39:44].any()
    assert found.mean() < 0.01
