"""Alignment of monocular depth: a scale and an offset of inverse depth per frame (paper, Sec. DAP), and, beyond the
paper, a smooth factor over the image, because the errors of depth networks vary smoothly (Xu et al. 2022)."""

import math
from collections.abc import Sequence
from functools import partial
from typing import Literal, NamedTuple

import cv2
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from warpgs.cameras import Camera
from warpgs.kernels.constants import MIN_INVERSE_DEPTH

MAX_ERROR, MAX_ERROR_OF_CONSTANT = 0.1, 0.6
"""Depth is unusable if its relative error exceeds both the first, and the second times that of a constant depth. The
error of a depth network is about 0.05, 0.15 times that of a constant; that of noise is about that of a constant."""

CELLS_PER_SIGMA = 2.0
"""Standard deviation of the filter that smooths factors at points, in mean distances between points."""

PRIOR_WEIGHT = 0.1
"""Weight of a factor of 1, in points at distance 0: far from all points, depth stays as it is."""

ROBUST_SCALE = 0.1
"""Error of the logarithm of a factor at which the weight of a point is halved: some points are behind surfaces."""

ROBUST_ITERATIONS = 3

REWEIGHTINGS = 50
"""Iterations of reweighted least squares; enough to converge with 30 % outliers."""

MIN_SAMPLES = 16
"""Minimum number of samples; frames with fewer are not aligned and their depth is not used."""


def fit_scale_offset(samples: Sequence[tuple[Tensor, Tensor]]) -> Float[Tensor, "V 2"]:
    """(a, b) per frame that minimise Σ |a · values + b − targets|, by iteratively reweighted least squares in float64.

    Each iteration solves the two normal equations in closed form with weights 1 / |residual|, so that outliers, such as
    points hidden behind other surfaces, have little weight. All frames are fitted at once, because the samples of one
    keep a GPU busy for less time than it takes to launch its kernels.

    Args:
        samples: [S] values and [S] positive targets of each of V frames, at least one; S may differ between them.

    Returns:
        [V, 2]; NaN if there are fewer than ``MIN_SAMPLES``, all samples have the same value, or a ≤ 0.
    """
    values, targets = ([part.double() for part in parts] for parts in zip(*samples, strict=True))
    ones = pad_sequence([torch.ones_like(part) for part in values], batch_first=True)
    # Relative to medians, the variance is no small difference of large numbers. The padding is 0 in all terms.
    x0, y0 = (torch.stack([part.median() for part in parts])[:, None] for parts in (values, targets))
    x = ones * (pad_sequence(values, batch_first=True) - x0)
    y = ones * (pad_sequence(targets, batch_first=True) - y0)
    terms = torch.stack([ones, x, y, x * x, x * y], 1)
    floors = 1e-4 * y0.abs().clamp_min(1e-12)  # keeps the weight of an exact sample finite
    weights = ones
    for _ in range(REWEIGHTINGS):
        total, sum_x, sum_y, sum_xx, sum_xy = (terms * weights[:, None]).sum(2, keepdim=True).unbind(1)
        a = (total * sum_xy - sum_x * sum_y) / (total * sum_xx - sum_x**2)
        b = (sum_y - a * sum_x) / total
        weights = 1.0 / (a * x + b - y).abs().clamp_min(floors)
    fitted = torch.cat([a, b + y0 - a * x0], 1)
    is_valid = (ones.sum(1, keepdim=True) >= MIN_SAMPLES) & fitted.isfinite().all(1, keepdim=True) & (a > 0)
    return torch.where(is_valid, fitted, torch.nan).to(samples[0][0].dtype)


class PointSamples(NamedTuple):
    """Inverse depth of a frame where it is known at the visible sparse points in the static region.

    Attributes:
        row: [S] row of each point's pixel.
        column: [S] column of each point's pixel.
        values: [S] inverse depth of the frame.
        depth: [S] of the points [scene units].
        size: (H, W) of the frame [px].
        is_known: Whether the frame's inverse depth is known at any pixel.
    """

    row: Int64[Tensor, " S"]
    column: Int64[Tensor, " S"]
    values: Float[Tensor, " S"]
    depth: Float[Tensor, " S"]
    size: torch.Size
    is_known: Bool[Tensor, ""]


def sample_points(
    inverse_depth: Float[Tensor, "H W"], static: Bool[Tensor, "H W"], camera: Camera, points: Float[Tensor, "P 3"]
) -> PointSamples:
    """Inverse depth of a frame at the sparse points."""
    row, column, depth, inside = camera.project(points)
    values, is_known = inverse_depth[row, column], inverse_depth.isfinite()
    used = (inside & is_known[row, column] & static[row, column]).nonzero()[:, 0]
    return PointSamples(row[used], column[used], values[used], depth[used], inverse_depth.shape, is_known.any())


def align_to_points(samples: Sequence[PointSamples], is_metric: bool = False) -> Float[Tensor, "V 2"]:
    """Scale and offset that align each frame's inverse depth with the sparse points.

    Metric depth (``Capture.metric_depth``) stays as it is: (1, 0), or NaN if it is known nowhere.
    """
    if is_metric:
        is_known = torch.stack([part.is_known for part in samples])
        return torch.where(is_known[:, None], samples[0].values.new_tensor([1.0, 0.0]), torch.nan)
    return fit_scale_offset([(part.values, 1.0 / part.depth) for part in samples])


DepthProblem = Literal["unknown", "few points", "constant", "flat", "inverted"]
"""Why a frame's depth cannot be aligned: no finite value, too few points at which it is known, one value at all of
them, one distance of all of them, or a value that grows with distance."""

