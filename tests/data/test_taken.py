"""Frames as they were taken: the wide camera and the positions of their pixels in its image."""

import numpy as np
import pytest
import torch

from tests.data import captures
from tests.data.captures import edit_json, image_of
from warpgs.cameras import Camera
from warpgs.captures.opening import load_capture
from warpgs.data.capture import Frame
from warpgs.data.lens import Lens
from warpgs.data.taken import MARGIN, taken_frame, without_distortion

BARREL = Lens(48, 32, (50.0, 47.0), (25.3, 15.1), (-0.12, 0.03, 0.004), (0.01, -0.006))
PINCUSHION = Lens(48, 32, (50.0, 47.0), (22.0, 17.5), (0.15, 0.02, 0.0), (-0.004, 0.003))
LENSES = pytest.mark.parametrize("lens", [BARREL, PINCUSHION], ids=["barrel", "pincushion"])


def frame_of(lens):
    camera = Camera(torch.eye(4), torch.eye(3), lens.width, lens.height, 0.5)
    return Frame("a", camera, torch.zeros(lens.height, lens.width, 3, dtype=torch.uint8))


@LENSES
def test_the_ray_at_a_position_is_that_of_the_pixel(lens):
    taken = taken_frame(frame_of(lens), lens)
    K, positions = taken.frame.camera.K.double().numpy(), taken.positions.double().numpy()
    x, y = ((positions[..., k] - K[k, 2]) / K[k, k] for k in (0, 1))
    columns, rows = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    assert np.abs(lens.image(x, y) - np.stack([columns, rows])).max() < 1e-3


@LENSES
def test_the_wide_image_holds_all_positions_with_a_margin_and_keeps_the_focal_length(lens):
    taken = taken_frame(frame_of(lens), lens)
    camera = taken.frame.camera
    assert (camera.K[0, 0].item(), camera.K[1, 1].item()) == lens.focal
    for k, side in enumerate(camera.size):
        assert taken.positions[..., k].min() >= MARGIN
        assert taken.positions[..., k].max() <= side - MARGIN
        assert side - (taken.positions[..., k].max() - taken.positions[..., k].min()) < 2 * MARGIN + 2
    assert camera.time == 0.5


def test_without_distortion_positions_are_those_of_the_pixels():
    lens = without_distortion(BARREL)
    taken = taken_frame(frame_of(lens), lens)
    columns, rows = np.meshgrid(np.arange(48) + 0.5, np.arange(32) + 0.5)
    shift = taken.frame.camera.K[:2, 2].numpy() - np.array(lens.center)
    assert np.abs(taken.positions.numpy() - np.stack([columns, rows], 2) - shift).max() < 1e-4


def test_distortion_that_cannot_be_inverted_is_refused():
    folded = Lens(48, 32, (20.0, 20.0), (24.0, 16.0), (-0.9, 0.0, 0.0))
    with pytest.raises(ValueError, match="the distortion cannot be inverted"):
        taken_frame(frame_of(folded), folded)


def test_a_capture_reads_frames_as_they_are_in_its_files(root):
    assert load_capture(root).read_taken is None
    for path in (root / "camera").iterdir():
        edit_json(path, radial_distortion=[-0.1, 0.0, 0.0])
    capture = load_capture(root)
    name = captures.ids_of("nerfds")[1][0]
    taken = capture.read_taken(name)
    assert np.array_equal(taken.frame.image.numpy(), image_of(name, captures.SIZE))
    assert not torch.equal(taken.frame.image, capture.frame(name).image)
    assert torch.equal(taken.frame.static_mask, torch.from_numpy(captures.dynamic_block() > 127))
    assert torch.equal(taken.frame.camera.viewmat, capture.cameras[name].viewmat)
    assert taken.positions.shape == (*taken.frame.image.shape[:2], 2)
