"""Alignment of monocular depth to a scene: a scale and an offset of inverse depth."""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from tests.scenes import HEIGHT, WIDTH, error, generator, make_camera, relative_error
from warpgs.data.depth_alignment import (
    align_to_points,
    fit_scale_offset,
    is_unusable,
    metric_depth,
    relative_errors,
    sample_points,
    sample_rendering,
    smooth_factor,
)

CAMERA = make_camera()
SCALE, OFFSET = 1.7, 0.2
ALIGNMENT = torch.tensor([SCALE, OFFSET])
EVERYWHERE = torch.ones(HEIGHT, WIDTH, dtype=torch.bool)
ENOUGH = 16
"""Minimum number of samples."""


def samples(num=200, noise=0.0):
    g = generator()
    values = torch.rand(num, generator=g)
    return values, SCALE * values + OFFSET + noise * torch.randn(num, generator=g)


def with_outliers(targets, fraction, by):
    targets = targets.clone()
    targets[: round(fraction * len(targets))] += by
    return targets


def fit(values, targets):
    """The fit of one frame."""
    return fit_scale_offset([(values, targets)])[0]


def least_absolute_deviations(values, targets):
    """(a, b) that minimise Σ |a · values + b − targets|, by linear programming."""
    x, y, num = values.double().numpy(), targets.double().numpy(), len(values)
    line = np.stack([x, np.ones(num)], 1)
    bounds = np.block([[line, -np.eye(num)], [-line, -np.eye(num)]])  # ±(a x + b − y) ≤ slack
    cost = np.concatenate([np.zeros(2), np.ones(num)])
    solved = linprog(cost, bounds, np.concatenate([y, -y]), bounds=[(None, None)] * 2 + [(0, None)] * num)
    return torch.from_numpy(solved.x[:2])


def total_error(alignment, values, targets):
    a, b = alignment.double()
    return (a * values.double() + b - targets.double()).abs().sum().item()


def test_exact_samples_give_their_scale_and_offset():
    assert error(fit(*samples()), ALIGNMENT) < 1e-6


@pytest.mark.parametrize(("fraction", "by"), [(0.1, 1000.0), (0.2, 5.0), (0.2, -5.0), (0.3, 1.0), (0.3, -1.0)])
def test_outliers_do_not_count(fraction, by):
    values, targets = samples()
    assert error(fit(values, with_outliers(targets, fraction, by)), ALIGNMENT) < 1e-3


@pytest.mark.parametrize("fraction", [0.1, 0.3])
def test_noisy_samples_are_fitted_with_the_minimum_absolute_error(fraction):
    values, targets = samples(noise=0.05)
    targets = with_outliers(targets, fraction, 3.0)
    best = total_error(least_absolute_deviations(values, targets), values, targets)
    assert total_error(fit(values, targets), values, targets) < 1.001 * best


def test_the_fit_scales_with_the_units_of_values_and_targets():
    values, targets = samples(noise=0.05)
    a, b = fit(values, targets)
    scaled = fit(100.0 * values, 0.01 * targets)
    assert relative_error(scaled, torch.stack([1e-4 * a, 0.01 * b])) < 1e-4


@pytest.mark.parametrize("far", [1e4, -1e4])
def test_an_offset_far_from_zero_is_found(far):
    values, _ = samples()
    targets = SCALE * values + OFFSET
    found = fit(values.double() + far, targets.double())
    assert relative_error(found, torch.tensor([SCALE, OFFSET - SCALE * far]).double()) < 1e-6


def test_the_minimum_number_of_samples_is_enough_and_fewer_are_not():
    values, targets = samples(ENOUGH)
    assert error(fit(values, targets), ALIGNMENT) < 1e-6
    assert fit(values[1:], targets[1:]).isnan().all()


def test_frames_are_fitted_together_as_each_alone_and_unsuitable_ones_have_no_alignment():
    few, (values, targets) = samples(ENOUGH - 1), samples(50, noise=0.05)
    good = [samples(noise=0.05), (values, with_outliers(targets, 0.3, 3.0)), samples(ENOUGH)]
    nothing, unknown, third = values[:0], torch.full_like(values, torch.nan), torch.arange(50) == 3
    bad = [few, (nothing, nothing), (values, -targets), (unknown, targets), (values, unknown)]
    bad += [(torch.full_like(values, value), targets) for value in (0.0, 0.5, 1.0)]
    bad += [(values, torch.where(third, value, targets)) for value in (torch.nan, torch.inf)]
    frames = [*good, *bad, *good]
    found, alone = fit_scale_offset(frames), torch.stack([fit(*frame) for frame in frames])
    for fits in (found, alone):
        assert fits.isfinite().all(1).tolist() == [True] * 3 + [False] * len(bad) + [True] * 3
        assert fits[3:-3].isnan().all()
    assert relative_error(found[found.isfinite()], alone[alone.isfinite()]) < 1e-6


@pytest.fixture
def inverse_depth():
    return 0.2 + torch.rand(HEIGHT, WIDTH, generator=generator())


