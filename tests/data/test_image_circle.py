"""The circular images of fisheye lenses: found in frames, and not learned or compared beyond."""

import dataclasses
import math

import pytest
import torch

from tests.lens_captures import CAMERAS, changed, recorded
from warpgs.data.capture import Capture, Frame
from warpgs.data.image_circle import with_image_circle
from warpgs.distortion import Distortion

CIRCLE = math.radians(50.0)


def angles() -> torch.Tensor:
    camera = CAMERAS["fisheye"]
    return torch.acos(camera.rays(camera.pixel_centers)[:, 2]).reshape(camera.height, camera.width)


def blackened(frame: Frame) -> Frame:
    return dataclasses.replace(frame, image=torch.where(angles()[..., None] > CIRCLE, 3, frame.image.clamp_min(60)))


def lit(capture: Capture) -> Capture:
    return changed(capture, lambda frame: dataclasses.replace(frame, image=frame.image.clamp_min(60)))


def circles(capture: Capture) -> set[float]:
    return {capture.frame(name).camera.distortion.circle for name in capture.train}


def test_the_circle_of_black_corners_is_found_within_two_pixels():
    (found,) = circles(with_image_circle(changed(recorded("fisheye"), blackened)))
    pixel = 1.0 / float(CAMERAS["fisheye"].K[0, 0])
    assert CIRCLE - 2.5 * pixel < found <= CIRCLE


def test_an_image_without_black_corners_has_no_circle():
    capture = lit(recorded("fisheye"))
    assert with_image_circle(capture) is capture


def test_a_single_bright_pixel_in_a_corner_does_not_hide_the_circle():
    def with_hot_pixel(frame: Frame) -> Frame:
        image = blackened(frame).image.clone()
        image[0, 0] = 255
        return dataclasses.replace(frame, image=image)

    assert max(circles(with_image_circle(changed(recorded("fisheye"), with_hot_pixel)))) <= CIRCLE


def test_a_dark_scene_with_few_lights_has_no_circle():
    def with_light(frame: Frame) -> Frame:
        image = torch.zeros_like(frame.image)
        image[10:16, 20:26] = 200
        return dataclasses.replace(frame, image=image)

    assert circles(with_image_circle(changed(recorded("fisheye"), with_light))) == {math.inf}


def test_frames_of_other_lenses_are_not_read():
    capture = recorded("radial")
    assert with_image_circle(dataclasses.replace(capture, read=lambda name: pytest.fail(name))) is not None


def test_pixels_beyond_the_circle_have_no_ray_and_points_beyond_it_are_not_seen():
    camera = CAMERAS["fisheye"]
    camera = dataclasses.replace(camera, distortion=dataclasses.replace(camera.distortion, circle=CIRCLE))
    beyond = angles().flatten() > CIRCLE
    assert torch.equal(camera.shown.flatten(), ~beyond)
    assert torch.equal(camera.rays(camera.pixel_centers).isnan().any(1), beyond)
    rays = CAMERAS["fisheye"].rays(camera.pixel_centers)
    assert torch.equal(camera.place(rays)[2], ~beyond)


def test_frames_are_black_static_and_without_depth_beyond_the_circle():
    capture = with_image_circle(changed(recorded("fisheye"), blackened))
    frame = capture.frame(capture.val[0])
    beyond = ~frame.camera.shown
    assert frame.image[beyond].max() == 0
    assert frame.static_mask[beyond].all()
    assert frame.inverse_depth[beyond].isnan().all()
    assert frame.inverse_depth[~beyond].isfinite().all()


def test_a_lens_that_folds_back_before_the_corner_shows_nothing_beyond():
    K, size = CAMERAS["fisheye"].K, CAMERAS["fisheye"].size
    folding = Distortion.fisheye([-0.12], K, size)
    camera = dataclasses.replace(CAMERAS["fisheye"], distortion=folding)
    seen = camera.rays(camera.pixel_centers).isfinite().all(1)
    assert not bool(seen.all())
    assert torch.equal(camera.shown.flatten(), seen)


def test_a_circle_must_be_positive():
    with pytest.raises(ValueError, match=r"circle must be positive, got 0"):
        dataclasses.replace(CAMERAS["fisheye"].distortion, circle=0.0)
