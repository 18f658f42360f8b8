"""Damage to training masks."""

import numpy as np
import pytest

from tests.data.captures import moving_block
from warpgs.config import MaskPerturbation
from warpgs.data.masks import perturb

STATIC = np.ones((120, 160), dtype=bool)
STATIC[30:90, 40:110] = False


def moving(static):
    return int((~static).sum())


def test_no_perturbation_changes_nothing():
    assert np.array_equal(perturb(STATIC, MaskPerturbation(), "a"), STATIC)


def test_erosion_takes_its_pixels_off_every_side():
    eroded = perturb(STATIC, MaskPerturbation(erode=3), "a")
    assert moving(eroded) == (60 - 6) * (70 - 6)
    assert not (~eroded & STATIC).any()


def test_dilation_reaches_exactly_its_pixels():
    grown = perturb(STATIC, MaskPerturbation(dilate=3), "a")
    assert grown[60, 34:40].tolist() == [True, True, True, False, False, False]
    assert not (grown & ~STATIC).any()


def test_an_object_cut_by_the_picture_is_not_eroded_along_the_cut():
    cut = np.ones((20, 20), dtype=bool)
    cut[:, :10] = False
    assert np.array_equal(perturb(cut, MaskPerturbation(erode=2), "a")[0], np.arange(20) >= 8)


def test_holes_take_about_their_share_and_only_from_the_moving_region():
    holed = perturb(STATIC, MaskPerturbation(holes=0.3), "a")
    assert 0.3 <= 1 - moving(holed) / moving(STATIC) < 0.4
    assert not (~holed & STATIC).any()


def test_holes_depend_on_the_name_alone():
    first, again, other = (perturb(STATIC, MaskPerturbation(holes=0.3), name) for name in ("a", "a", "b"))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_the_mask_given_is_left_as_it_was():
    given = STATIC.copy()
    perturb(given, MaskPerturbation(erode=1, dilate=2, holes=0.5), "a")
    assert np.array_equal(given, STATIC)


@pytest.mark.parametrize("perturbation", [MaskPerturbation(erode=3, dilate=3, holes=0.5)])
def test_a_mask_with_nothing_moving_stays_so(perturbation):
    assert perturb(np.ones((9, 9), dtype=bool), perturbation, "a").all()


def test_everything_moving_can_be_perturbed():
    assert perturb(moving_block() > 300, MaskPerturbation(erode=2, dilate=2), "a").sum() == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"erode": -1}, "erode"), ({"dilate": 10**6}, "dilate"), ({"holes": 1.0}, "holes"), ({"holes": np.nan}, "holes")],
)
def test_a_perturbation_out_of_range_is_refused_by_name(changes, said):
    with pytest.raises(ValueError, match=said):
        perturb(STATIC, MaskPerturbation(**changes), "a")