@pytest.fixture
def points(inverse_depth):
    return points_behind(inverse_depth, range(2, 30, 3), range(1, 45, 4))


def points_behind(inverse_depth, rows, columns):
    """Points at the aligned depth of some pixels."""
    row, column = torch.cartesian_prod(torch.tensor(rows), torch.tensor(columns)).T
    return CAMERA.unproject(row, column, 1.0 / (SCALE * inverse_depth[row, column] + OFFSET))


def align(*sources):
    """The alignment of one frame to points; arguments as for ``sample_points``."""
    return align_to_points([sample_points(*sources)])[0]


def test_points_align_the_inverse_depth_of_their_pixels(inverse_depth, points):
    assert error(align(inverse_depth, EVERYWHERE, CAMERA, points), ALIGNMENT) < 1e-4


def test_points_hidden_behind_other_surfaces_do_not_count(inverse_depth, points):
    hidden = points_behind(inverse_depth / 5.0, range(3, 30, 7), range(2, 45, 5))
    found = align(inverse_depth, EVERYWHERE, CAMERA, torch.cat([points, hidden]))
    assert error(found, ALIGNMENT) < 1e-3


def test_points_in_dynamic_regions_do_not_count(inverse_depth):
    static = EVERYWHERE.clone()
    static[:, :25] = False
    true = points_behind(inverse_depth, range(2, 30, 3), range(26, 45, 3))
    wrong = points_behind(3.0 * inverse_depth, range(30), range(25))
    assert error(align(inverse_depth, static, CAMERA, torch.cat([true, wrong])), ALIGNMENT) < 1e-4


def test_points_behind_the_camera_or_outside_the_image_do_not_count(inverse_depth, points):
    behind = points_behind(-inverse_depth, range(20), range(20))
    outside = CAMERA.unproject(torch.arange(100), torch.full((100,), WIDTH + 3), torch.ones(100))
    points = torch.cat([behind, points, outside])
    assert error(align(inverse_depth, EVERYWHERE, CAMERA, points), ALIGNMENT) < 1e-4


def test_pixels_without_depth_do_not_count(inverse_depth, points):
    inverse_depth[:15] = torch.nan
    assert error(align(inverse_depth, EVERYWHERE, CAMERA, points), ALIGNMENT) < 1e-4


@pytest.mark.parametrize("num", [0, ENOUGH - 1])
def test_a_frame_that_sees_too_few_points_is_not_aligned(num, inverse_depth):
    points = points_behind(inverse_depth, range(20), range(20))[:num]
    assert align(inverse_depth, EVERYWHERE, CAMERA, points).isnan().all()


def test_a_frame_without_depth_is_not_aligned(points):
    nothing = torch.full((HEIGHT, WIDTH), torch.nan)
    assert align(nothing, EVERYWHERE, CAMERA, points).isnan().all()


OPAQUE = torch.full((HEIGHT, WIDTH), 0.99)


def rendered_depth(inverse_depth):
    return 1.0 / (SCALE * inverse_depth + OFFSET)


def test_a_rendering_aligns_inverse_depth(inverse_depth):
    depth = rendered_depth(inverse_depth)
    assert error(fit(*sample_rendering(inverse_depth, EVERYWHERE, depth, OPAQUE)), ALIGNMENT) < 1e-5


@pytest.mark.parametrize("excluded", ["dynamic", "transparent", "unknown", "empty"])
def test_only_static_opaque_pixels_of_known_depth_align_to_a_rendering(excluded, inverse_depth):
    static, alpha = EVERYWHERE.clone(), OPAQUE.clone()
    depth = rendered_depth(inverse_depth)
    wrong_rows = slice(0, 22)  # most of the image: more outliers than a robust fit tolerates
    depth[wrong_rows] = 1.0 / (9.0 * inverse_depth[wrong_rows] + 4.0)
    if excluded == "dynamic":
        static[wrong_rows] = False
    elif excluded == "transparent":
        alpha[wrong_rows] = 0.5
    elif excluded == "unknown":
        inverse_depth[wrong_rows] = torch.nan
    else:
        depth[wrong_rows] = 0.0
    assert error(fit(*sample_rendering(inverse_depth, static, depth, alpha)), ALIGNMENT) < 1e-5


def test_an_empty_rendering_gives_no_alignment(inverse_depth):
    nothing = torch.zeros(HEIGHT, WIDTH)
    assert fit(*sample_rendering(inverse_depth, EVERYWHERE, nothing, nothing)).isnan().all()


def test_aligned_inverse_depth_becomes_depth(inverse_depth):
    expected = 1.0 / (SCALE * inverse_depth.double() + OFFSET)
    assert error(metric_depth(inverse_depth, ALIGNMENT), expected) < 1e-6


def test_depth_at_or_past_infinity_is_unknown():
    inverse_depth = torch.tensor([[1.0, 0.1, 0.0, -1.0]])
    assert metric_depth(inverse_depth, torch.tensor([1.0, -0.1])).isnan().tolist() == [[False, True, True, True]]


