"""Options of ``warpgs bench``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warpgs.errors import require_present


@dataclass(frozen=True)
class Bench:
    """Measures rendering times of random or trained scenes: medians in milliseconds, in total and per stage."""

    scenes: tuple[Literal["small", "large", "wide"], ...] = ()
    """Scenes to measure: small (480x270, 100k Gaussians of 3 px), large (1920x1080, 1M of 4 px), wide (1920x1080, 200k
    of 20 px). By default, without --scene, all on CUDA and small on CPU."""
    scene: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Trained scene to measure: a run folder, through five of its training cameras; or a file of Gaussians (.ply, .sog,
    .spz, .glb, .splat), through five cameras on a circle around it. Medians are over the cameras, too. May be repeated.
    """
    sizes: tuple[str, ...] = ()
    """Image sizes of --scene and --fps, as WIDTHxHEIGHT; by default 480x270 of --scene, on CUDA also 1920x1080 and
    3840x2160, and the size of the capture of --fps."""
    device: Literal["cuda", "cpu"] | None = None
    """Device to render on; CUDA by default if there is a GPU."""
    repeats: int = 30
    """Number of runs to take the medians over."""
    branches: Literal["none", "random", "disc"] = "none"
    """Compare rendering three images (joint, static, dynamic) with rendering one; a Gaussian is dynamic with
    probability 1/2 (random), or if it projects into a disc that covers 20 % of the image (disc)."""
    depth: bool = False
    """Also render depth."""
    sh_degree: Literal[0, 1, 2, 3] | None = None
    """Give the Gaussians colours of spherical harmonics of this degree instead of colours that are the same from all
    sides."""
    graph: bool = False
    """Also measure CUDA graphs: of the forward pass, of both passes, and one of each pass that autograd joins
    (torch.cuda.make_graphed_callables)."""
    against: Literal["gsplat", "gswarp"] | None = None
    """Also measure another renderer, alternating with this one, and compare images and gradients."""
    json: Path | None = None
    """JSON file to write all measurements to."""
    profile: Path | None = None
    """File for a Chrome trace (chrome://tracing) of the kernels of one forward and backward pass."""
    steps: bool = False
    """Measure whole training steps instead, for several numbers of Gaussians and image sizes."""
    preset: Literal["paper", "best", "patient", "quick"] = "paper"
    """Preset whose networks and losses the training steps have."""
    fps: Path | None = None
    """Measure the frames per second of this run folder instead."""

    def require_inputs(self) -> None:
        """Raises ValueError if there is no such trained scene."""
        require_present(*self.scene, *([] if self.fps is None else [self.fps]))
