"""Motion between two frames that their cameras do not explain, inside and outside the mask."""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from warpgs.cameras import Camera

from .capture import Capture, Frame
from .findings import Finding, Level
from .sampling import evenly_spaced

MIN_SIDE, MAX_ASPECT = 16, 16
"""Minimum side [px] and maximum ratio of the sides: OpenCV's optical flow crashes on images beyond them."""

COMPARED_SIDE = 512
"""Images are scaled down to this longer side [px]."""

MIN_PIXELS = 200
"""Minimum number of pixels of a median."""

MIN_AGREEING = 0.4
"""Minimum fraction of the textured pixels whose flow leads back: 0.05 to 0.25 between unrelated images, 0.9 between
frames of a slow video."""

MAX_ANGLE = 30.0
"""Maximum angle between the orientations of two cameras; optical flow between views farther apart is no evidence
[degrees]."""

MAX_EPIPOLAR_DISTANCE = 3.0
"""Maximum median distance of static pixels from their epipolar lines [px]; more means that cameras and images do not
match."""


def check_motion(capture: Capture, num_frames: int) -> Iterator[Finding]:
    """Compares masks and cameras with the motion in the images."""
    inside, outside = [], []
    for first, second in _pairs(capture, num_frames):
        found = motion_between(capture.frame(first), capture.frame(second))
        if found is None:
            continue
        outside.append(found.static)
        if found.dynamic is not None:
            inside.append(found.dynamic - found.static)
    if not outside:
        text = "frames that follow each other are seen from cameras too far apart, or have too little texture"
        yield Finding("note", "cameras", f"{text}, to compare their motion")
        return
    static = float(np.median(outside))
    level: Level = "warning" if static > MAX_EPIPOLAR_DISTANCE else "note"
    hint = ": the cameras may not match the images" if level == "warning" else ""
    yield Finding(level, "cameras", f"static pixels are {static:.2f} px off their epipolar lines (median){hint}")
    if len(inside) < 3:
        return
    more = float(np.mean(np.array(inside) > 0))
    if more < 0.25 and float(np.median(inside)) < -0.2:
        text = (
            "static regions of the masks move more than dynamic ones: the masks may be inverted (0 must mean dynamic)"
        )
        yield Finding("error", "masks", text)
    else:
        text = f"dynamic pixels are farther off their epipolar lines than static ones in {more:.0%} of the frames"
        yield Finding("note", "masks", text)


def _pairs(capture: Capture, num_frames: int) -> list[tuple[str, str]]:
    """Frames that follow each other in time, of cameras that are not far apart, evenly spread over the capture."""
    cameras = capture.cameras
    names = sorted(capture.train, key=lambda name: cameras[name].time)
    pairs = [(a, b) for a, b in itertools.pairwise(names) if are_comparable(cameras[a], cameras[b])]
    return evenly_spaced(pairs, num_frames)


@dataclass(frozen=True)
class Motion:
    """Median distances of textured pixels from their epipolar lines [px].

    Attributes:
        static: Median of the pixels that the mask marks as static.
        dynamic: Median of the other pixels; None if there are too few.
    """

    static: float
    dynamic: float | None


