"""Motion between two frames that their cameras do not explain, inside and outside the mask."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from warpgs.cameras import Camera, are_comparable
from warpgs.data.capture import Capture, Frame
from warpgs.data.optical_flow import MIN_SIDE, even_contrast, flow_between, grey_levels
from warpgs.data.resized import size_within
from warpgs.data.sampling import evenly_spaced
from warpgs.visualize.images import seen_from

from .findings import Finding, Level

COMPARED_SIDE = 512
"""Images are scaled down to this longer side [px]."""

MIN_PIXELS = 200
"""Minimum number of pixels of a median."""

MIN_PAIRS = 3
"""Minimum number of pairs of frames that tell whether masked regions move more."""

MIN_AGREEING = 0.4
"""Minimum fraction of the textured pixels whose flow leads back: 0.05 to 0.25 between unrelated images, 0.9 between
frames of a slow video."""

MAX_EPIPOLAR_DISTANCE = 3.0
"""Maximum median distance of static pixels from their epipolar lines [px]; more means that cameras and images do not
match."""

MIN_DIFFERENCE = 0.2
"""Minimum difference of the median distances of static and dynamic pixels, for one of them to fit better [px]."""


def pairs_to_compare(capture: Capture, max_count: int) -> list[tuple[str, str]]:
    """Training frames that one camera took one after the other in similar directions, evenly spread in time.

    Half of them are of cameras that move, if there are any: only these tell whether poses are right.
    """
    cameras = capture.cameras
    pairs = [(a, b) for a, b in capture.neighbours(capture.train) if are_comparable(cameras[a], cameras[b])]
    still, moving = list[tuple[str, str]](), list[tuple[str, str]]()
    for a, b in pairs:
        (still if _stands_still(cameras[a], cameras[b]) else moving).append((a, b))
    chosen = evenly_spaced(moving, max(max_count - len(still), -(-max_count // 2)))
    return [*chosen, *evenly_spaced(still, max_count - len(chosen))]


@dataclass(frozen=True)
class Motion:
    """Median distances of textured pixels from their epipolar lines [px].

    Attributes:
        static: Median of the pixels that the mask marks as static.
        dynamic: Median of the other pixels; None if there are too few.
        stands_still: Whether both frames have one pose.
    """

    static: float
    dynamic: float | None
    stands_still: bool = False


def motion_between(first: Frame, second: Frame) -> Motion | None:
    """Compares the optical flow (DIS) from the first frame to the second with the epipolar lines of their cameras.

    Both images are first brought to the orientation, focal length and shape of the first, without the distortion of its
    lens, so that frames of any cameras can be compared. Only pixels count whose flow back leads to where they came
    from.

    Returns:
        The motion; None if too few pixels have texture and flow, the cameras are too far apart (``are_comparable``), or
        the images are too small for optical flow.
    """
    size = size_within(first.camera.size, COMPARED_SIDE)
    if min(*size, *second.camera.size) < MIN_SIDE or not are_comparable(first.camera, second.camera):
        return None
    shown = first.camera.pinhole.resized(*size)
    (a, is_there), (b, is_seen) = (_seen_from(shown, frame) for frame in (first, second))
    flow, agrees = flow_between(a, b)
    distance = _epipolar_distance(first.camera, second.camera, flow)
    gradient = np.hypot(cv2.Sobel(a, cv2.CV_32F, 1, 0), cv2.Sobel(a, cv2.CV_32F, 0, 1))
    textured = (gradient > max(np.quantile(gradient, 0.6), 8.0)) & is_there & is_seen
    if agrees[textured].sum() < MIN_AGREEING * textured.sum():
        return None
    textured &= agrees
    static = np.ones(a.shape, bool)
    if first.static_mask is not None:
        mask = np.where(first.static_mask.numpy(), 255, 0).astype(np.uint8)
        reduced = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST_EXACT).astype(np.uint8)
        static = seen_from(shown, reduced, first.camera.resized(*size))[0] > 127
    values = [distance[textured & region] for region in (static, ~static)]
    if len(values[0]) < MIN_PIXELS:
        return None
    dynamic = float(np.median(values[1])) if len(values[1]) >= MIN_PIXELS else None
    return Motion(float(np.median(values[0])), dynamic, _stands_still(first.camera, second.camera))


def motions_of(capture: Capture, pairs: Sequence[tuple[str, str]]) -> list[Motion]:
    """The motion between the frames of pairs, of those that can be compared."""
    motions = (motion_between(capture.frame(first), capture.frame(second)) for first, second in pairs)
    return [motion for motion in motions if motion is not None]


def check_motion(motions: Sequence[Motion], meaning: str) -> Iterator[Finding]:
    """Compares cameras and masks with the motion in the images; ``meaning`` is the convention of the masks."""
    if not motions:
        text = "frames that follow each other are seen from cameras too far apart, or have too little texture"
        yield Finding("note", "cameras", f"{text}, to compare their motion")
        return
    yield from _check_poses(motions)
    found = _compare_regions(motions)
    if found is not None and found.are_inverted:
        text = f"static regions of the masks move more than dynamic ones: the masks may be inverted ({meaning})"
        yield Finding("error", "masks", text)
    elif found is not None:
        text = f"dynamic pixels are farther off their epipolar lines than static ones in {found.more:.0%} of the frames"
        yield Finding("note", "masks", text)


def _check_poses(motions: Sequence[Motion]) -> Iterator[Finding]:
    """Compares cameras that move with the motion in the images, and says whether others really stand still."""
    wrong = ": the cameras may not match the images"
    if moving := [motion.static for motion in motions if not motion.stands_still]:
        static = float(np.median(moving))
        level: Level = "warning" if static > MAX_EPIPOLAR_DISTANCE else "note"
        text = f"static pixels are {static:.2f} px off their epipolar lines (median)"
        yield Finding(level, "cameras", text + wrong * (level == "warning"))
    if still := [motion.static for motion in motions if motion.stands_still]:
        static = float(np.median(still))
        if static > MAX_EPIPOLAR_DISTANCE:
            text = f"static pixels move by {static:.2f} px (median) where frames have one pose"
            yield Finding("warning", "cameras", text + wrong)
        elif not moving:
            yield Finding("note", "cameras", "no camera moves: motion in the images says nothing about their poses")


def confirm_masks(motions: Sequence[Motion]) -> bool:
    """Whether what masks mark as dynamic moves, and the rest fits the cameras."""
    found = _compare_regions(motions)
    return found is not None and found.are_right


class _Regions(NamedTuple):
    """Static and dynamic regions of pairs of frames, compared.

    Attributes:
        more: Fraction of the pairs whose dynamic pixels are farther off their epipolar lines.
        difference: Median of how much farther they are [px].
        static, dynamic: Medians of their distances [px].
    """

    more: float
    difference: float
    static: float
    dynamic: float

    @property
    def are_inverted(self) -> bool:
        """Whether the cameras fit the dynamic regions better."""
        return self.more < 0.25 and self.difference < -MIN_DIFFERENCE and self.dynamic < MAX_EPIPOLAR_DISTANCE

    @property
    def are_right(self) -> bool:
        """Whether the cameras fit the static regions better."""
        return self.more > 0.75 and self.difference > MIN_DIFFERENCE and self.static < MAX_EPIPOLAR_DISTANCE


def _stands_still(first: Camera, second: Camera) -> bool:
    return torch.equal(first.viewmat, second.viewmat)


def _compare_regions(motions: Sequence[Motion]) -> _Regions | None:
    """Compares the regions; None if there are too few pairs with both."""
    both = np.array([(motion.static, motion.dynamic) for motion in motions if motion.dynamic is not None])
    if len(both) < MIN_PAIRS:
        return None
    static, dynamic = both.T
    medians = (float(np.median(values)) for values in (dynamic - static, static, dynamic))
    return _Regions(float((dynamic > static).mean()), *medians)


def _seen_from(camera: Camera, frame: Frame) -> tuple[UInt8[np.ndarray, "H W"], Bool[np.ndarray, "H W"]]:
    """A frame in grey as another camera would show it at its place; and where it shows anything."""
    reduced = size_within(frame.camera.size, COMPARED_SIDE)
    turned, is_seen = seen_from(camera, grey_levels(frame, reduced), frame.camera.resized(*reduced))
    return even_contrast(turned), is_seen


def _epipolar_distance(first: Camera, second: Camera, flow: Float[np.ndarray, "H W 2"]) -> Float[np.ndarray, "H W"]:
    """Distance from x + flow to the epipolar line of x, for a second camera that is turned like the first.

    The line goes through x and the epipole K t, so it is F x with F = [K t]× (Hartley and Zisserman, 9.2.2).
    """
    height, width = flow.shape[:2]
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    shift = first.viewmat[:3, :3].double() @ (first.position - second.position).double()
    if float(shift.norm()) < 1e-6:  # pure rotation: every pixel stays where it is
        return np.linalg.norm(flow, axis=-1)
    e = (first.pinhole.resized(width, height).K.double() @ shift).numpy()
    along = np.stack([e[0] - e[2] * x, e[1] - e[2] * y])
    along /= np.maximum(np.hypot(*along), 1e-12)
    return np.abs(along[0] * flow[..., 1] - along[1] * flow[..., 0])
