"""Arrays of many frames that are kept packed."""

import numpy as np
import pytest
import torch

from warpgs.initialization.packed import packed_images, packed_pixels

MASKS = np.random.default_rng(0).random((3, 20, 30)) < np.array([0.02, 0.5, 0.98])[:, None, None]


@pytest.mark.parametrize("mask", [*MASKS, np.zeros((20, 30), bool), np.ones((20, 30), bool)])
def test_pixels_are_those_that_were_set(mask):
    pixels, expected = packed_pixels(), np.flatnonzero(mask).astype(np.int32)
    pixels[7] = expected
    assert pixels[7].dtype == np.int32
    assert np.array_equal(pixels[7], expected)
    assert (*pixels,) == (7,)


@pytest.mark.parametrize("mask", [*MASKS, np.zeros((20, 30), bool), np.ones((20, 30), bool)])
def test_images_are_those_that_were_set(mask):
    values = np.random.default_rng(1).random(mask.shape).astype(np.float32)
    values[0, :2] = 0.0, np.inf
    images, expected = packed_images(), torch.from_numpy(np.where(mask, values, np.float32(np.nan)))
    images[3] = expected
    assert images[3].dtype == torch.float32
    assert torch.equal(images[3].isnan(), expected.isnan())
    assert torch.equal(images[3].nan_to_num(-1.0, posinf=9.0), expected.nan_to_num(-1.0, posinf=9.0))


def test_what_is_read_is_a_copy():
    images = packed_images()
    images[0] = torch.zeros(2, 3)
    images[0].fill_(1.0)
    assert torch.equal(images[0], torch.zeros(2, 3))


def test_an_index_that_was_not_set_is_missing():
    assert 0 not in packed_pixels()
    with pytest.raises(KeyError):
        packed_pixels()[0]
