"""Inverse depth in colours."""

import subprocess
import sys

import cv2
import numpy as np
import pytest

from warpgs.visualize.depth import depth_image

H, W = 24, 32
INVERSE = np.random.default_rng(0).uniform(0.5, 1.5, (H, W)).astype(np.float32)


def test_near_depth_is_red_and_far_depth_blue():
    image = depth_image(np.linspace(0.1, 2.0, W, dtype=np.float32)[None].repeat(H, 0))
    (far_red, _, far_blue), (near_red, _, near_blue) = image[0, 1].astype(int), image[0, -2].astype(int)
    assert far_blue > far_red
    assert near_red > near_blue


def test_depth_colours_are_those_of_turbo_between_the_percentiles():
    low, high = np.percentile(INVERSE, [2, 98])
    level = np.clip((INVERSE - low) / (high - low) * 255, 0, 255).round().astype(np.uint8)
    expected = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1]
    assert np.array_equal(depth_image(INVERSE), expected)


@pytest.mark.parametrize("unknown", [0, 96])
def test_unknown_depth_has_the_requested_grey_and_changes_no_other_colour(unknown):
    complete = depth_image(np.concatenate([INVERSE, INVERSE]))
    inverse_with_gap = np.concatenate([INVERSE, INVERSE, np.full((3, W), np.nan, np.float32)])
    image = depth_image(inverse_with_gap, unknown)
    assert np.array_equal(image[: 2 * H], complete)
    assert (image[2 * H :] == unknown).all()


def test_an_image_without_any_depth_is_grey():
    assert (depth_image(np.full((H, W), np.nan, np.float32), 96) == 96).all()


def test_a_wall_at_one_depth_has_one_colour():
    wall = np.float32(0.5) + np.random.default_rng(0).uniform(-1e-8, 1e-8, (H, W)).astype(np.float32)
    assert len(np.unique(depth_image(wall).reshape(-1, 3), axis=0)) == 1


@pytest.mark.parametrize("scale", [1e-20, 1e-8, 1e8])
def test_the_colours_do_not_depend_on_the_unit_of_depth(scale):
    levels = np.abs(depth_image(np.float32(scale) * INVERSE).astype(int) - depth_image(INVERSE))
    assert np.median(levels) == 0
    assert levels.max() < 20  # a neighbouring colour


def test_infinitely_far_pixels_have_one_colour():
    assert len(np.unique(depth_image(np.zeros((H, W), np.float32)).reshape(-1, 3), axis=0)) == 1


def test_no_torch_is_imported_for_contact_sheets():
    """``warpgs prepare`` runs for minutes on machines that have better uses for the memory."""
    code = "import sys, warpgs.prepare.contact_sheet; assert 'torch' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
