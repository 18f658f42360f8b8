"""Perturbation of training masks."""

import numpy as np
import pytest

from tests.data.captures import dynamic_block
from warpgs.config import MaskPerturbation, TrainConfig, validate
from warpgs.data.masks import connected_regions, perturb

STATIC = np.ones((120, 160), dtype=bool)
STATIC[30:90, 40:110] = False


def test_regions_are_connected_by_sides_and_have_a_minimum_area():
    mask = np.zeros((6, 8), bool)
    mask[0:2, 0:2] = mask[2:4, 2:5] = mask[5, 7] = True
    regions = connected_regions(mask, 4)
    assert [int(region.sum()) for region in regions] == [4, 6]
    assert np.array_equal(regions[0] | regions[1] | (np.arange(48).reshape(6, 8) == 47), mask)
    assert connected_regions(np.zeros((3, 4), bool), 1) == []


def test_no_perturbation_changes_nothing():
    assert np.array_equal(perturb(STATIC, MaskPerturbation(), "a"), STATIC)


def test_erosion_removes_its_radius_on_every_side():
    eroded = perturb(STATIC, MaskPerturbation(erode=3), "a")
    assert (~eroded).sum() == (60 - 6) * (70 - 6)
    assert not (~eroded & STATIC).any()


def test_dilation_adds_exactly_its_radius():
    grown = perturb(STATIC, MaskPerturbation(dilate=3), "a")
    assert grown[60, 34:40].tolist() == [True, True, True, False, False, False]
    assert not (grown & ~STATIC).any()


def test_objects_are_not_eroded_along_the_border_of_the_image():
    cut = np.ones((20, 20), dtype=bool)
    cut[:, :10] = False
    assert np.array_equal(perturb(cut, MaskPerturbation(erode=2), "a")[0], np.arange(20) >= 8)


def test_holes_cover_about_their_fraction_of_the_dynamic_region_only():
    holed = perturb(STATIC, MaskPerturbation(holes=0.3), "a")
    assert 0.3 <= 1 - (~holed).sum() / (~STATIC).sum() < 0.4
    assert not (~holed & STATIC).any()


def test_holes_depend_on_the_name():
    first, again, other = (perturb(STATIC, MaskPerturbation(holes=0.3), name) for name in ("a", "a", "b"))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_the_given_mask_is_unchanged():
    given = STATIC.copy()
    perturb(given, MaskPerturbation(erode=1, dilate=2, holes=0.5), "a")
    assert np.array_equal(given, STATIC)


def test_a_static_mask_stays_static():
    assert perturb(np.ones((9, 9), dtype=bool), MaskPerturbation(erode=3, dilate=3, holes=0.5), "a").all()


def test_an_entirely_dynamic_mask_can_be_perturbed():
    assert perturb(dynamic_block() > 300, MaskPerturbation(erode=2, dilate=2), "a").sum() == 0


@pytest.mark.parametrize(
    ("changes", "field"),
    [({"erode": -1}, "erode"), ({"dilate": 10**6}, "dilate"), ({"holes": 1.0}, "holes"), ({"holes": np.nan}, "holes")],
)
def test_a_perturbation_out_of_range_is_refused_by_name(changes, field):
    with pytest.raises(ValueError, match=field):
        perturb(STATIC, MaskPerturbation(**changes), "a")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, MaskPerturbation()),
        ("erode:4", MaskPerturbation(erode=4)),
        ("dilate:2,holes:0.25", MaskPerturbation(dilate=2, holes=0.25)),
    ],
)
def test_damage_is_parsed_from_the_option(text, expected):
    assert MaskPerturbation.parse(text) == expected


@pytest.mark.parametrize("text", ["", "erode", "erode:x", "erode:0.5", "shrink:2", "erode:1:2", "erode:1;holes:0.1"])
def test_damage_that_cannot_be_parsed_is_refused(text):
    with pytest.raises(ValueError, match=r"^damage_masks must be erode:PIXELS, dilate:PIXELS or holes:FRACTION, got"):
        validate(TrainConfig(damage_masks=text))
