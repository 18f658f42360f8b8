"""Some of the training views."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import torch

from warpgs.data.capture import Frame

from .views import View, Views, sample_of


@dataclass(frozen=True, eq=False)
class Part:
    """Some of the views in their order, whose indices are from 0 on; they are read from the whole.

    Attributes:
        whole: All views.
        indices: Their indices there.
    """

    whole: Views
    indices: Sequence[int]

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def device(self) -> torch.device:
        """As of ``Views``."""
        return self.whole.device

    @property
    def sample(self) -> Sequence[int]:
        """As of ``Views``."""
        position = {index: k for k, index in enumerate(self.indices)}
        return sample_of([[position[index] for index in video if index in position] for video in self.whole.videos])

    def each(self, indices: Sequence[int]) -> Iterator[View]:
        """As of ``Views``."""
        return self.whole.each([self.indices[k] for k in indices])

    def frames(self, indices: Sequence[int]) -> Iterator[Frame]:
        """As of ``Views``."""
        return self.whole.frames([self.indices[k] for k in indices])


SomeViews: TypeAlias = Views | Part
"""All views, or some of them."""
