"""Images for people to look at."""

import numpy as np
import pytest
import torch

from warpgs.rendering import Layer, Rendering
from warpgs.visualize.images import CAPTION_HEIGHT, ERROR_RANGE, comparison, error_image, to_bytes

H, W = 20, 32


def layer(value):
    return Layer(torch.full((H, W, 3), value), torch.ones(H, W), None)


@pytest.fixture
def rendering():
    nothing = torch.zeros(0, 2)
    return Rendering(layer(0.2), layer(0.4), layer(0.6), nothing.int(), None, None, None)


@pytest.mark.parametrize(
    ("value", "byte"), [(0.0, 0), (1.0, 255), (-0.5, 0), (7.0, 255), (0.5, 128), (1.4 / 255, 1), (1.6 / 255, 2)]
)
def test_bytes_are_rounded_and_clamped(value, byte):
    assert (to_bytes(torch.full((H, W, 3), value)) == byte).all()


def test_an_image_that_requires_grad_is_converted_to_bytes():
    assert to_bytes(torch.zeros(H, W, 3, requires_grad=True)).shape == (H, W, 3)


def test_larger_errors_are_brighter():
    truth = torch.zeros(H, W, 3)
    image = torch.linspace(0, ERROR_RANGE, W)[None, :, None].expand(H, W, 3)
    brightness = error_image(image, truth).astype(int).sum(2)
    assert (np.diff(brightness, axis=1)[:, 1:] >= 0).all()
    assert brightness[0, 0] < 20
    assert brightness[0, -1] > 600


def test_the_error_image_is_symmetric():
    a, b = torch.rand(H, W, 3), torch.rand(H, W, 3)
    assert (error_image(a, b) == error_image(b, a)).all()


def test_errors_above_the_range_have_the_brightest_colour():
    brightest = error_image(torch.full((H, W, 3), ERROR_RANGE), torch.zeros(H, W, 3))
    assert (error_image(torch.ones(H, W, 3), torch.zeros(H, W, 3)) == brightest).all()


def test_a_comparison_shows_truth_joint_static_dynamic_and_error_in_that_order(rendering):
    sheet = comparison(torch.full((H, W, 3), 1.0), rendering)
    below = sheet[CAPTION_HEIGHT:]
    assert below.shape == (H, 5 * W, 3)
    assert [int(below[5, k * W + 5, 0]) for k in range(4)] == [255, 51, 102, 153]
    error = error_image(rendering.joint.image, torch.full((H, W, 3), 1.0))
    assert (below[:, 4 * W :] == error).all()


def test_every_image_of_a_comparison_has_a_caption(rendering):
    bar = comparison(torch.ones(H, W, 3), rendering)[:CAPTION_HEIGHT]
    assert all(bar[:, k * W : (k + 1) * W].max() > 100 for k in range(5))
