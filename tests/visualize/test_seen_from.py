"""Images as another camera at the same place sees them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from warpgs.cameras import Camera
from warpgs.distortion import Distortion
from warpgs.visualize.images import seen_from


def camera(angle=0.0, size=(80, 60), fov=1.0):
    """At the origin, turned around y by an angle [rad]."""
    focal = 0.5 * size[1] / math.tan(0.5 * fov)
    return Camera.looking_at((0.0, 0.0, 0.0), (math.sin(angle), 0.0, math.cos(angle)), (0.0, -1.0, 0.0), focal, size)


def directions(camera):
    """An image whose colours are the directions of the pixels' rays in the world."""
    rays = camera.rays(camera.pixel_centers.double()).numpy().reshape(camera.height, camera.width, 3)
    rays = rays @ camera.viewmat[:3, :3].double().numpy()
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    return (127.5 + 127.5 * rays).round().astype(np.uint8)


def through(lens, coefficients):
    """The camera with the distortion of a lens."""
    pinhole = camera()
    return replace(pinhole, distortion=getattr(Distortion, lens)(coefficients, pinhole.K, pinhole.size))


BENT = [through("radial", [-0.1, 0.02, 0.01]), through("fisheye", [0.05])]


@pytest.mark.parametrize("channels", [slice(None), 0], ids=["colour", "grey"])
@pytest.mark.parametrize("own", [camera(), *BENT], ids=["pinhole", "radial", "fisheye"])
@pytest.mark.parametrize(
    "other",
    [*BENT, camera(), camera(0.2), camera(fov=1.4), camera(size=(40, 90)), camera(-0.3, size=(160, 100), fov=0.8)],
)
def test_an_image_shows_every_direction_where_the_other_camera_sees_it(other, own, channels):
    image, inside = seen_from(other, np.ascontiguousarray(directions(own)[..., channels]), own)
    assert inside.mean() > 0.2
    difference = np.abs(image.astype(int) - directions(other)[..., channels].astype(int))
    assert difference[inside].max() <= 3


def test_pixels_that_the_image_does_not_show_are_marked():
    _, inside = seen_from(camera(fov=2.0), directions(camera()), camera())
    assert not inside[0].any()
    assert inside[30, 40]
