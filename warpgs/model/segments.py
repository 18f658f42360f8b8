"""Segments of time: in a long capture each has dynamic Gaussians and a deformation network of its own.

K segments of equal length 1 / K begin at k / K. Each is continued by half an overlap at both ends, where the opacities
of its Gaussians fade: one of opacity o and weight w has the opacity 1 − (1 − o)ʷ. The weights of all segments sum to 1,
so that two segments that show the same thing are as opaque as one. In the fraction s of an overlap the weight of the
later one is s² / (s² + (1 − s)²). The network of a segment gets the time in its window, from 0 to 1.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from torch import Tensor

OVERLAP = 0.05
"""Time in which two segments overlap, as a fraction of that of a segment: 1 of 20 seconds."""

MAX_TIMES = 600
"""About how many times of training frames are in a segment of a long capture, by default: 20 seconds of 30 frames."""


class SegmentRows(NamedTuple):
    """The Gaussians of each of K segments, in as many columns as the largest one has.

    Attributes:
        rows: [K, C] their indices, repeated from the first one where a segment has fewer; any where it has none.
        counts: [K, C] 1, or 0 for a repetition.
    """

    rows: Int64[Tensor, "K C"]
    counts: Float[Tensor, "K C"]


def default_number(num_times: int) -> int:
    """Number of segments for so many times of training frames: 1 for less than 900."""
    return max(1, round(num_times / MAX_TIMES))


def window(segment: int, num: int) -> tuple[float, float]:
    """Time at which a segment of ``num`` begins, and at which it ends."""
    return (segment - 0.5 * OVERLAP) / num, (segment + 1.0 + 0.5 * OVERLAP) / num


def local_time(time: Float[Tensor, " T"], segment: Int64[Tensor, "1"], num: int) -> Float[Tensor, " T"]:
    """Times in the window of a segment of ``num``, which is 0 to 1."""
    return (time * num - segment + 0.5 * OVERLAP) / (1.0 + OVERLAP)


def nearest(time: Float[Tensor, " T"], num: int) -> Int64[Tensor, " T"]:
    """The segments of ``num`` that have the largest weight at times."""
    return (time * num).long().clamp(0, num - 1)


def weights(time: Float[Tensor, "1"], num: int, choice: Float[Tensor, "1"] | None = None) -> Float[Tensor, " num"]:
    """Weight of each segment of ``num`` at a time in [0, 1]; they sum to 1.

    Args:
        time: The time.
        num: Number of segments.
        choice: What is seen in an overlap: its earlier segment alone (-1), both (0) or the later one alone (1); both if
            None.
    """
    begun = _begun(time, num)
    if choice is not None:
        begun = torch.where((begun > 0.0) & (begun < 1.0), (begun + choice).clamp(0.0, 1.0), begun)
    # At a small weight many opaque layers are opaque: with linear weights they appear from one frame to the next.
    begun = begun**2 / (begun**2 + (1.0 - begun) ** 2)
    return torch.cat([torch.ones_like(time), begun]) - torch.cat([begun, torch.zeros_like(time)])


def _begun(time: Float[Tensor, "1"], num: int) -> Float[Tensor, " edges"]:
    """Fraction done of the overlap at each of the ``num`` - 1 edges."""
    edges = torch.arange(1, num, device=time.device)
    return ((time * num - edges) / OVERLAP + 0.5).clamp(0.0, 1.0)


def active(time: Float[Tensor, "1"], num: int) -> Int64[Tensor, " A"]:
    """The two segments, of ``num`` > 1, that may have a weight at a time; on the CPU those that a choice may show."""
    later = (time * num).round().long().clamp(1, num - 1)
    pair = torch.cat([later - 1, later])
    # A CUDA graph needs one shape for all times. On the CPU the other segment would only cost time.
    if time.is_cuda:
        return pair
    begun = _begun(time, num)[later - 1]  # near an end, the weights of both round to 0 and 1
    return pair[torch.cat([begun < 1.0, begun > 0.0])]


def faded(logits: Float[Tensor, " D"], weight: Float[Tensor, " D"]) -> Float[Tensor, " D"]:
    """Opacities 1 − (1 − o)ʷ from the logits of o and weights w in [0, 1]."""
    return -torch.expm1(weight * torch.nn.functional.logsigmoid(-logits))


def rows_by_segment(segments: Int64[Tensor, " D"], num: int) -> SegmentRows:
    """The Gaussians of each segment, from the segment of each of D > 0 Gaussians; reads back from the device."""
    counts = segments.bincount(minlength=num)[:, None]
    column = torch.arange(int(counts.max()), device=segments.device)
    first = counts.cumsum(0) - counts
    order = segments.argsort(stable=True)
    rows = order[(first + column % counts.clamp_min(1)).clamp_max(len(order) - 1)]
    return SegmentRows(rows, (column < counts).float())
