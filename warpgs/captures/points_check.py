"""Compares the cameras, the sparse points and the images of a capture with each other."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch

from warpgs.cameras import Camera
from warpgs.data.capture import Capture, Frame

from .findings import Finding

MIN_VISIBLE_FRACTION = 0.2
"""Median fraction of the points that a training camera should see."""

MIN_POINT_CONTRAST = 0.8
"""Contrast at the points over the contrast of the image: 2 to 4 for points of COLMAP, about 1 for a depth sensor's."""

MIN_POINT_DISTANCE = 0.01
"""Points closer to a camera than this fraction of the median depth are not on surfaces."""

MAX_FRACTION_AT_CAMERAS = 0.01
"""Maximum fraction of such points."""


def check_points(capture: Capture, names: Sequence[str]) -> Iterator[Finding]:
    """Compares cameras, points and images with each other."""
    cameras = [capture.cameras[name] for name in capture.train]
    if capture.hardly_moves:
        share = capture.path_radius / capture.median_depth
        text = (
            f"the camera hardly moves, by {share:.1%} of the depth at which it sees the scene: images do not determine "
            "depth, so trust no render from another place"
        )
        yield Finding("warning", "cameras", text)
    if len(capture.points) == 0:
        remedy = "; warpgs prepare CAPTURE --add points adds some (after warpgs import, if the layout needs it)"
        text = f"there are no sparse points: Gaussians are randomly initialized{'' if capture.is_builtin else remedy}"
        yield Finding("note" if capture.is_builtin else "warning", "points", text)
        return
    visible = [float(capture.cameras[n].project(capture.points)[3].float().mean()) for n in names]
    median = float(np.median(visible))
    yield Finding("note", "points", f"{len(capture.points)} points, a camera sees {median:.0%} of them (median)")
    if median == 0.0:
        text = "the cameras do not see the points: orientation, position or scene.json's center and scale are wrong"
        yield Finding("error", "points", text)
        return
    if median < MIN_VISIBLE_FRACTION:
        yield Finding("warning", "points", f"a camera sees only {median:.0%} of the points (median)")
    yield from _points_at_cameras(capture, cameras)
    contrasts = [c for n in names if (c := _contrast_at_points(capture.frame(n), capture.points)) is not None]
    if contrasts:
        ratio = float(np.median(contrasts))
        low = ratio < MIN_POINT_CONTRAST
        text = f"contrast at the points is {ratio:.2f} times that of the images"
        hint = ": points and cameras may not match the images" if low else ""
        yield Finding("warning" if low else "note", "points", text + hint)


def _points_at_cameras(capture: Capture, cameras: list[Camera]) -> Iterator[Finding]:
    positions = torch.stack([camera.position for camera in cameras[:: max(1, len(cameras) // 200)]])
    points = capture.points[:: max(1, len(capture.points) // 20_000)]
    nearest = torch.cat([torch.cdist(part, positions).amin(1) for part in points.split(2000)])
    fraction = float((nearest < MIN_POINT_DISTANCE * capture.median_depth).float().mean())
    if fraction > MAX_FRACTION_AT_CAMERAS:
        text = f"{fraction:.1%} of the points lie at camera positions, not on surfaces"
        yield Finding("warning", "points", text)


def _contrast_at_points(frame: Frame, points: torch.Tensor) -> float | None:
    """Mean image gradient at static points over that of all static pixels; None if there are too few points."""
    row, column, _, inside = frame.camera.project(points)
    grey = frame.image.float().mean(2)
    gradient = torch.zeros_like(grey)
    gradient[:-1, :-1] = (grey[1:, :-1] - grey[:-1, :-1]).abs() + (grey[:-1, 1:] - grey[:-1, :-1]).abs()
    gradient = torch.nn.functional.max_pool2d(gradient[None], 3, 1, 1)[0]  # points may be off by a pixel
    static = torch.ones_like(grey, dtype=torch.bool) if frame.static_mask is None else frame.static_mask
    seen = inside & static[row, column]
    if int(seen.sum()) < 50 or not bool(static.any()):
        return None
    mean = float(gradient[static].mean())
    return float(gradient[row, column][seen].mean()) / mean if mean > 0 else None
