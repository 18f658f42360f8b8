"""The random choices of training: functions of the seed, the iteration, the number of rollbacks and the rank."""

from collections.abc import Iterator
from itertools import count

import torch

from warpgs.ops.dropout import MAX_SEED
from warpgs.runtime import ranks
from warpgs.runtime.random_numbers import random_numbers

from .step import Sample


class Sampler:
    """Chooses a view, noise on time, what to omit and a colour for every iteration of this rank.

    Every epoch visits each view once, in a new order; the ranks take its views in turn.
    """

    def __init__(self, seed: int, num_views: int) -> None:
        self._seed, self._num_views = seed, num_views
        self._orders: dict[tuple[int, int], list[int]] = {}

    def __call__(self, iteration: int, rollbacks: int, noise_deviation: float) -> Sample:
        """The choices of an iteration; the noise has a standard deviation in frame intervals."""
        generator = random_numbers(self._seed, "draw", iteration, rollbacks)
        for _ in range(ranks.rank() + 1):  # each rank has numbers of its own, after those of the ranks before it
            noise = noise_deviation / self._num_views * torch.randn(1, dtype=torch.float32, generator=generator).item()
            dropout_seed = int(torch.randint(MAX_SEED, (1,), generator=generator))
            red, green, blue = torch.rand(3, dtype=torch.float32, generator=generator).tolist()
        view = next(self.views(iteration, rollbacks))
        return Sample(view, noise, dropout_seed, (red, green, blue))

    def views(self, iteration: int, rollbacks: int) -> Iterator[int]:
        """The views of this rank from an iteration on, without end."""
        for position in count(iteration * ranks.num_ranks() + ranks.rank(), ranks.num_ranks()):
            epoch, index = divmod(position, self._num_views)
            yield self._order(epoch, rollbacks)[index]

    def _order(self, epoch: int, rollbacks: int) -> list[int]:
        """The order of the views in an epoch; those of the last two epochs are remembered."""
        key = epoch, rollbacks
        if key not in self._orders:
            while len(self._orders) > 1:
                del self._orders[next(iter(self._orders))]
            order = torch.randperm(self._num_views, generator=random_numbers(self._seed, "views", *key))
            self._orders[key] = order.tolist()
        return self._orders[key]
