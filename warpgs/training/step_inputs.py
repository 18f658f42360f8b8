"""The numbers that change in every iteration, as named tensors on the device that one copy fills."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor


class StepInputs:
    """Inputs of a training step that the host computes, at addresses that never change, as CUDA graphs need.

    Args:
        sums: Names of the sums that the step adds to.
        groups: Names of the parameter groups.
        device: Device of the tensors.

    Attributes:
        time_noise: [1] added to the time that the deformation network sees.
        dropout_seed: [1] chooses the Gaussians that are omitted.
        color: [3] behind the dynamic image.
        scales: [sums] what is added to each sum is multiplied by: loss terms by their weights.
        scale: The elements of ``scales`` by name.
        learning_rates: Learning rate of each parameter group by name.
    """

    def __init__(self, sums: Sequence[str], groups: Sequence[str], device: torch.device) -> None:
        lengths = (1, 1, 3, len(sums), len(groups))
        self._buffer = torch.zeros(sum(lengths), dtype=torch.float32, device=device)
        self.time_noise, self.dropout_seed, self.color, self.scales, rates = self._buffer.split(lengths)
        self.scale: dict[str, Tensor] = dict(zip(sums, self.scales.unbind(), strict=True))
        self.learning_rates: dict[str, Tensor] = dict(zip(groups, rates.unbind(), strict=True))

    def send(
        self,
        *,
        time_noise: float,
        dropout_seed: int,
        color: Sequence[float],
        scales: Mapping[str, float],
        learning_rates: Mapping[str, float],
    ) -> None:
        """Fills all tensors by one copy from the host.

        Args:
            time_noise: Added to the time.
            dropout_seed: Chooses the Gaussians that are omitted.
            color: Behind the dynamic image.
            scales: Scale of every sum by name.
            learning_rates: Learning rate of every parameter group by name.

        Raises:
            KeyError: If a name is missing.
        """
        numbers = [time_noise, dropout_seed, *color]
        numbers += [scales[name] for name in self.scale]
        numbers += [learning_rates[name] for name in self.learning_rates]
        self._buffer.copy_(torch.tensor(numbers, dtype=torch.float32), non_blocking=True)
