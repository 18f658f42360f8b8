"""Gaussians in activated form, ready to be rendered."""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from warpgs.ops.sh import check_coefficients
from warpgs.runtime.checks import check_same_device, check_tensor

from .dome import Dome
from .gaussians import SH_C0
from .reflections import Reflections


@dataclass(frozen=True)
class Splats:
    """N Gaussians with activated values, coloured either by ``colors`` or by ``sh``.

    Attributes:
        means: [N, 3] centres.
        quats: [N, 4] rotations (w, x, y, z) of any length but zero.
        scales: [N, 3] standard deviations along the Gaussians' own axes.
        opacities: [N] in [0, 1].
        colors: [N, C] features that are blended directly, any number of channels.
        sh: [N, bases, 3] spherical harmonics coefficients with 1, 4, 9 or 16 bases.
        is_dynamic: [N] branch: true for dynamic, false for static Gaussians.
        objects: [N] number of the object that a Gaussian belongs to, 0 for none; None if they are not known.
        sh_degree: Highest degree of ``sh`` to use; that of ``sh`` by default.
        background: [3] colour behind them, or the sky, black if None; not used if ``colors`` have another number of
            channels, which are composited over 0.
        reflections: What the last Gaussians reflect, which is added to their colours by ``sh``; None if nothing.

    Raises:
        ValueError: On a wrong shape, dtype or device, or unless exactly one of ``colors`` and ``sh`` is given.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    colors: Float[Tensor, "N C"] | None = None
    sh: Float[Tensor, "N bases 3"] | None = None
    is_dynamic: Bool[Tensor, " N"] | None = None
    objects: Int64[Tensor, " N"] | None = None
    sh_degree: int | None = None
    background: Float[Tensor, "3"] | Dome | None = None
    reflections: Reflections | None = None

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {}
        check_tensor("means", self.means, ("N", 3), sizes)
        check_tensor("quats", self.quats, ("N", 4), sizes)
        check_tensor("scales", self.scales, ("N", 3), sizes)
        check_tensor("opacities", self.opacities, ("N",), sizes)
        if (self.colors is None) == (self.sh is None):
            raise ValueError("splats need exactly one of colors and sh")
        if self.colors is not None:
            check_tensor("colors", self.colors, ("N", "C"), sizes)
            if sizes["C"] == 0:
                raise ValueError("colors must have at least one channel, got none")
        if self.sh is not None:
            check_coefficients(sizes, self.sh, self.sh_degree)
        if self.is_dynamic is not None:
            check_tensor("is_dynamic", self.is_dynamic, ("N",), sizes, (torch.bool,))
        if self.objects is not None:
            check_tensor("objects", self.objects, ("N",), sizes, (torch.int64,))
        behind = self.background
        if behind is not None and not isinstance(behind, Dome):
            check_tensor("background", behind, (3,), {})
        tensors = {name: getattr(self, name) for name in self.tensor_names()}
        check_same_device({**tensors, "background": behind.texels if isinstance(behind, Dome) else behind})

    @staticmethod
    def tensor_names() -> tuple[str, ...]:
        """Names of the attributes that are tensors of all Gaussians."""
        return ("means", "quats", "scales", "opacities", "colors", "sh", "is_dynamic", "objects")

    @property
    def num_channels(self) -> int:
        """Number of channels of an image of these splats."""
        return 3 if self.colors is None else self.colors.shape[1]

    def seen_from(self, viewmat: Float[Tensor, "4 4"]) -> "Splats":
        """The same splats, with what they reflect towards a camera as part of ``sh``."""
        if self.reflections is None or self.sh is None or not len(self.reflections.normals):
            return self
        first, bases = len(self.means) - len(self.reflections.normals), self.sh.shape[1]
        colors = self.reflections.colors(self.means[first:], viewmat) / SH_C0
        added = torch.nn.functional.pad(colors[:, None], (0, 0, 0, bases - 1, first, 0))
        return dataclasses.replace(self, sh=self.sh + added, reflections=None)

    def to(self, device: torch.device | str) -> "Splats":
        """A copy on another device."""
        tensors = {n: t.to(device) for n in self.tensor_names() if (t := getattr(self, n)) is not None}
        reflections = None if self.reflections is None else self.reflections.to(device)
        behind = self.background
        behind = behind.moved_to(device) if isinstance(behind, Dome) else None if behind is None else behind.to(device)
        return dataclasses.replace(self, **tensors, background=behind, reflections=reflections)
