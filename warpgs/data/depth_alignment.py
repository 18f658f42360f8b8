"""Alignment of monocular depth: a scale and an offset of inverse depth per frame (paper, Sec. DAP), and, beyond the
paper, a smooth factor over the image, because the errors of depth networks vary smoothly (Xu et al. 2022)."""

import math
from functools import partial
from typing import Literal

import cv2
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

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


def fit_scale_offset(values: Float[Tensor, " S"], targets: Float[Tensor, " S"]) -> Float[Tensor, "2"]:
    """(a, b) that minimise Σ |a · values + b − targets|, by iteratively reweighted least squares in float64.

    Each iteration solves the two normal equations in closed form with weights 1 / |residual|, so that outliers, such as
    points hidden behind other surfaces, have little weight.

    Returns:
        [2]; NaN if there are fewer than ``MIN_SAMPLES``, all samples have the same value, or a ≤ 0.
    """
    nothing = values.new_full((2,), torch.nan)
    if values.shape[0] < MIN_SAMPLES:
        return nothing
    x, y = values.double(), targets.double()
    weights = torch.ones_like(x)
    floor = 1e-4 * y.abs().median().clamp_min(1e-12)  # keeps the weight of an exact sample finite
    a = b = x.new_tensor(0.0)
    for _ in range(REWEIGHTINGS):
        total = weights.sum()
        mean_x, mean_y = (weights * x).sum() / total, (weights * y).sum() / total
        variance = (weights * (x - mean_x) ** 2).sum()
        a = (weights * (x - mean_x) * (y - mean_y)).sum() / variance
        b = mean_y - a * mean_x
        weights = 1.0 / (a * x + b - y).abs().clamp_min(floor)
    if not bool(torch.isfinite(a + b)) or bool(a <= 0):
        return nothing
    return torch.stack([a, b]).to(values.dtype)


def _samples(
    inverse_depth: Float[Tensor, "H W"], static: Tensor, camera: Camera, points: Float[Tensor, "P 3"]
) -> tuple[Float[Tensor, " S"], Float[Tensor, " S"]]:
    """Known inverse depth of a frame at the visible sparse points in its static region, and that of the points."""
    row, column, z, inside = camera.project(points)
    values = inverse_depth[row, column]
    known = inside & values.isfinite() & static[row, column]
    return values[known], 1.0 / z[known]


def align_to_points(
    inverse_depth: Float[Tensor, "H W"],
    static: Tensor,
    camera: Camera,
    points: Float[Tensor, "P 3"],
    is_metric: bool = False,
) -> Float[Tensor, "2"]:
    """Scale and offset that align a frame's inverse depth with the visible sparse points in its static region.

    Metric depth (``Capture.metric_depth``) stays as it is: (1, 0), or NaN if it is known nowhere.
    """
    if is_metric:
        known = bool(inverse_depth.isfinite().any())
        return inverse_depth.new_tensor([1.0, 0.0] if known else [torch.nan, torch.nan])
    return fit_scale_offset(*_samples(inverse_depth, static, camera, points))


DepthProblem = Literal["unknown", "few points", "constant", "inverted"]
"""Why a frame's depth cannot be aligned: no finite value, too few points at which it is known, one value at all of
them, or a value that grows with distance."""


def alignment_problem(
    inverse_depth: Float[Tensor, "H W"],
    static: Tensor,
    camera: Camera,
    points: Float[Tensor, "P 3"],
    is_metric: bool = False,
) -> DepthProblem | None:
    """Why ``align_to_points`` finds no alignment of a frame; None if it finds one."""
    if not bool(inverse_depth.isfinite().any()):
        return "unknown"
    if is_metric:
        return None
    values, targets = _samples(inverse_depth, static, camera, points)
    if len(values) < MIN_SAMPLES:
        return "few points"
    if bool(fit_scale_offset(values, targets).isfinite().all()):
        return None
    return "constant" if float(values.max()) == float(values.min()) else "inverted"


def relative_errors(
    inverse_depth: Float[Tensor, "H W"],
    static: Tensor,
    camera: Camera,
    points: Float[Tensor, "P 3"],
    alignment: Float[Tensor, "2"],
) -> Float[Tensor, "2"]:
    """Median relative errors of inverse depth at the visible sparse points in the static region.

    Returns:
        [2]: that of aligned inverse depth, and, for comparison, that of the points' median everywhere. Infinite if
        there are no points, or if the alignment is NaN.
    """
    row, column, z, inside = camera.project(points)
    aligned = alignment[0] * inverse_depth[row, column] + alignment[1]
    known = inside & static[row, column] & aligned.isfinite()
    if not bool(known.any()):
        return z.new_full((2,), torch.inf)
    aligned, z = aligned[known], z[known]
    return torch.stack([(aligned * z - 1.0).abs().median(), ((1.0 / z).median() * z - 1.0).abs().median()])


def smooth_factor(
    inverse_depth: Float[Tensor, "H W"],
    static: Tensor,
    camera: Camera,
    points: Float[Tensor, "P 3"],
    alignment: Float[Tensor, "2"],
) -> tuple[Float[Tensor, "H W"], float]:
    """Factor of aligned inverse depth that brings it to the sparse points, and the error that is left.

    Logarithms of the factors at the points are smoothed by normalized convolution (Knutsson and Westin 1993).

    Returns:
        [H, W] factors, and the median relative error at one half of the points after fitting to the other half.
    """
    row, column, z, inside = camera.project(points)
    aligned = alignment[0] * inverse_depth[row, column] + alignment[1]
    known = inside & static[row, column] & (aligned > MIN_INVERSE_DEPTH)
    row, column, ratios = (t[known].cpu() for t in (row, column, -(z * aligned).log()))
    if len(ratios) < 2 * MIN_SAMPLES:
        return torch.ones_like(inverse_depth), torch.inf
    size = inverse_depth.shape
    even = torch.arange(len(ratios)) % 2 == 0
    half = _smoothed(row[even], column[even], ratios[even], size)
    error = (half[row, column] - ratios)[~even].expm1().abs().median().item()
    return _smoothed(row, column, ratios, size).exp().to(inverse_depth), error


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


def align_to_rendering(
    inverse_depth: Float[Tensor, "H W"],
    static: Tensor,
    depth: Float[Tensor, "H W"],
    alpha: Float[Tensor, "H W"],
) -> Float[Tensor, "2"]:
    """Scale and offset that align a frame's inverse depth with the rendered depth of the static Gaussians."""
    known = static & inverse_depth.isfinite() & (alpha > 0.9) & (depth > 0)
    return fit_scale_offset(inverse_depth[known], 1.0 / depth[known])


def metric_depth(inverse_depth: Float[Tensor, "H W"], alignment: Float[Tensor, "2"]) -> Float[Tensor, "H W"]:
    """Depth of an aligned frame [scene units]; NaN where unknown, or where aligned inverse depth is not positive."""
    aligned = alignment[0] * inverse_depth + alignment[1]
    return torch.where(aligned > MIN_INVERSE_DEPTH, 1.0 / aligned, torch.nan)