def test_unknown_inverse_depth_stays_unknown():
    inverse_depth = torch.tensor([[torch.nan, 0.5]])
    assert metric_depth(inverse_depth, ALIGNMENT).isnan().tolist() == [[True, False]]


def test_all_depth_of_a_frame_that_is_not_aligned_is_unknown(inverse_depth):
    assert metric_depth(inverse_depth, torch.full((2,), torch.nan)).isnan().all()


def test_errors_are_those_of_aligned_depth_and_of_a_constant(inverse_depth, points):
    wrong = 1.1 * torch.tensor([SCALE, OFFSET])
    samples = sample_points(inverse_depth, EVERYWHERE, CAMERA, points)
    found = relative_errors(samples, wrong)
    z = CAMERA.project(points)[2]
    assert error(found[0], torch.tensor(0.1)) < 1e-4
    assert error(found[1], ((1.0 / z).median() * z - 1.0).abs().median()) < 1e-5
    assert error(relative_errors(samples, ALIGNMENT)[0], torch.tensor(0.0)) < 1e-4


def test_errors_of_points_in_dynamic_regions_do_not_count(inverse_depth):
    static = EVERYWHERE.clone()
    static[:, :25] = False
    points = points_behind(inverse_depth, range(2, 30, 3), range(27, 45, 4))
    wrong = points_behind(inverse_depth / 5.0, range(3, 30, 7), range(2, 25, 5))
    found = relative_errors(sample_points(inverse_depth, static, CAMERA, torch.cat([points, wrong])), ALIGNMENT)
    assert found[0] < 1e-4


@pytest.mark.parametrize("alignment", [ALIGNMENT, torch.full((2,), torch.nan)])
def test_errors_are_infinite_without_points_or_alignment(alignment, inverse_depth, points):
    found = points[: 0 if alignment.isfinite().all() else None]
    assert relative_errors(sample_points(inverse_depth, EVERYWHERE, CAMERA, found), alignment).isinf().all()


@pytest.mark.parametrize(
    ("depth_error", "constant_error", "unusable"),
    [
        (0.055, 0.4, False),  # a depth network
        (0.38, 0.4, True),  # noise
        (0.02, 0.03, False),  # a shallow scene: hardly better than a constant, and still exact
        (0.15, 0.3, False),
        (0.3, 0.6, False),
        (torch.inf, torch.inf, False),  # unknown
    ],
)
def test_depth_is_unusable_if_it_is_wrong_and_hardly_better_than_a_constant(depth_error, constant_error, unusable):
    assert bool(is_unusable(torch.tensor([depth_error, constant_error]))) == unusable


def dense_points(depth, every=2):
    """Points of the scene at every second pixel of a depth image."""
    row, column = torch.cartesian_prod(torch.arange(0, HEIGHT, every), torch.arange(0, WIDTH, every)).T
    return CAMERA.unproject(row, column, depth[row, column])


def bumps():
    """A factor that varies by 10 % over the image."""
    y, x = torch.meshgrid(torch.linspace(0, 3, HEIGHT), torch.linspace(0, 4, WIDTH), indexing="ij")
    return 1.0 + 0.1 * torch.sin(x) * torch.cos(y)


def slanted():
    return torch.linspace(2.0, 4.0, WIDTH).expand(HEIGHT, WIDTH)


def fitted_factor(inverse_depth, static=EVERYWHERE, points=None):
    """The factor of inverse depth that needs no alignment, and the error that is left; by default at slanted points."""
    points = dense_points(slanted()) if points is None else points
    return smooth_factor(sample_points(inverse_depth, static, CAMERA, points), torch.tensor([1.0, 0.0]))


def test_a_smooth_error_is_divided_out():
    factor, left = fitted_factor(bumps() / slanted())
    assert (factor * bumps() - 1.0).abs().median() < 0.005
    assert left < 0.01


def test_outliers_hardly_change_the_factor():
    depth = slanted().clone()
    points = dense_points(depth)
    hidden = torch.rand(len(points), generator=generator()) < 0.1
    points[hidden] = CAMERA.position + 2.0 * (points[hidden] - CAMERA.position)  # behind a surface
    factor, _ = fitted_factor(bumps() / depth, points=points)
    assert (factor * bumps() - 1.0).abs().median() < 0.01


def test_the_error_of_noise_is_left():
    noise = torch.exp(torch.randn(HEIGHT, WIDTH, generator=generator()))
    _, left = fitted_factor(noise / slanted())
    assert left > 0.3


def test_far_from_points_and_with_few_points_the_factor_is_1():
    static = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    static[:, : WIDTH // 3] = True
    factor, _ = fitted_factor(1.2 / slanted(), static)
    assert (factor[:, : WIDTH // 4] * 1.2 - 1.0).abs().max() < 0.02
    assert error(factor[:, -WIDTH // 6 :], torch.ones(HEIGHT, -(-WIDTH // 6))) < 0.01
    factor, left = fitted_factor(1.2 / slanted(), torch.zeros_like(static))
    assert torch.equal(factor, torch.ones(HEIGHT, WIDTH))
    assert left == torch.inf
