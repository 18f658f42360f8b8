"""Where frames show the sky: what is far beyond the sparse points, and has none, as depth says.

Without depth nothing tells the sky from a white wall, which has no sparse points either.
"""

import copy
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.data.capture import Capture, Frame
from warpgs.data.depth_alignment import PointSamples, align_to_points, is_unusable, relative_errors, sample_points
from warpgs.data.sampling import evenly_spaced, evenly_spaced_indices
from warpgs.model.dome import BEYOND, COLUMNS, ROWS, Dome, seen_colors

MAX_FRAMES, MAX_POINTS = 24, 20_000
"""Maximum numbers of training frames and of points that are looked at, evenly spaced."""

MAX_SIDE = 640
"""Longer side to which they are reduced: texels of the sky are larger than the pixels of larger frames [px]."""

FARTHEST = 0.98
"""Quantile of the depths of the points that frames see that counts as that of the farthest one; a few are outliers."""

MAX_INSIDE = 0.02
"""Maximum fraction of the points of a frame that may lie in its sky; with more of them, its depth is wrong there."""

MIN_SHARE = 0.05
"""Share of the pixels from which on a capture has a sky."""

BORDER = 2
"""Pixels around everything else that do not count as sky: they are mixed."""


@dataclass(frozen=True)
class Sky:
    """The sky of a capture.

    Attributes:
        share: Of the pixels of the frames that were looked at.
        far: Inverse depth up to which a pixel shows it [1 / scene units].
        frames: Some frames, reduced.
        masks: [H, W] where each of them shows it.
    """

    share: float
    far: float
    frames: list[Frame]
    masks: list[Bool[Tensor, "H W"]]

    @property
    def described(self) -> str:
        """A sentence for the user."""
        return f"the sky, {self.share:.0%} of the pixels, is behind all Gaussians: its depth is beyond all points"

    def holds(self, points: Float[Tensor, "P 3"]) -> Bool[Tensor, " P"]:
        """[P] whether most frames that see a point see it in the sky."""
        seen, inside = torch.zeros(2, len(points), dtype=torch.int64)
        for frame, mask in zip(self.frames, self.masks, strict=True):
            row, column, _, is_visible = frame.camera.project(points)
            seen += is_visible
            inside += is_visible & mask[row, column]
        return 2 * inside > seen


def find_sky(capture: Capture) -> Sky | None:
    """The sky of a capture; None if it shows none, or no depth and points that tell.

    Raises:
        ValueError: If a training frame that is looked at is missing or damaged; the message names it.
    """
    frames = [frame for frame in _some_frames(capture) if frame.inverse_depth is not None]
    if not frames or not len(capture.points):
        return None
    points = capture.points[evenly_spaced_indices(len(capture.points), MAX_POINTS)]
    samples = [_samples(frame, points) for frame in frames]
    alignments = align_to_points(samples, capture.metric_depth)
    depths = torch.cat([part.depth for part in samples])
    if not len(depths):
        return None
    far = 1.0 / (BEYOND * float(depths.quantile(FARTHEST)))
    masks = [_mask(*parts, far) for parts in zip(frames, samples, alignments, strict=True)]
    share = sum(float(mask.float().mean()) for mask in masks) / len(masks)
    return Sky(share, far, frames, masks) if share >= MIN_SHARE else None


def _samples(frame: Frame, points: Float[Tensor, "P 3"]) -> PointSamples:
    assert frame.inverse_depth is not None
    return sample_points(frame.inverse_depth, _static(frame), frame.camera, points)


def _static(frame: Frame) -> Bool[Tensor, "H W"]:
    return torch.ones(frame.image.shape[:2], dtype=torch.bool) if frame.static_mask is None else frame.static_mask


def _mask(frame: Frame, samples: PointSamples, alignment: Float[Tensor, "2"], far: float) -> Bool[Tensor, "H W"]:
    """Where a frame shows the sky; nowhere if its depth does not agree with the points."""
    assert frame.inverse_depth is not None
    mask = (alignment[0] * frame.inverse_depth + alignment[1] <= far) & _static(frame)  # false where depth is unknown
    is_wrong = bool(is_unusable(relative_errors(samples, alignment)))
    is_wrong |= bool(_eroded(mask)[samples.row, samples.column].sum() > MAX_INSIDE * len(samples.row))
    return torch.zeros_like(mask) if is_wrong else mask


def without_points(capture: Capture, sky: Sky | None) -> Capture:
    """The same capture, without points in its sky."""
    if sky is None:
        return capture
    capture, kept = copy.copy(capture), ~sky.holds(capture.points)
    capture.points = capture.points[kept]
    capture.point_colors = None if capture.point_colors is None else capture.point_colors[kept]
    return capture


def make_dome(capture: Capture, sky: Sky | None) -> Dome:
    """The sky as the frames show it, and as it continues around what they show.

    Args:
        capture: With the frames.
        sky: Where they show it; None if no depth tells, so that the sky begins with the colours of all that is static.
    """
    if sky is not None:
        frames, masks = sky.frames, [_eroded(mask) for mask in sky.masks]
    else:
        frames = _some_frames(capture)
        masks = [_static(frame) for frame in frames]
    seen = [(frame.camera, frame.image.float() / 255.0, mask) for frame, mask in zip(frames, masks, strict=True)]
    colors = seen_colors(seen, ROWS, COLUMNS)
    return Dome(colors, -1.0 if sky is None else sky.far)


def _some_frames(capture: Capture) -> list[Frame]:
    return [_reduced(frame) for frame in capture.frames(evenly_spaced(capture.train, MAX_FRAMES))]


def _eroded(mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    other = torch.nn.functional.max_pool2d((~mask)[None].float(), 2 * BORDER + 1, 1, BORDER)[0]
    return other == 0.0


def _reduced(frame: Frame) -> Frame:
    """A frame of every n-th pixel, in memory of its own."""
    step = max(1, round(max(frame.camera.size) / MAX_SIDE))
    tensors = (frame.image, frame.static_mask, frame.inverse_depth)
    image, static, depth = (None if tensor is None else tensor[::step, ::step].clone() for tensor in tensors)
    assert image is not None
    height, width = image.shape[:2]
    return Frame(frame.name, frame.camera.resized(width, height), image, static, depth)