MIN_RELATIVE_RANGE = 0.005
"""Range of the depths of all but a tenth of the points, relative to their median, below which they are at one."""


def alignment_problem(samples: PointSamples, alignment: Float[Tensor, "2"]) -> DepthProblem | None:
    """Why ``align_to_points`` found no alignment of a frame; None if it found one."""
    if bool(alignment.isfinite().all()):
        return None
    if not bool(samples.is_known):
        return "unknown"
    if len(samples.values) < MIN_SAMPLES:
        return "few points"
    low, middle, high = samples.depth.quantile(samples.depth.new_tensor([0.05, 0.5, 0.95])).tolist()
    if high - low < MIN_RELATIVE_RANGE * middle:
        return "flat"
    return "constant" if float(samples.values.max()) == float(samples.values.min()) else "inverted"


def relative_errors(samples: PointSamples, alignment: Float[Tensor, "2"]) -> Float[Tensor, "2"]:
    """Median relative errors of inverse depth at the sparse points.

    Returns:
        [2]: that of aligned inverse depth, and, for comparison, that of the points' median everywhere. Infinite if
        there are no points, or if the alignment is NaN.
    """
    aligned, z = alignment[0] * samples.values + alignment[1], samples.depth
    errors = torch.stack([(found * z - 1.0).abs().median() for found in (aligned, (1.0 / z).median())])
    return torch.where(errors.isfinite().all(), errors, torch.inf)


def typical_error(errors: Float[Tensor, " T"]) -> Float[Tensor, ""]:
    """The median of the finite ones of views' relative errors; 0 if none is finite."""
    known = errors[errors.isfinite()]
    return known.median() if len(known) else errors.new_tensor(0.0)


def smooth_factor(samples: PointSamples, alignment: Float[Tensor, "2"]) -> tuple[Float[Tensor, "H W"], float]:
    """Factor of aligned inverse depth that brings it to the sparse points, and the error that is left.

    Logarithms of the factors at the points are smoothed by normalized convolution (Knutsson and Westin 1993).

    Returns:
        [H, W] factors on the CPU, and the median relative error at one half of the points after fitting to the other
        half.
    """
    aligned = alignment[0] * samples.values + alignment[1]
    used = aligned > MIN_INVERSE_DEPTH
    ratios = -(samples.depth * aligned).log()
    row, column, ratios = (part[used].cpu() for part in (samples.row, samples.column, ratios))
    if len(ratios) < 2 * MIN_SAMPLES:
        return torch.ones(samples.size, dtype=torch.float32), torch.inf
    even = torch.arange(len(ratios)) % 2 == 0
    half = _smoothed(row[even], column[even], ratios[even], samples.size)
    error = (half[row, column] - ratios)[~even].expm1().abs().median().item()
    return _smoothed(row, column, ratios, samples.size).exp(), error


def _smoothed(
    row: Int64[Tensor, " P"], column: Int64[Tensor, " P"], values: Float[Tensor, " P"], size: torch.Size
) -> Float[Tensor, "H W"]:
    """A smooth image through values at pixels, near 0 far from all of them."""
    height, width = size
    spacing = max(1.0, (height * width / len(values)) ** 0.5)
    rows, columns = max(1, round(height / spacing)), max(1, round(width / spacing))
    cell = (row * rows // height) * columns + column * columns // width
    sums = partial(torch.bincount, cell, minlength=rows * columns)
    smooth, weights = values.new_zeros(rows, columns), torch.ones_like(values)
    density = 2.0 * math.pi * CELLS_PER_SIGMA**2  # the filter has a sum of 1 instead of a peak of 1
    for _ in range(ROBUST_ITERATIONS):
        total, count = (
            density * cv2.GaussianBlur(sums(part).float().view(rows, columns).numpy(), (0, 0), CELLS_PER_SIGMA)
            for part in (weights * values, weights)
        )
        smooth = torch.from_numpy(total / (count + PRIOR_WEIGHT))
        weights = 1.0 / (1.0 + ((values - smooth.flatten()[cell]) / ROBUST_SCALE) ** 2)
    return torch.from_numpy(cv2.resize(smooth.numpy(), (width, height), interpolation=cv2.INTER_LINEAR))


def is_unusable(errors: Float[Tensor, "*N 2"]) -> Bool[Tensor, "*N"]:
    """Whether depth of these ``relative_errors`` is hardly better than a constant; false where they are infinite."""
    error, constant_error = errors.unbind(-1)
    return error.isfinite() & (error > MAX_ERROR) & (error > MAX_ERROR_OF_CONSTANT * constant_error)


def sample_rendering(
    inverse_depth: Float[Tensor, "H W"],
    static: Bool[Tensor, "H W"],
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
) -> tuple[Float[Tensor, " S"], Float[Tensor, " S"]]:
    """A frame's known inverse depth in its static region, and that of the rendered static Gaussians there."""
    known = static & inverse_depth.isfinite() & (alpha > 0.9) & (depth > 0)
    return inverse_depth[known], 1.0 / depth[known]


def metric_depth(inverse_depth: Float[Tensor, "H W"], alignment: Float[Tensor, "2"]) -> Float[Tensor, "H W"]:
    """Depth of an aligned frame [scene units]; NaN where unknown, or where aligned inverse depth is not positive."""
    aligned = alignment[0] * inverse_depth + alignment[1]
    return torch.where(aligned > MIN_INVERSE_DEPTH, 1.0 / aligned, torch.nan)
