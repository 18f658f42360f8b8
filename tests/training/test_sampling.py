"""Random choices of training: their units and ranges."""

import pytest
import torch

from warpgs.training.sampling import Sampler


@pytest.mark.parametrize("num_views", [1, 20, 160])
def test_noise_on_time_has_its_deviation_in_frame_intervals(num_views):
    sampler = Sampler(seed=0, num_views=num_views)
    noise = torch.tensor([sampler(iteration, 0, 0.1).time_noise for iteration in range(2_000)])
    assert (noise.std() * num_views).item() == pytest.approx(0.1, rel=0.06)
    assert abs(noise.mean().item()) * num_views < 0.01


def test_the_color_is_another_one_in_every_iteration():
    sampler = Sampler(seed=0, num_views=5)
    colors = torch.tensor([sampler(iteration, 0, 0.1).color for iteration in range(2_000)])
    assert colors.min() >= 0.0
    assert colors.max() <= 1.0
    assert (colors.mean(0) - 0.5).abs().max() < 0.02
    assert torch.corrcoef(colors.T).triu(1).abs().max() < 0.07