def motion_between(first: Frame, second: Frame) -> Motion | None:
    """Compares the optical flow (DIS) from the first frame to the second with the epipolar lines of their cameras.

    Only pixels count whose flow back leads to where they came from.

    Returns:
        The motion; None if too few pixels have texture and flow, the cameras are too far apart (``are_comparable``), or
        the images are too small for optical flow.
    """
    height, width = first.image.shape[:2]
    factor = min(1.0, COMPARED_SIDE / max(height, width))
    size = round(width * factor), round(height * factor)
    if min(size) < MIN_SIDE or not are_comparable(first.camera, second.camera):
        return None
    a, b = (grey_at(frame, size) for frame in (first, second))
    flow, agrees = flow_between(a, b)
    distance = _epipolar_distance(first, second, flow)
    gradient = np.hypot(cv2.Sobel(a, cv2.CV_32F, 1, 0), cv2.Sobel(a, cv2.CV_32F, 0, 1))
    textured = gradient > max(np.quantile(gradient, 0.6), 8.0)
    if agrees[textured].sum() < MIN_AGREEING * textured.sum():
        return None
    textured &= agrees
    static = np.ones(a.shape, bool)
    if first.static_mask is not None:
        mask = first.static_mask.numpy().astype(np.uint8)
        static = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST_EXACT) > 0
    values = [distance[textured & region] for region in (static, ~static)]
    if len(values[0]) < MIN_PIXELS:
        return None
    dynamic = float(np.median(values[1])) if len(values[1]) >= MIN_PIXELS else None
    return Motion(float(np.median(values[0])), dynamic)


def are_comparable(first: Camera, second: Camera) -> bool:
    """Whether the orientations of two cameras are at most ``MAX_ANGLE`` apart."""
    relative = second.viewmat[:3, :3].double() @ first.viewmat[:3, :3].double().T
    return float(relative.trace()) >= 1.0 + 2.0 * math.cos(math.radians(MAX_ANGLE))


def flow_between(
    first: UInt8[np.ndarray, "H W"], second: UInt8[np.ndarray, "H W"]
) -> tuple[Float[np.ndarray, "H W 2"], Bool[np.ndarray, "H W"]]:
    """Optical flow (DIS) from one grey image to another, and whether the flow back is its opposite at its end.

    Up to a pixel and 5 % of its length. Both sides of the images are at least ``MIN_SIDE``.
    """
    method = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    forward, backward = method.calc(first, second, None), method.calc(second, first, None)
    height, width = first.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    far = (1e4,) * 4
    target = x + forward[..., 0], y + forward[..., 1]
    returned = cv2.remap(backward, *target, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=far)
    return forward, np.linalg.norm(forward + returned, axis=-1) < 1.0 + 0.05 * np.linalg.norm(forward, axis=-1)


def grey_at(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """A frame in grey levels with even contrast, as optical flow wants it, resized to (width, height)."""
    plane = cv2.cvtColor(frame.image.numpy(), cv2.COLOR_RGB2GRAY)
    return cv2.createCLAHE(2.0, (8, 8)).apply(cv2.resize(plane, size, interpolation=cv2.INTER_AREA))


def _epipolar_distance(first: Frame, second: Frame, flow: Float[np.ndarray, "H W 2"]) -> Float[np.ndarray, "H W"]:
    """Distance from x' to the line F x, with F = K'⁻ᵀ [t]× R K⁻¹ (Hartley and Zisserman, 9.2.2)."""
    height, width = flow.shape[:2]
    matrices = []
    for frame in (first, second):
        scale = np.diag([width / frame.camera.width, height / frame.camera.height, 1.0])
        matrices.append(scale @ frame.camera.K.double().numpy())
    relative = second.camera.viewmat.double().numpy() @ np.linalg.inv(first.camera.viewmat.double().numpy())
    t = relative[:3, 3]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x, y, np.ones_like(x)], -1)
    target = pixels[..., :2] + flow
    rotated = pixels @ (matrices[1] @ relative[:3, :3] @ np.linalg.inv(matrices[0])).T
    if np.linalg.norm(t) < 1e-6:  # pure rotation: the position of every pixel is known
        return np.linalg.norm(target - rotated[..., :2] / rotated[..., 2:], axis=-1)
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    essential = cross @ relative[:3, :3]
    lines = pixels @ (np.linalg.inv(matrices[1]).T @ essential @ np.linalg.inv(matrices[0])).T
    norm = np.maximum(np.hypot(lines[..., 0], lines[..., 1]), 1e-12)
    return np.abs(lines[..., 0] * target[..., 0] + lines[..., 1] * target[..., 1] + lines[..., 2]) / norm
