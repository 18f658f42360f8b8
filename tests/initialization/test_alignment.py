"""Depth is aligned with the sparse points, and trusted by its error there."""

import dataclasses
import threading
from types import SimpleNamespace

import pytest
import torch

from tests import plain
from tests.initialization.test_initialize import CAMERA, CONFIG, make_capture, views_of, with_frames
from tests.scenes import HEIGHT, WIDTH, error, generator
from warpgs.data import depth_alignment
from warpgs.initialization import alignment, initialize
from warpgs.views.views import Views


def capture_of_grid(inverse_of):
    """Points of random depth in every second row and column, and there ``inverse_of(depth, column)``."""
    row, column = torch.cartesian_prod(torch.arange(2, HEIGHT, 2), torch.arange(1, WIDTH, 2)).T
    depth = 1.5 + 2.5 * torch.rand(len(row), generator=generator(3))
    inverse_depth = torch.full((HEIGHT, WIDTH), torch.nan)
    inverse_depth[row, column] = inverse_of(depth, column)
    return make_capture(CAMERA.unproject(row, column, depth), inverse_depth=inverse_depth)


def aligned(factor, signal=1.0):
    """The alignment of views whose inverse depth is the true one times ``signal``, times random numbers in 1 ± factor.

    What ``signal`` leaves out is a constant.
    """

    def inverse_of(depth, column):
        noise = 1.0 + factor * (2.0 * torch.rand(len(depth), generator=generator(4)) - 1.0)
        return (signal / depth + 0.4 * (1.0 - signal)) * noise

    capture = capture_of_grid(inverse_of)
    return alignment.align_to_points(capture, views_of(capture))


def test_exact_depth_is_trusted_whatever_the_tolerance():
    found = aligned(0.0)
    assert (found.errors[:, 0] < 2e-3).all()  # depth is stored in half precision
    assert error(found.alignments, torch.tensor([[1.0, 0.0]] * 3)) < 2e-2
    assert (found.trust(plain.loss(depth_tolerance=0.03)).weight > 0.99).all()


def test_trust_is_a_half_at_the_tolerance():
    found = aligned(0.1)
    tolerance = found.errors[0, 0].item()
    assert 0.02 < tolerance < 0.1
    assert error(found.trust(plain.loss(depth_tolerance=tolerance)).weight, torch.full((3,), 0.5)) < 1e-6
    assert error(found.trust(plain.loss(depth_tolerance=tolerance / 3.0)).weight, torch.full((3,), 0.1)) < 1e-6


def test_depth_that_is_noise_is_not_trusted():
    assert torch.equal(aligned(0.5, signal=0.0).trust(plain.loss(depth_tolerance=0.03)).weight, torch.zeros(3))


def test_without_a_tolerance_every_view_is_trusted_and_every_error_counts():
    for found in (aligned(0.1), aligned(0.5, signal=0.0)):
        trust = found.trust(plain.loss(depth_tolerance=0.0))
        assert torch.equal(trust.weight, torch.ones(3))
        assert torch.equal(trust.margin, torch.zeros(3))


def test_a_view_with_too_few_points_is_trusted_as_much_as_the_others():
    errors = torch.tensor([[0.03, 0.4], [torch.inf, torch.inf], [0.09, 0.4], [0.35, 0.4]])
    trust = alignment.DepthAlignment(torch.ones(4, 2), errors, errors[:, 0]).trust(plain.loss(depth_tolerance=0.03))
    assert error(trust.weight, torch.tensor([0.5, 0.1, 0.1, 0.0])) < 1e-6  # torch's median is the lower one


def test_the_margin_is_three_times_the_error_of_each_view():
    errors = torch.tensor([[0.03, 0.4], [torch.inf, torch.inf], [0.01, 0.4], [0.02, 0.4]])
    trust = alignment.DepthAlignment(torch.ones(4, 2), errors, errors[:, 0]).trust(plain.loss(depth_tolerance=0.03))
    assert error(trust.margin, torch.tensor([0.09, 0.06, 0.03, 0.06])) < 1e-7


def test_without_points_nothing_is_refused():
    found = alignment.DepthAlignment(torch.full((2, 2), torch.nan), torch.full((2, 2), torch.inf), torch.zeros(2))
    trust = found.trust(plain.loss(depth_tolerance=0.03))
    assert torch.equal(trust.weight, torch.ones(2))
    assert torch.equal(trust.margin, torch.zeros(2))


def test_depth_with_smooth_errors_is_brought_to_the_points():
    capture = capture_of_grid(lambda depth, column: (1.0 + 0.1 * torch.sin(column / 16.0)) / depth)
    views = views_of(capture)
    plain = alignment.align_to_points(capture, views)
    smooth = alignment.align_to_points(capture, views, smooth=True)
    assert (smooth.errors[:, 0] < 0.5 * plain.errors[:, 0]).all()
    assert torch.equal(smooth.alignments, plain.alignments)
    again = alignment.align_to_points(capture, views)  # of the depth as it is now
    assert (again.errors[:, 0] < 0.5 * plain.errors[:, 0]).all()


