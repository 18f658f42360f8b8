"""``warpgs bench``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True)
class Bench:
    """Times rendering on random scenes: medians in milliseconds, stage by stage and as a whole."""

    scenes: tuple[Literal["small", "large", "wide"], ...] = ()
    """Scenes to measure: small (480x270, 100k Gaussians of 3 px), large (1920x1080, 1M of 4 px), wide (1920x1080, 200k
    of 20 px). By default all on CUDA and small on CPU."""
    device: Literal["cpu", "cuda"] | None = None
    """Where to render; CUDA if there is a GPU."""
    repeats: int = 30
    """Runs that the medians are taken over."""
    branches: Literal["none", "random", "disc"] = "none"
    """Measure three images (joint, static, dynamic) against one; each Gaussian is dynamic with probability 1/2
    (random), or where it projects into a disc of 20 % of the image (disc)."""
    depth: bool = False
    """Render depth too."""
    graph: bool = False
    """Also time the render and its way back as a replayed CUDA graph."""
    against: Literal["gsplat"] | None = None
    """Also time another renderer, in turn with this one, and compare images and gradients."""
    json: Path | None = None
    """File for all figures."""
    profile: Path | None = None
    """File for a Chrome trace (chrome://tracing) of the kernels of one render and its way back."""
    steps: bool = False
    """Instead of scenes, time whole training steps, by number of Gaussians and size of image."""
    fps: Path | None = None
    """Instead of scenes, measure the frames a second of this run."""

    def run(self) -> None:
        """Measures and prints; raises as ``run_bench``."""
        from .run_bench import run_bench

        run_bench(self)
