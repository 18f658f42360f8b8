"""A metric, and what it is measured on."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from warpgs.cameras import Camera
from warpgs.rendering import Rendering

from .lpips import Lpips


@runtime_checkable
class Renderer(Protocol):
    """The scene to evaluate: ``TrainedScene`` is one."""

    @property
    def device(self) -> torch.device:
        """Device to render on."""

    def render(self, camera: Camera, *, branches: bool = False) -> Rendering:
        """Renders through a camera at the camera's time, with or without the static and the dynamic image."""

    def play(self, camera: Camera) -> Float[Tensor, "H W 3"]:
        """The joint image, as fast as possible."""


@dataclass(frozen=True)
class Comparison:
    """The rendering of an evaluation view and its ground truth, on the scene's device.

    Attributes:
        image: Joint image, clamped to [0, 1], not rounded to 8 bits.
        truth: Ground truth in [0, 1].
        static: Whether a pixel is static; None without a mask.
        covisible: Whether training cameras see a pixel; None unless the capture says so, as iPhone captures do.
        shown: ``Camera.shown``; where it is false, the image is the ground truth.
        lpips: Network of LPIPS; None without its weights.
    """

    image: Float[Tensor, "H W 3"]
    truth: Float[Tensor, "H W 3"]
    static: Bool[Tensor, "H W"] | None
    covisible: Bool[Tensor, "H W"] | None
    shown: Bool[Tensor, "H W"] | None
    lpips: Lpips | None

    @property
    def dynamic(self) -> Bool[Tensor, "H W"] | None:
        """Whether a pixel is dynamic; None without a mask."""
        return None if self.static is None else ~self.static


Line = Literal["views", "co-visible", "scene", ""]
"""A line of the summary that ``warpgs eval`` prints; empty for none."""


@dataclass(frozen=True)
class Metric:
    """A number in metrics.json. Without a function it is read from the run (``evaluate_run``).

    Attributes:
        title: Name in summaries, reports and tables.
        of_view: Measures one evaluation view; None or NaN where that cannot be. views.csv has its values, metrics.json
            their mean.
        of_scene: Measures a scene through the evaluation cameras, with or without progress (``quiet``), or None.
        unit: Unit in which it is shown.
        scale: One such unit in units of metrics.json.
        digits: Digits after the point.
        better: Which values are better; empty where neither are.
        line: Line of the summary that tells it.
        reason: Why it may not be measured, for that line.
        is_column: Whether tables of sweeps have it.
    """

    title: str
    of_view: Callable[[Comparison], float | None] | None = None
    of_scene: Callable[[Renderer, Sequence[Camera], bool], float | None] | None = None
    unit: str = ""
    scale: float = 1.0
    digits: int = 4
    better: Literal["higher", "lower", ""] = ""
    line: Line = "views"
    reason: str = ""
    is_column: bool = True

    @property
    def heading(self) -> str:
        """The title with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    def number(self, value: float) -> str:
        """A value in this unit, with these digits."""
        return f"{value:,.{self.digits}f}"

    def told(self, value: float | None) -> str:
        """The metric in words, as in "PSNR 31.25 dB"."""
        if value is None:
            return f"{self.title} not measured{self.reason and f' ({self.reason})'}"
        return f"{self.title} {self.number(value / self.scale)} {self.unit}".rstrip()


def known(value: float | None) -> float | None:
    """A measured value; None for NaN."""
    return None if value is None or math.isnan(value) else value