def test_depth_that_a_smooth_factor_makes_no_better_stays():
    capture = capture_of_grid(lambda depth, _: 1.0 / depth)
    views = views_of(capture)
    before = views[0].inverse_depth.clone()
    alignment.align_to_points(capture, views, smooth=True)
    assert torch.equal(views[0].inverse_depth.nan_to_num(-1.0), before.nan_to_num(-1.0))


@pytest.mark.parametrize("resident_bytes", [0, 1 << 30])
def test_smooth_factors_are_found_and_used_in_threads(monkeypatch, resident_bytes):
    capture = capture_of_grid(lambda depth, column: (1.0 + 0.1 * torch.sin(column / 16.0)) / depth)
    threads, find = set(), depth_alignment.smooth_factor
    seen = lambda *sources: threads.add(threading.get_ident()) or find(*sources)  # noqa: E731
    monkeypatch.setattr(depth_alignment, "smooth_factor", seen)
    views = Views(capture, torch.device("cpu"), resident_bytes)
    plain = alignment.align_to_points(capture, views)
    alignment.align_to_points(capture, views, smooth=True)
    assert threads
    assert threading.get_ident() not in threads
    again = alignment.align_to_points(capture, views)
    assert (again.errors[:, 0] < 0.5 * plain.errors[:, 0]).all()


@pytest.mark.parametrize("source", ["points", "rendering"])
def test_views_that_are_fitted_together_have_alignments_of_their_own(monkeypatch, source):
    row, column = torch.cartesian_prod(torch.arange(HEIGHT), torch.arange(WIDTH)).T
    depth = 1.5 + 2.5 * torch.rand(HEIGHT, WIDTH, generator=generator(3))
    capture = make_capture(CAMERA.unproject(row, column, depth.flatten()))
    factors = {"0": 1.0, "1": torch.nan, "2": 4.0}

    def read(name):
        known = torch.arange(HEIGHT)[:, None] < 10 * (1 + int(name))  # the number of samples differs, too
        return dataclasses.replace(
            capture.frame(name), inverse_depth=torch.where(known, factors[name] / depth, torch.nan)
        )

    views = views_of(with_frames(capture, read))
    layer = SimpleNamespace(depth=depth, alpha=torch.ones(HEIGHT, WIDTH))
    monkeypatch.setattr(alignment, "render", lambda *_, **__: SimpleNamespace(joint=layer))
    before = torch.full((3, 2), 7.0)
    for most in (1, 1 << 20):
        monkeypatch.setattr(alignment, "MAX_SAMPLES_ON_CPU", most)
        if source == "points":
            found, unknown = alignment.align_to_points(capture, views).alignments, torch.nan
        else:
            scene = initialize.initial_scene(CONFIG, capture, views, generator())
            found, unknown = alignment.align_to_rendering(before, views, scene, 0), 7.0
        expected = torch.tensor([[1.0, 0.0], [unknown, unknown], [0.25, 0.0]])
        assert torch.allclose(found, expected, atol=2e-3, equal_nan=True)  # depth is stored in half precision


def test_of_many_views_some_pixels_are_compared_with_the_rendering(monkeypatch):
    depth = 1.5 + 2.5 * torch.rand(HEIGHT, WIDTH, generator=generator(3))
    capture = make_capture(torch.zeros(0, 3), inverse_depth=(1.0 / depth - 0.1) / 2.0)
    views, numbers, fit = views_of(capture), [], depth_alignment.fit_scale_offset
    monkeypatch.setattr(depth_alignment, "fit_scale_offset", lambda s: numbers.extend(len(x) for x, _ in s) or fit(s))
    monkeypatch.setattr(alignment, "MAX_RENDERED", HEIGHT * WIDTH // 3)
    layer = SimpleNamespace(depth=depth, alpha=torch.ones(HEIGHT, WIDTH))
    monkeypatch.setattr(alignment, "render", lambda *_, **__: SimpleNamespace(joint=layer))
    scene = initialize.initial_scene(CONFIG, capture, views, generator())
    for many in (len(views) - 1, len(views)):
        monkeypatch.setattr(alignment, "MANY", many)
        found = alignment.align_to_rendering(torch.zeros(len(views), 2), views, scene, 0)
        assert torch.allclose(found, torch.tensor([[2.0, 0.1]]).expand_as(found), atol=2e-3)
    some, every = numbers[: len(views)], numbers[len(views) :]
    assert max(some) <= HEIGHT * WIDTH // 3 < min(every)
