"""The random choices of training: functions of the seed, the iteration, the number of rollbacks and the rank."""

import hashlib

import torch

from . import ranks
from .step import Sample


def random_numbers(seed: int, purpose: str, iteration: int, rollbacks: int) -> torch.Generator:
    """The CPU generator for a purpose at an iteration, after a number of returns to a checkpoint."""
    words = f"{seed} {purpose} {iteration} {rollbacks}"
    return torch.Generator().manual_seed(int.from_bytes(hashlib.blake2b(words.encode(), digest_size=7).digest(), "big"))


class Sampler:
    """Chooses a view, noise on time and a background for every iteration of this rank.

    Every epoch visits each view once, in a new order; the ranks take its views in turn.

    Args:
        seed: Of the run.
        num_views: Number of training views.
        black: Whether the background is black instead of random.
    """

    def __init__(self, seed: int, num_views: int, black: bool) -> None:
        self._seed, self._num_views, self._black = seed, num_views, black
        self._order: tuple[int, int, list[int]] = (-1, 0, [])

    def __call__(self, iteration: int, rollbacks: int, noise_deviation: float) -> Sample:
        """The choices of an iteration; the noise has a standard deviation in frame intervals."""
        epoch, index = divmod(iteration * ranks.num_ranks() + ranks.rank(), self._num_views)
        if self._order[:2] != (epoch, rollbacks):
            order = torch.randperm(self._num_views, generator=random_numbers(self._seed, "views", epoch, rollbacks))
            self._order = (epoch, rollbacks, order.tolist())
        generator = random_numbers(self._seed, "draw", iteration, rollbacks)
        for _ in range(ranks.rank() + 1):  # each rank has numbers of its own, after those of the ranks before it
            noise = noise_deviation / self._num_views * torch.randn(1, generator=generator).item()
            background = torch.rand(3, generator=generator)
        return Sample(self._order[2][index], noise, torch.zeros(3) if self._black else background)
