"""Jumps of exposure between frames, found from the images."""

import dataclasses

import pytest
import torch

from tests.scenes import error, generator, make_camera
from warpgs.data.capture import Capture, Frame
from warpgs.initialization.exposure import MIN_JUMP, exposure_gains
from warpgs.views.views import Views

CAMERA = make_camera()
HEIGHT, WIDTH = CAMERA.height, CAMERA.width
STATIC = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
STOP = 1.37
"""A stop, doubled light, of images with a gamma of 2.2."""


def texture():
    """[H, W, 3] colours of medium brightness."""
    return 60.0 + 60.0 * torch.rand(HEIGHT, WIDTH, 3, generator=generator(1))


def capture_of(factors, static_mask=STATIC, images=None, order=None):
    """Frames of one texture, each times a factor; ``order`` are their times."""
    names = [str(k) for k in range(len(factors))]
    times = order or range(len(factors))
    cameras = {n: dataclasses.replace(CAMERA, time=t / len(factors)) for n, t in zip(names, times, strict=True)}

    def read(name):
        image = texture() if images is None else images[int(name)]
        values = (image * torch.as_tensor(factors[int(name)])).round().clamp(0, 255).byte()
        return Frame(name, cameras[name], values, static_mask, None)

    return Capture("made up", cameras, names, [], torch.zeros(0, 3), None, read)


def gains_of(*arguments, **named):
    return exposure_gains(Views(capture_of(*arguments, **named), torch.device("cpu"), 1 << 30))


def test_frames_after_a_jump_are_brighter_until_the_next():
    gains = gains_of([1.0, 1.0, STOP, STOP, 1.0, 1.0, 1.0])
    expected = torch.tensor([1.0, 1.0, STOP, STOP, 1.0, 1.0, 1.0])[:, None].expand(7, 3)
    assert error(gains, expected) < 0.02
    assert torch.equal(gains[expected == 1.0], torch.ones(15))


def test_a_darker_frame_has_a_gain_below_one():
    assert error(gains_of([1.0, 1.0, 0.6, 1.0])[2], torch.full((3,), 0.6)) < 0.02


def test_a_jump_of_white_balance_has_a_gain_for_each_channel():
    gains = gains_of([1.0, 1.0, (1.3, 1.0, 0.8), 1.0])
    assert error(gains[2], torch.tensor([1.3, 1.0, 0.8])) < 0.02


def test_gradual_changes_stay():
    """They add up to half of a stop."""
    step = 0.5 * MIN_JUMP
    assert torch.equal(gains_of([(1 + step) ** k for k in range(6)]), torch.ones(6, 3))


def test_frames_are_compared_in_the_order_of_time():
    gains = gains_of([1.0, STOP, 1.0, STOP, 1.0, 1.0], order=[0, 4, 1, 5, 2, 3])
    assert (gains[[1, 3]] > 1.3).all()
    assert torch.equal(gains[[0, 2, 4, 5]], torch.ones(4, 3))


def test_what_moves_does_not_count():
    static = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    static[:, : WIDTH // 3] = True
    images = [texture() for _ in range(4)]
    images[2][:, WIDTH // 3 :] *= 1.9
    assert torch.equal(gains_of([1.0] * 4, static, images), torch.ones(4, 3))
    assert not torch.equal(gains_of([1.0] * 4, images=images), torch.ones(4, 3))


def test_saturated_pixels_do_not_count():
    """Otherwise the median would be that of the half that is white in both frames."""
    images = [texture() for _ in range(3)]
    for image in images:
        image[: 2 * HEIGHT // 3] = 255.0
    gains = gains_of([1.0, STOP, 1.0], images=images)
    assert error(gains[1], torch.full((3,), STOP)) < 0.02


@pytest.mark.parametrize("value", [0.0, 255.0])
def test_without_pixels_to_compare_there_is_no_jump(value):
    images = [texture(), torch.full((HEIGHT, WIDTH, 3), value), texture()]
    assert torch.equal(gains_of([1.0] * 3, images=images), torch.ones(3, 3))


def test_one_frame_has_no_jump():
    assert torch.equal(gains_of([1.0]), torch.ones(1, 3))


def test_the_white_balance_of_another_camera_is_no_jump():
    capture = capture_of([1.0, STOP, 1.0, STOP, 1.0, STOP])
    cameras = {name: dataclasses.replace(camera, id=int(name) % 2) for name, camera in capture.cameras.items()}
    gains = exposure_gains(Views(capture.with_cameras(cameras), torch.device("cpu"), 1 << 30))
    assert torch.equal(gains, torch.ones(6, 3))


def test_a_jump_is_found_in_the_frames_of_one_camera():
    capture = capture_of([1.0, STOP, 1.0, STOP, 1.0, STOP, 1.0, 1.0])
    cameras = {name: dataclasses.replace(camera, id=int(name) % 2) for name, camera in capture.cameras.items()}
    gains = exposure_gains(Views(capture.with_cameras(cameras), torch.device("cpu"), 1 << 30))
    assert torch.equal(gains[:7], torch.ones(7, 3))
    assert error(gains[7], torch.full((3,), 1.0 / STOP)) < 0.02
