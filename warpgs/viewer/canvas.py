"""Sizes of a browser's canvas, and of images that are as wide as the slider says."""

import viser

MAX_CANVAS = (4096, 2160)
"""Maximum width and height of a canvas to render for [px]."""

MAX_ASPECT = 4
"""Maximum height over width of a keyframe or a screenshot."""

NARROW = 600
"""Width of a canvas below which the panel lies over the image [px]."""


def canvas_of(camera: viser.CameraHandle) -> tuple[int, int]:
    """(width, height) of the canvas, scaled down to ``MAX_CANVAS``: a browser may send any size."""
    width, height = max(1, camera.image_width), max(1, camera.image_height)
    factor = min(1.0, MAX_CANVAS[0] / width, MAX_CANVAS[1] / height)
    return max(1, round(width * factor)), max(1, round(height * factor))


def size_at(canvas: tuple[int, int], across: int) -> tuple[int, int]:
    """(width, height) of an image with another width and the aspect of a canvas, of no more pixels than a canvas."""
    width, height = canvas
    most = min(MAX_ASPECT * across, MAX_CANVAS[0] * MAX_CANVAS[1] // across)
    return across, min(max(1, round(height * across / width)), most)
